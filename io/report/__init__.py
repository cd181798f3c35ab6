"""Reports and pictures, made from nothing but a results folder."""
