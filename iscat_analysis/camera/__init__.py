"""How many photoelectrons?  Counts, light, noise and the beam."""
