"""A recording for Foxglove: its own channels, and beside them poses, frames and force arrows in Foxglove's schemas."""
