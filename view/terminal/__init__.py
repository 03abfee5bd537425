"""Terminal view of a live side."""
