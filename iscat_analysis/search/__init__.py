"""Where and when is a particle?  Matched filters over a field, and over time."""
