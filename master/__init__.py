"""Haptether, master room."""
