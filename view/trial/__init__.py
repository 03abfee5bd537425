"""Page of `haptether try`: a pointer is the hand on two bridges at once, served to this machine only."""
