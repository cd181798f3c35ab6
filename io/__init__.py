"""What comes in and goes out: rig file, images, tables, simulator, results."""
