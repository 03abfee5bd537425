"""Commands that write a file of one's own to fill in: `new-driver`, `new-controller`, `new-impairment`."""
