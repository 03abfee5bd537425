"""What `haptether.view` draws with PyVista: one picture of a time, in a window or without a display."""
