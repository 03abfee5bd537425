"""Live sides in a browser: a local page that shows them and sends the operator's commands."""
