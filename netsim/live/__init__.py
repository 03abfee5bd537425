"""Live proxy between two processes, and its control at run time."""
