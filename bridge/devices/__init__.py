"""Device drivers in Python: discovery, opening and the loop that steps them."""
