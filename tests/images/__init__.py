"""Makes the pictures of the documents anew: `python -m tests.images [--out DIR] [PICTURE...]`, or `make images`."""
