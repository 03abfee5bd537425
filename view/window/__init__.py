"""A run in a window: one that is over, and one that goes on."""
