"""What do the counts say?  Likelihood, fit, goodness of fit and posterior of one particle."""

from iscat_analysis.inference.fit import compile_kernels, fit_particle, parts_of
from iscat_analysis.inference.likelihood import Likelihood

__all__ = ["Likelihood", "compile_kernels", "fit_particle", "parts_of"]
