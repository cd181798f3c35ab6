"""What other programs and recorders wrote, as cameras and tables of this library."""
