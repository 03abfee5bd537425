"""Figures of runs, sweeps and links from arrays alone, without other parts of the package."""
