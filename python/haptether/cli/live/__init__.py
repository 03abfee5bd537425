"""Commands of live sides: `master`, `slave`, `check-link`, and `explain` of what they wrote."""
