"""Settings of one direction of a network, and how they become what the Rust side takes."""
