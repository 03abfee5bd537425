"""Figures of runs, sweeps and links, from arrays alone: whoever has the arrays may draw them, the bridge included."""
