"""Haptether, bridge room."""
