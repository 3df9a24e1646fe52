"""Stability on stiff and extreme cases, judged from physics."""
