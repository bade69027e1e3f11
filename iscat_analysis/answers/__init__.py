"""What do tables of events say?  Species, binding, kinetics, calibrations."""
