"""Haptether."""
