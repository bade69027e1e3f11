"""What should a particle look like?  Microscope and particle → expected image and derivatives."""
