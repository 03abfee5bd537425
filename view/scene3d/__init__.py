"""Poses of everything at each time of a run, without a graphics library."""
