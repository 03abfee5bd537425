"""`haptether setup`: the questions, the files, and the checks of an installation."""
