"""Prescribed motion of held vertices."""
