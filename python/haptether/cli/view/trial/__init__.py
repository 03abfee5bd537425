"""`haptether try`: its command, the processes behind the page, and their record."""
