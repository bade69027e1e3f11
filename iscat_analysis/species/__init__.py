"""What is in the sample: species of mass, and how fast particles diffuse.

Species are a mixture fitted to the events themselves, each with its own error.  An event of
measured mass x_i and standard deviation σ_i comes from species k with

    x_i ~ N(μ_k, τ_k² + σ_i²),

so the width τ_k is what exceeds the measurement error: extreme deconvolution in one dimension
(Bovy, Hogg & Roweis, Ann. Appl. Stat. 5, 1657, 2011).  Nothing is binned.  Widths have a weak prior
(`structure`), and events of any mass a background that varies slowly (`mixture`).  That one mixture
serves species, ladders, comparisons and equilibria.  Where nobody asks for masses, species are
peaks: components whose sum has one maximum are one (`choices`).

Light particles are missed.  The matched filter accepts a particle of mass m if its estimate
y ~ N(m, σ_d²) exceeds u·σ_d, and the fit's x uses the same light at least as well, so that y is x
with further noise: given x, selection no longer depends on m.  The likelihood of the events seen is

    Π_i [Σ_k w_k N(x_i; μ_k, τ_k² + σ_i²)] / Z_i,    Z_i = Σ_k w_k Φ((μ_k − u σ_d)/√(τ_k² + s_i²)),

s_i = max(σ_d, σ_i), and the weights w_k are those of the particles that came, seen or not.

Where nobody says what is missed, the limit is a nuisance with a prior (`repeats`).  The number of
components has the least BIC; a parametric bootstrap gives the intervals and says how often it would
choose that number again.

`describe` is the whole of it, curves included.  `events` says what is seen and what is missed,
`mixture` holds the components and says which are one species, `structure` has the likelihood above
where species or samples share parameters, `maximum` maximises every likelihood of masses and finds
the ends of intervals, `choices` tries numbers of components, given masses or a ladder, and
`repeats` the limits of detection and repeated measurements.  `tables` reads events of any program.

`diameters` runs the same mixture on the logarithms of the diameters of spheres, whose errors depend
on the diameter.  `comparison` asks whether two samples are one.  `equilibrium` fits a constant to a
series of concentrations, with the law of mass action and the likelihood of `series`.

A track gives a diffusion coefficient: `diffusion` has the likelihood of its steps, with errors and
motion blur, the estimate and the size that follows, and `motion` tests whether the particle
diffuses freely.  `tracks` puts all of it and the mass of each track into one row, with the
refractive index of particles in a volume, and tests whether the masses of all tracks change
together.
"""

from __future__ import annotations

from iscat_analysis.species.choices import Given, Ladder, LadderFit, Number, Searched
from iscat_analysis.species.comparison import Comparison
from iscat_analysis.species.describe import LEAST_EVENTS, SPECIES_COLUMNS, Distribution, describe
from iscat_analysis.species.diffusion import Diffusion, fit_diffusion, hydrodynamic_diameter
from iscat_analysis.species.events import Efficiency
from iscat_analysis.species.motion import (
    AnomalousTest,
    ConfinementTest,
    anomalous_test,
    confinement_test,
)
from iscat_analysis.species.tracks import TrackSetup, describe_tracks, refractive_index
