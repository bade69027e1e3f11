"""Single steps of the analysis as functions of arrays, without a movie, a folder or a file.

Each takes the microscope, the particle and the camera as `Optics`, `Particle` and `Camera`, the
same sections that a configuration file has, and arrays otherwise:

`psf`
    images of a particle, for arrays of positions, heights or masses;
`fit_rois`
    fits of many regions, counts before and after or contrast images, into one table;
`fit_rods`
    the same of rods of any direction;
`log_likelihood`
    the log-likelihood of one region and its gradient, for any sampler or optimiser;
`crb`, `qcrb`
    bounds of any estimate, for this camera or for any measurement of the light; arrays of set-ups.

Lengths are nm, masses kDa, counts photoelectrons; images have axes (y, x), and pixel (0, 0) of a
region has its centre at (0, 0) nm.
"""

from __future__ import annotations

from iscat_analysis.config import CameraConfig as Camera
from iscat_analysis.inference.fit import compile_kernels, fit_particle
from iscat_analysis.pieces.counts import config_of, gather
from iscat_analysis.pieces.limits import crb, psf, qcrb
from iscat_analysis.pieces.regions import LogLikelihood, fit_rois, log_likelihood
from iscat_analysis.pieces.rods import fit_rods
