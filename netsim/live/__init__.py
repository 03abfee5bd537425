"""The proxy between two processes, and how it is controlled while it runs."""
