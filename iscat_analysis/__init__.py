"""Particles in interferometric scattering movies, and how near their fits come to the bound."""
