"""Style of all pictures: colours, sizes, fonts, legends, letters, names of events. Uses no other package."""
