"""Pictures by PyVista: one picture of a time, in a window or off-screen."""
