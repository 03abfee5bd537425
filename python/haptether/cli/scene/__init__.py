"""Commands that run scenes in virtual time: `simulate` and `sweep`."""
