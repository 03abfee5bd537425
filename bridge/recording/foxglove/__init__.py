"""Export of a recording for Foxglove: its own channels, plus poses, frames and force arrows in Foxglove's schemas."""
