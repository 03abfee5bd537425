"""Sweeps that are stored while they run: their design, their journal, their files, and where rows are computed."""
