"""Generator of the pictures in the documents: `python -m tests.images [--out DIR] [PICTURE...]`, or `make images`."""
