"""Particle position and mass from interferometric scattering movies, and how near the bound they are."""
