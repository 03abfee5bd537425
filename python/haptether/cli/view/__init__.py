"""Commands that show running and finished runs."""
