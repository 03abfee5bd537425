"""A run as a self-contained page, without libraries or network."""
