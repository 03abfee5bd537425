"""Browser console for live sides: a page served to this machine only, its content and its commands."""
