"""A run as a page that needs nothing else: no library, no network."""
