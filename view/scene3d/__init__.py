"""What is where at each time of a run, without any library that draws."""
