"""Self-contained page of a run, without libraries or network."""
