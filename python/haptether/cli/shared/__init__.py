"""What commands of every kind share: numbers and their bounds, output, the screen."""
