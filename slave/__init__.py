"""Haptether, slave room."""
