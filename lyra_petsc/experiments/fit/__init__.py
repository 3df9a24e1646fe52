"""Parameters of a scene from measurements: readings, simulations with derivatives, least squares, report."""
