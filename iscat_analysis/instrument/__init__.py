"""Which microscope was it?  Its optics, learned from particles."""
