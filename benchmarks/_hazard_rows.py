"""The rows of ``hazards.py``: what is wrong with a movie, how strongly, and what should be said."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from _hazard_movies import (
    APART_PX,
    COUNT,
    GAIN,
    LARGE,
    LEVEL_E,
    NOMINAL,
    PIXEL_NM,
    SHAPE,
    Array,
    Case,
    Draw,
    aligned,
    alike,
    anywhere,
    box,
    breathing,
    film,
    landings,
    nominal,
    of_foci,
    of_halves,
    of_heights,
    of_optics,
    of_places,
    rising,
    stored,
    vesicle,
)
from instruments import PEAK_PER_KDA, Instrument, InstrumentMovie, Landings, Pictures, draw_landings
from uneven_movies import comatic, other_reference, tilted
from wanderers import SETTINGS as TRACKED
from wanderers import wander

LINE_SE = 0.002  # of the line of the standards, where something else is wrong
FRAME_MS = 1e3 / 331.0


def recorded(standards: Instrument = NOMINAL, relative: float = LINE_SE) -> dict[str, Any]:
    """Give a calibration whose standards were measured with a microscope."""
    sign = nominal().sign if standards == NOMINAL else Pictures(standards).sign
    return {
        "calibration.gradient_per_kda": sign * PEAK_PER_KDA,
        "calibration.gradient_se_per_kda": relative * PEAK_PER_KDA,
        "calibration.height_nm": standards.height_nm,
        "calibration.optics": {
            "focus_nm": standards.focus_nm, "wavelength_nm": standards.wavelength_nm,
            "na": standards.na,
        },
        # the peaks are those of the light, not of light that is averaged in pixels
        "calibration.camera": {"pixel_size_nm": PIXEL_NM, "samples_per_pixel": "auto"},
    }  # fmt: skip


def unrecorded() -> dict[str, Any]:
    """Give a gradient from elsewhere: nobody says with what optics it was measured."""
    return {"calibration.gradient_per_kda": nominal().sign * PEAK_PER_KDA}


def case(counts: Any, truth: Landings, others: Landings | None = None, **settings: Any) -> Case:
    """Analyse with standards of the same microscope."""
    changes = {name.replace("__", "."): value for name, value in settings.items()}
    return Case(counts, truth, {**recorded(), **changes}, others)


def usual(
    draw: Draw, seed: int, *, masses: tuple[float, ...] = (92.0, 205.0, 430.0), **more: Any
) -> Case:
    """Record particles that are drawn in another way, or whose light takes another course."""
    truth = landings(seed, masses)
    return case(stored(film(truth, draw, seed, **more)), truth)


def learned(draw: Draw, seed: int, **more: Any) -> Case:
    """Do the same with enough particles to learn optics."""
    truth = landings(seed, large=True)
    return case(stored(film(truth, draw, seed, shape=LARGE, **more)), truth)


# ---------------------------------------------------------------- optics and scale


def scattered_alike(
    seen: Instrument, seed: int, *, standards: Instrument = NOMINAL, pixel_nm: float = PIXEL_NM
) -> tuple[Array, Landings]:
    """Record enough particles to learn optics, which scatter as those of the standards did.

    The field of a dipole over that of the reference goes as the wavelength to the power of -3,
    which pictures of a given peak do not have.
    """
    truth = landings(seed, large=True)
    strength = Pictures(standards).per_kda / Pictures(seen).per_kda
    strength *= (standards.wavelength_nm / seen.wavelength_nm) ** 3
    scattered = replace(truth, mass_kda=truth.mass_kda * strength)
    made = InstrumentMovie(
        seen, LARGE, scattered, seed=seed + 1, pixel_nm=pixel_nm, gain_e_per_adu=GAIN
    )
    return made.counts, truth


def other_focus(strength: float, seed: int) -> Case:
    """Record a movie so many nm from the focus at which the standards were."""
    seen = replace(NOMINAL, focus_nm=NOMINAL.focus_nm - strength)
    return Case(*scattered_alike(seen, seed), recorded(relative=0.01))


def other_focus_unrecorded(strength: float, seed: int) -> Case:
    """Do the same with a gradient that came without its optics."""
    seen = replace(NOMINAL, focus_nm=NOMINAL.focus_nm - strength)
    return Case(*scattered_alike(seen, seed), unrecorded())


def other_wavelength(strength: float, seed: int) -> Case:
    """Record at a wavelength that is so many nm above what is configured."""
    seen = replace(NOMINAL, wavelength_nm=NOMINAL.wavelength_nm + strength)
    settings = unrecorded() | {"uncertainty.wavelength_nm": strength}
    return Case(*scattered_alike(seen, seed), settings)


def other_magnification(strength: float, seed: int) -> Case:
    """Record with pixels that are larger by a share than what is configured."""
    pixel = PIXEL_NM * (1 + strength)
    settings = unrecorded() | {"uncertainty.magnification": max(strength, 0.0)}
    return Case(*scattered_alike(NOMINAL, seed, pixel_nm=pixel), settings)


def focus_step(strength: float, seed: int) -> Case:
    """Move the focus in the middle of the movie."""
    draw, middle = of_foci(NOMINAL.focus_nm, NOMINAL.focus_nm - strength), LARGE[0] // 2
    return learned(draw, seed, by_frame=lambda t: np.array([t < middle, t >= middle], dtype=float))


def cone(strength: float, seed: int) -> Case:
    """Illuminate with a cone of so many radians in the sample."""
    na = NOMINAL.n_sample * float(np.sin(strength))
    return usual(of_optics(tilted(0.0, 0.0), na), seed)


def focus_tilt(strength: float, seed: int) -> Case:
    """Tilt the focus over the field by so many nm at its border."""
    return learned(of_optics(tilted(strength, 0.0)), seed)


def coma(strength: float, seed: int) -> Case:
    """Let coma grow to so many nm at the border."""
    return learned(of_optics(comatic(strength)), seed)


def uneven_amplitude(strength: float, seed: int) -> Case:
    """Let the amplitude of the reference fall over the field by so much each way."""
    return learned(of_optics(other_reference(0.0, strength)), seed)


def curved_phase(strength: float, seed: int) -> Case:
    """Let the phase of the reference be curved by so many radians."""
    return learned(of_optics(other_reference(strength)), seed)


# ---------------------------------------------------------------- particles


def clean(strength: float, seed: int) -> Case:
    """Record what is expected; masses are compared with so many times the truth."""
    found = usual(alike(), seed)
    compared = replace(found.truth, mass_kda=found.truth.mass_kda * strength)
    return replace(found, truth=compared)


def heights(strength: float, seed: int) -> Case:
    """Put particles between the glass and so many nm, and hold them at 5 nm."""
    return usual(of_heights(0.0, strength), seed)


def heights_learned(strength: float, seed: int) -> Case:
    """Do the same, and learn heights from the movie."""
    made = heights(strength, seed)
    return replace(made, settings={**made.settings, "particle.height_nm": "auto"})


def tether(strength: float, seed: int) -> Case:
    """Let particles wiggle in a box within each frame, so many nm rms."""
    places = box(strength)
    return usual(of_places(places), seed, course=anywhere(len(places), 6))


def jitter(strength: float, seed: int) -> Case:
    """Put particles at another place in every frame, so many nm rms."""
    places = box(strength)
    return usual(of_places(places), seed, course=anywhere(len(places), 1))


def halves(strength: float, seed: int) -> Case:
    """Let particles be two halves that are so many nm apart."""
    return usual(of_halves(strength), seed)


def halves_fitted(strength: float, seed: int) -> Case:
    """Do the same, and fit two halves."""
    made = halves(strength, seed)
    return replace(made, settings={**made.settings, "fit.pairs": True})


def slow(strength: float, seed: int) -> Case:
    """Let the light of a particle rise over so many frames."""
    return usual(alike(), seed, course=rising(strength), masses=(92.0, 205.0))


def breath(strength: float, seed: int) -> Case:
    """Let contrasts fluctuate by a share, with a memory of 20 frames."""
    return usual(alike(), seed, course=breathing(strength))


def breath_of_heavy(strength: float, seed: int) -> Case:
    """Do the same to particles that are all bright enough to show it."""
    return usual(alike(), seed, course=breathing(strength), masses=(430.0,))


def slow_breath(strength: float, seed: int) -> Case:
    """Let contrasts fluctuate by 5 %, with a memory of so many frames."""
    return usual(alike(), seed, course=breathing(0.05, strength))


def among(draw: Draw, kda: float, number: int, seed: int) -> Case:
    """Let bright ones land among proteins."""
    every = draw_landings(SHAPE, COUNT + number, seed=seed, masses=(1.0,), apart_px=APART_PX)
    order = np.random.default_rng(seed).permutation(COUNT + number)
    parts = [
        replace(every, frame=every.frame[k], x_px=every.x_px[k], y_px=every.y_px[k],
                mass_kda=np.resize(mass, len(k)))
        for k, mass in ((order[number:], (92.0, 205.0, 430.0)), (order[:number], (kda,)))
    ]  # fmt: skip
    truth, others = parts
    counts = film(truth, alike(), seed, others=others, draw_others=draw)
    return case(stored(counts), truth, others)


def aggregates(strength: float, seed: int) -> Case:
    """Let three particles of so many kDa land among proteins."""
    return among(alike(), strength, 3, seed)


def vesicles(strength: float, seed: int) -> Case:
    """Let a vesicle of so many nm land among proteins."""
    return among(lambda place, rng: vesicle(place, strength, rng)[None], 1e4, 1, seed)


# ---------------------------------------------------------------- light, camera and file


def moving_pattern(strength: float, seed: int) -> Case:
    """Let one of two patterns move by so many pixels."""
    return usual(alike(), seed, second=0.05, moved_px=strength)


def bent(response: Callable[[Array], Array], slope: float, seed: int) -> Case:
    """Record with a camera whose gain is as the noise at the mean light says."""
    truth = landings(seed)
    counts = stored(film(truth, alike(), seed, record=response, pattern=0.1))
    return case(counts, truth, camera__gain_e_per_adu=1 / slope)


def gamma(strength: float, seed: int) -> Case:
    """Record with a camera whose counts are light to a power."""
    full = 2 * LEVEL_E
    counts = 6e4
    slope = counts * strength * 0.5 ** (strength - 1) / full
    # the photon transfer of a pixel: variance over mean, both in counts
    transfer = slope**2 * LEVEL_E / (counts * 0.5**strength)
    return bent(lambda e: counts * (e / full) ** strength, transfer, seed)


def saturation(strength: float, seed: int) -> Case:
    """Record with a camera that saturates softly, at so many times the mean light."""
    full = strength * LEVEL_E
    mean = full / GAIN * -np.expm1(-1 / strength)
    slope = np.exp(-1 / strength) / GAIN
    return bent(lambda e: full / GAIN * -np.expm1(-e / full), slope**2 * LEVEL_E / mean, seed)


def few_bits(strength: float, seed: int) -> Case:
    """Record 8 bits under a laser that is steady to a share."""
    truth = landings(seed)
    gain = LEVEL_E / 150
    counts = film(truth, alike(), seed, record=lambda e: e / gain, power_noise=strength)
    return case(stored(counts, bits=8), truth, camera__gain_e_per_adu=gain)


def interpolated(strength: float, seed: int) -> Case:
    """Align a movie that drifts by so many pixels by interpolation."""
    truth = landings(seed)
    return case(stored(aligned(film(truth, alike(), seed, drift_px=strength), strength)), truth)


def dropped(strength: float, seed: int) -> Case:
    """Drop a share of the frames of particles that diffuse; the file has the time of each."""
    made = wander((400, 96, 96), seed=seed, species=((400.0, 0.3, 5),))
    kept = np.flatnonzero(np.random.default_rng(seed).random(400) >= strength)
    path = Path(tempfile.mkdtemp()) / "movie.ome.tif"
    plane = {"DeltaT": (kept * FRAME_MS).tolist(), "DeltaTUnit": ["ms"] * len(kept)}
    tifffile.imwrite(
        path, made.counts[kept], ome=True, photometric="minisblack",
        metadata={"axes": "TYX", "TimeIncrement": FRAME_MS, "TimeIncrementUnit": "ms",
                  "Plane": plane},
    )  # fmt: skip
    nothing = Landings(np.zeros(0, int), *np.zeros((3, 0)))
    return Case(path, nothing, {k: v for k, v in TRACKED.items() if k != "camera.frame_rate_hz"})


@dataclass(frozen=True)
class Row:
    """One kind of harm.

    Attributes
    ----------
    make : callable
        Gives a case for a strength and a seed.
    strengths : tuple of float
        How strong it is; the first is that of the `--quick` run.
    unit : str
        Of the strength.
    says : str
        Pattern of a text that names the cause, in a line of the summary or in a flag.
    diffusion : bool
        Compare diffusion coefficients of tracks in place of masses.
    lies : bool
        The row is a control that must be found broken.
    """

    make: Callable[[float, int], Case]
    strengths: tuple[float, ...]
    unit: str = ""
    says: str = "^$"
    diffusion: bool = False
    lies: bool = False


_CARRIED = "carried over|does not hold here|uncalibrated_optics"
_MODEL = "a wrong |focus|aberration|optics|differ"
ROWS: Mapping[str, Row] = {
    "clean": Row(clean, (1.0,)),
    "clean, truth changed afterwards": Row(clean, (0.9,), lies=True),
    "focus of the standards": Row(other_focus, (30.0, 0.0, 60.0, 120.0), "nm", _CARRIED),
    "focus, gradient without record": Row(
        other_focus_unrecorded, (30.0, 0.0, 60.0), "nm", _CARRIED
    ),
    "wavelength, gradient from elsewhere": Row(other_wavelength, (5.0, 1.0, 2.0), "nm"),
    "magnification, gradient from elsewhere": Row(other_magnification, (0.01, 0.002, 0.005)),
    "focus step": Row(focus_step, (60.0, 30.0, 120.0), "nm", _MODEL),
    "gamma": Row(gamma, (0.8, 0.9, 0.95), "", "gamma|not in proportion"),
    "soft saturation": Row(saturation, (10.0, 2.0, 20.0), "mean light",
                           "saturat|compress|not in proportion"),
    "aligned by interpolation": Row(interpolated, (1.0, 0.5, 3.0), "px", "interpolated"),
    "heights held": Row(heights, (20.0, 10.0, 60.0), "nm", "not equally high"),
    "heights learned": Row(heights_learned, (20.0, 10.0, 60.0), "nm", "heights"),
    "tether": Row(tether, (35.0, 10.0, 17.0, 25.0, 52.0), "nm rms", "wiggle|wider"),
    "jitter": Row(jitter, (15.0, 10.0, 25.0), "nm rms", "wiggle|wider"),
    "light that rises": Row(slow, (40.0, 10.0, 20.0), "frames", "rises|goes on changing"),
    "breathing": Row(breath, (0.05, 0.03, 0.1), "", "fluctuate|goes on changing"),
    "breathing of heavy ones": Row(
        breath_of_heavy, (0.05, 0.03, 0.1), "", "fluctuate|goes on changing"
    ),
    "slow fluctuation": Row(
        slow_breath, (100.0, 20.0, 400.0), "frames", "fluctuate|goes on changing"
    ),
    "cone of illumination": Row(cone, (0.1, 0.05, 0.15), "rad", _MODEL),
    "two halves": Row(halves, (100.0, 30.0, 50.0, 70.0, 200.0), "nm", "wider|extended|apart"),
    "two halves, fitted": Row(
        halves_fitted, (100.0, 50.0, 70.0, 200.0), "nm", "wider|extended|apart"
    ),
    "aggregates among proteins": Row(aggregates, (5e3, 2e3, 1e4), "kDa"),
    "vesicle among proteins": Row(vesicles, (200.0, 100.0, 150.0), "nm"),
    "second pattern moves": Row(moving_pattern, (0.1, 0.03, 0.3, 1.0), "px", "pattern|drift|move"),
    "uneven amplitude of the reference": Row(uneven_amplitude, (0.05, 0.03, 0.1), "", "differ"),
    "focus tilt": Row(focus_tilt, (100.0, 50.0, 200.0), "nm", _MODEL),
    "coma at the border": Row(coma, (25.0, 10.0, 40.0), "nm", _MODEL),
    "curved phase of the reference": Row(curved_phase, (0.3, 0.15, 0.6), "rad", _MODEL),
    "8 bits": Row(few_bits, (0.001, 0.003, 0.01), "of light"),
    "dropped frames": Row(dropped, (0.1, 0.05, 0.3), "", "dropped", diffusion=True),
}  # fmt: skip
"""What is tried.  To add one, write a function from strength and seed to a `Case`."""
