"""Haptether, safety room."""
