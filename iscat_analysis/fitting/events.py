"""Records of an event, the same for all background modes, and its flags.

A candidate (`Candidate`, or the `Peak` and `Step` of a landing movie) becomes `Fitted`, and an
`Event` when its neighbours are known too.  An `Event` holds all that its row in ``fits.csv`` and
its images need.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.regions import Region
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.posterior import sample_posterior
from iscat_analysis.inference.prior import Prior
from iscat_analysis.optics.seated import SeatedModel
from iscat_analysis.pieces.regions import saturated_near
from iscat_analysis.records import Candidate, FitResult, PosteriorResult, Status, Windows, verdict
from iscat_analysis.search.residue import Described

PlaceAndMass = tuple[float, float, float, float]
"""x, y, z [nm] and mass [kDa]."""


@dataclass(frozen=True)
class Fitted:
    """One fitted particle: where it was searched, what was fitted, and the likelihood used."""

    region: Region
    fit: FitResult
    likelihood: Likelihood

    @property
    def candidate(self) -> Candidate:
        """The estimate, in the form from which another fit starts."""
        pixel = self.likelihood.grid.pixel_nm
        return Candidate(
            self.fit.x_nm / pixel, self.fit.y_nm / pixel, self.fit.z_nm, self.fit.mass_kda, self.snr
        )

    @property
    def place(self) -> PlaceAndMass:
        """Position [nm] and mass [kDa]."""
        return self.fit.x_nm, self.fit.y_nm, self.fit.z_nm, self.fit.mass_kda

    @property
    def sphere(self) -> SeatedModel | None:
        """The model of the sphere that it is; None for a dipole."""
        model = self.likelihood.model
        return model if isinstance(model, SeatedModel) else None

    @property
    def snr(self) -> float:
        """Signal-to-noise ratio √(2 Δℓ), Δℓ against the model without the particle."""
        return self.fit.snr

    @property
    def described(self) -> Described:
        """What the fit explains, and its misfit."""
        return Described.of(self.snr, self.fit.chi2_reduced, self.likelihood.n_pixels)


@dataclass(frozen=True)
class Event(Fitted):
    """One particle, fitted and judged."""

    windows: Windows
    flags: tuple[Status, ...]
    frame: int
    n_before: int
    n_after: int
    sign: int = 1
    half_width: int | None = None
    rise: int = 0


def fit_flags(
    context: AnalysisContext,
    fitted: Fitted,
    windows: Windows,
    *,
    sidelobe: bool,
    too_close: bool,
    changing: bool = False,
) -> tuple[Status, ...]:
    """Join the flags of a fit with those of its neighbourhood."""
    fit, region = fitted.fit, fitted.region
    corner = region.rows[0], region.columns[0]
    saturated = saturated_near(
        windows.saturated, fit.x_nm, fit.y_nm, context.pixel_nm, corner=corner
    )
    possible = (
        (sidelobe, Status.SIDELOBE),
        (saturated, Status.SATURATED),
        (too_close, Status.TOO_CLOSE),
        (changing, Status.CHANGING),
    )
    return verdict([*fit.flags, *(flag for true, flag in possible if true)])[1]


def standing_out(events: Sequence[Event]) -> Sequence[Event]:
    """Select the events without a flag."""
    return [event for event in events if not event.flags] or events


def posterior_of(
    context: AnalysisContext,
    event: Event,
    number: int,
    *,
    stopped: Callable[[], bool] = lambda: False,
) -> PosteriorResult:
    """Sample the posterior of an event."""
    settings = context.config.posterior
    return sample_posterior(
        event.likelihood,
        event.fit,
        walkers=settings.walkers,
        steps=settings.steps,
        seed=context.config.compute.seed + number,
        prior=Prior(settings.priors),
        stopped=stopped,
    )
