"""Poses of all bodies at each time of a run, without a drawing library."""
