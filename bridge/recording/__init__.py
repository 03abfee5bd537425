"""What a live run recorded, read back: as it stands in the file, and as the `Run` that `simulate` returns."""
