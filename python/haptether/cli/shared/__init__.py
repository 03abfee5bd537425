"""Numbers and their bounds, output and the screen, for commands of every kind."""
