"""Motions known exactly, discrete in space and continuous in time, and which scenes they hold for."""
