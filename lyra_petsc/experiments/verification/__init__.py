"""Exact and published answers: small named cases, their errors, and a verdict on each."""
