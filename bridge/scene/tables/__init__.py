"""Tables of a scene as users write them."""
