"""Common style of all pictures: colours, sizes, fonts, legends, letters, event names. Independent of other rooms."""
