"""Laws of the membrane by Green strain; one file each, registered in ``registry``."""
