"""Physical terms: energies, loads and damping; one file each, registered in ``registry``."""
