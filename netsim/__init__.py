"""Haptether, netsim room."""
