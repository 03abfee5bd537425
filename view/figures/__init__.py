"""Figures of runs, sweeps and links from arrays only, usable by any caller including the bridge."""
