"""Sweeps that are kept while they run: their design, their journal, their files, and who computes the rows."""
