"""One style for every picture: colours, sizes, fonts, legends, letters, names of events. It uses no other room."""
