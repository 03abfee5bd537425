"""What `--record` of master and slave wrote: described, drawn, and exported."""
