"""Windows for finished and for live runs."""
