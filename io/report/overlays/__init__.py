"""What was found in an image, drawn over it."""
