"""Commands of live sides: `master`, `slave`, `check-link`, and `explain` for their files."""
