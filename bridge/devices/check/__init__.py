"""Standalone driver check: samples, call times and shutdown."""
