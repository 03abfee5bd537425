"""Live sides in a browser: a page served to this machine alone, what it shows, and what a person does with it."""
