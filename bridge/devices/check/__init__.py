"""A driver checked by itself: what it reads, how long its calls take, and how it ends."""
