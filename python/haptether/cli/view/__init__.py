"""Commands that show what runs and what ran."""
