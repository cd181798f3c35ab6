"""Pure geometry: cameras, targets, rotations, triangulation. No images, no files, no solver."""
