"""Scene files and their checked values: text in, values out."""
