"""The tables of a scene, as a user writes them."""
