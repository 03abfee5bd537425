"""A live side in a terminal."""
