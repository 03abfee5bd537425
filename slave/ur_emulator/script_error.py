"""What stops a program of the controller."""


class ScriptError(Exception):
    """A runtime error of URScript: the program ends, and the message goes to the log."""
