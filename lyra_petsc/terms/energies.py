"""Names of the energies that every run has, apart from the registry, which needs the whole scene."""

MEMBRANE, BENDING, POTENTIAL = ENERGIES = "membrane_energy", "bending_energy", "potential_energy"
"""Columns of history.csv to which several terms add their energies."""
