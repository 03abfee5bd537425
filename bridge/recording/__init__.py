"""Recordings of live runs, read as stored and as the `Run` that `simulate` returns."""
