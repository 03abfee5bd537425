"""Windows: playback of a finished run, and a live run."""
