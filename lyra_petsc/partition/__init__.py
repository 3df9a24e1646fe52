"""Distribution of points and elements over ranks; owned and ghost numbering."""
