"""integrators: one module each, and the registry that a scene picks from."""
