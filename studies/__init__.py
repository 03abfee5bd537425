"""Haptether, studies room."""
