"""Material libraries (one data file each) and their reading."""
