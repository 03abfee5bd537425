"""PyVista drawing for `haptether.view`: one picture at a time, in a window or off screen."""
