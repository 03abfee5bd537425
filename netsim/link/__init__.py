"""Settings of one direction of a network, and their conversion for the Rust side."""
