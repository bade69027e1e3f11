"""The diameter of each sphere that moves, from all its frames together.

fits of single frames → D of each track → images averaged along its path → one diameter for all
frames → fits of single frames with those images, near that diameter

Images and motion together then compare two explanations of a track: the configured particle with
any diameter, and a homogeneous sphere of any diameter and any refractive index up to
`LARGEST_INDEX`.  Small spheres of both kinds have the same images, and only the diameter from the
motion tells them apart; the light of larger ones says how far their matter lies from the centre.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from iscat_analysis.config import INVISIBLE, Config
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.events import Event
from iscat_analysis.inference.common_size import UNDETERMINED, CommonSize, SphereFrames
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.optics.model import blurred, path_variance_nm2
from iscat_analysis.optics.sized import LARGEST_INDEX, LEAST_CONTRAST, SizedModel
from iscat_analysis.records import FloatArray, Status, verdict
from iscat_analysis.species.diffusion import LEAST_POSITIONS, hydrodynamic_diameter
from iscat_analysis.species.tracks import SLOWED_BY_WALL, Correlation
from iscat_analysis.tracking.frames import diffusion_of_positions, exposure_of
from iscat_analysis.tracking.table import ALONG, path_shifts

_SHOWS_SIZE = {Status.AMBIGUOUS_SIZE, Status.AMBIGUOUS_Z}
"""Flags of a frame that says something of the diameter all the same."""


@dataclass(frozen=True)
class SphereTrack:
    """One sphere that moves: its diameter, and its frames."""

    model: SizedModel
    events: list[Event]
    sizes: list[CommonSize]
    """Every likely diameter, the best first; empty where no frame can be used."""

    shifts: FloatArray
    """Of the mass in each frame that is used, for one standard deviation of its path: (frames, 9),
    and for that of D: (frames,) in the last column."""

    configured: CommonSize | None = None
    """Mass of the configured particle from images and motion together; none where the material
    absorbs light, or D is not known."""

    homogeneous: CommonSize | None = None
    """Mass and index of a homogeneous sphere, likewise."""


def sphere_track(
    context: AnalysisContext, events: Sequence[Event], pool: ThreadPoolExecutor
) -> SphereTrack:
    """Fit one diameter to the frames of a sphere, and each frame once more near it."""
    used = [event for event in events if set(event.flags) <= _SHOWS_SIZE]
    model = context.model
    if not isinstance(model, SizedModel):
        raise TypeError("diameters are of spheres")
    if not used:
        return SphereTrack(model, [*events], [], np.zeros((0, 10)))
    d_um2_s, sigma_d = _diffusion(context, used)
    variance = path_variance_nm2(d_um2_s, exposure_of(context.config))
    averaged = blurred(model, variance, upwards=True)
    likelihoods = [replace(event.likelihood, model=averaged) for event in used]
    frames = SphereFrames(likelihoods, averaged, context.config.fit.z_range_nm)
    sizes = frames.common_sizes(np.array([event.place[:3] for event in used]))
    if not sizes:
        return SphereTrack(averaged, [*events], [], np.zeros((0, 10)))
    near = replace(averaged, mass_range_kda=_range_around(averaged, sizes))
    start_kda = sizes[0].mass_kda

    def again(event: Event) -> Event:
        likelihood = replace(event.likelihood, model=near)
        start = replace(event.candidate, mass_kda=start_kda)
        z_range_nm = context.config.fit.z_range_nm
        fit = fit_particle(likelihood, start, context.mode, z_range_nm, level=False)
        kept = set(event.flags) - set(event.fit.flags)
        flags = verdict([*fit.flags, *kept])[1]
        return replace(event, fit=fit, likelihood=likelihood, flags=flags)

    shifts = np.zeros((len(used), 10))
    fitted = list(pool.map(again, events))
    if variance > 0:
        z = np.array([event.fit.z_nm for event in fitted])
        place = averaged, context.roi_px, context.pixel_nm
        moved = np.linalg.norm(path_shifts(*place, z, start_kda, variance), axis=2)
        for number, (event, more) in enumerate(zip(fitted, moved, strict=True)):
            fit = replace(event.fit, sigma=np.hypot(event.fit.sigma, more))
            fitted[number] = replace(event, fit=fit)
        of_used = path_shifts(*place, sizes[0].places[:, 2], start_kda, variance)[:, 3]
        wider = of_used[:, :3].sum(axis=1) / ALONG * (sigma_d / d_um2_s)
        shifts = np.column_stack([of_used, wider])
    configured = homogeneous = None
    # a single index describes a material whose index has an imaginary part of less than 1e-6
    if d_um2_s > 0 and abs(model.sphere.index.imag) < 1e-6 and sizes[0].converged:
        motion = _motion(context.config, d_um2_s, sigma_d, sizes[0])
        frames = replace(frames, likelihoods=[event.likelihood for event in used])
        configured, homogeneous = (explained(frames, sizes, motion, free) for free in (False, True))
    return SphereTrack(averaged, fitted, sizes, shifts, configured, homogeneous)


def explained(
    frames: SphereFrames, sizes: Sequence[CommonSize], motion: tuple[float, float], free_index: bool
) -> CommonSize | None:
    """Fit images and motion with the configured particle, or a homogeneous sphere of any index.

    The fits begin at every likely diameter.
    """
    found, model = [], frames.model
    for size in (one for one in sizes if one.converged):
        tried, index = model, None
        if free_index:
            alike = model.sphere.of_mass(size.mass_kda).homogeneous()
            tried, index = replace(model, sphere=alike), alike.index.real
            if abs(index / model.optics.n_sample - 1) < INVISIBLE:  # a shell may undo its core
                continue
        one = replace(frames, model=tried).fit(
            size.likely, mass_kda=size.mass_kda, index=index, frames=size.frames, motion=motion
        )
        if one is not None and one.converged:
            found.append(one)
    return max(found, key=lambda one: one.log_likelihood, default=None)


def _motion(
    config: Config, d_um2_s: float, sigma_d: float, size: CommonSize
) -> tuple[float, float]:
    """Give 1/d of the hydrodynamic diameter, which goes with D, and its error [1/nm].

    Its error has the share by which the coverslip may slow the sphere, 9 d/(32 z).
    """
    track = config.track
    diameter, _ = hydrodynamic_diameter(
        d_um2_s, viscosity_mpa_s=track.viscosity_mpa_s, temperature_c=track.temperature_c
    )
    slowed = SLOWED_BY_WALL * float(
        np.mean(1 / np.maximum(size.places[:, 2] / float(diameter), 0.5))
    )
    return 1 / float(diameter), math.hypot(sigma_d / d_um2_s, slowed) / float(diameter)


def _diffusion(context: AnalysisContext, events: Sequence[Event]) -> tuple[float, float]:
    """D of a track and its standard error [µm²/s]; 0 where positions are too few, or times open."""
    frames = np.array([event.frame for event in events])
    if context.config.camera.frame_rate_hz is None or len(np.unique(frames)) < LEAST_POSITIONS:
        return 0.0, 0.0
    places = np.array([event.place[:2] for event in events])
    sigma = np.array([event.fit.sigma[:2] for event in events])
    return diffusion_of_positions(context.config, frames, places, sigma)


def _range_around(model: SizedModel, sizes: Sequence[CommonSize]) -> tuple[float, float]:
    """Masses nearer to the best than to any other likely one [kDa]."""
    best, *others = (one.mass_kda for one in sizes)
    # a maximum that was given up nearer than a quarter in ln(mass) may be the best
    middles = [math.sqrt(best * o) for o in others if abs(math.log(o / best)) > 0.25]
    low, high = model.mass_range_kda
    lower, upper = ([m for m in middles if (m < best) == below] for below in (True, False))
    return max([low, *lower]), min([high, *upper])


def table_of_sizes(tracks: dict[int, SphereTrack], correlation: Correlation | None) -> pd.DataFrame:
    """Give mass and diameter of each track, with their errors and bounds; its index is `track`."""
    records = {
        number: _record(track, correlation) for number, track in tracks.items() if track.sizes
    }
    return pd.DataFrame.from_dict(records, orient="index").rename_axis("track")


def _record(track: SphereTrack, correlation: Correlation | None) -> dict[str, float]:
    best = track.sizes[0]
    mass = best.mass_kda - float(best.bias[0])
    among = None if correlation is None else correlation(best.places[:, :2])
    own, bound = (float(best.covariance(one)[0, 0]) for one in (among, None))
    share = best.information[:, 0, 0] / best.information[:, 0, 0].sum()
    paths = float(np.sum((share[:, None] * track.shifts[:, :9]) ** 2))
    sigma = math.sqrt(own + paths + float(share @ track.shifts[:, 9]) ** 2)
    diameter = track.model.sphere.of_mass(mass).diameter_nm
    per_kda = diameter / (3 * mass)
    weights = [one.log_weight - best.log_weight for one in track.sizes if one.converged]
    known = math.nan if not best.converged else 1.0
    masses, kinds = (mass, sigma, math.sqrt(bound)), ("", "sigma_", "crb_")
    diameters = diameter, per_kda * sigma, per_kda * masses[2]
    record = {f"{kind}mass_kda": known * m for kind, m in zip(kinds, masses, strict=True)}
    record |= {
        f"{kind}optical_diameter_nm": known * d for kind, d in zip(kinds, diameters, strict=True)
    }
    record["optical_probability"] = known / sum(map(math.exp, weights or [0.0]))
    return (
        record
        | _refraction(track, among, (own + paths) / own)
        | _odds(track, (own + paths) / bound)
    )


def _refraction(
    track: SphereTrack, correlation: FloatArray | None, excess: float
) -> dict[str, float]:
    """Give the refractive index and its error, where images and motion determine them."""
    found, n_sample = track.homogeneous, track.model.optics.n_sample
    if found is None:
        return {}
    index = found.index - float(found.bias[1])
    error = math.sqrt(found.covariance(correlation, excess=excess)[1, 1])
    if not error < UNDETERMINED * abs(index - n_sample):
        return {}
    return {"refractive_index": index, "sigma_refractive_index": error}


def _odds(track: SphereTrack, excess: float) -> dict[str, float]:
    """Compare the configured particle with homogeneous spheres whose index may be any.

    Each has its likelihood times the volume of its parameters, by Laplace's method; before, all
    diameters are equally likely, and all logarithms of n − n_s.  The noise that frames share counts
    once: the difference of the log-likelihoods is over `excess`, the variance of the diameter over
    what it would be in frames of their own.
    """
    own, other = track.configured, track.homogeneous
    if own is None or other is None:
        return {}
    gain = own.log_likelihood - other.log_likelihood
    volumes = own.log_weight - other.log_weight - gain
    n_sample = track.model.optics.n_sample
    range_of_index = math.log((LARGEST_INDEX - n_sample) / LEAST_CONTRAST)
    prior = math.log(abs(other.index - n_sample) * range_of_index)
    return {"log_odds_particle": gain / excess + volumes + prior}
