"""Warnings about pixels, axes, stage, mass scale and model of a movie."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.camera import Camera, diagnose_gain
from iscat_analysis.config import Config
from iscat_analysis.diagnosis.noise import SPECTRUM_FRAMES
from iscat_analysis.errors import DataError
from iscat_analysis.fitting.events import Event
from iscat_analysis.inference.cause import likely_cause
from iscat_analysis.inference.fit import OUTWARD
from iscat_analysis.movie import Stack
from iscat_analysis.optics.scale import MassScale
from iscat_analysis.optics.seated import VESICLE
from iscat_analysis.optics.spheres import has_shells
from iscat_analysis.records import FloatArray, Status, Windows, has_flag
from iscat_analysis.search.frames import DARK, well_lit
from iscat_analysis.trust.systematic import is_bent
from iscat_analysis.units import count, listed

FLAT = 0.05
"""Variance of the steps along z over that in the plane, below which particles move in a plane:
near the coverslip those that do not have less along z too, but not so much less."""

_RING_UNEVENNESS = 0.01  # of the light, which rings of many bright particles make uneven
_LEAST_PIXELS = 100  # away from particles, of which the light is said to be uneven
_SIGMA_PER_MAD = 1.4826  # standard deviation over the median deviation of a Gaussian
_BRIGHTEST = 8  # isolated particles on which the model is judged
_DISTURBED = frozenset({Status.SATURATED, Status.SIDELOBE, Status.TOO_CLOSE, Status.LARGE})
_LEAST_SCALE_CHANGE = 0.01  # change of the scale that makes it worth a line
_LEAST_CHANGE_RATIO = 10.0  # times less change along the axis of time than along both of space
_LOOKED_AT = 96  # frames, rows and columns in which axes are judged
_ENOUGH_STEPS = 30
_FEWEST_RESIDUES, _MOST_RESIDUES = 12, 0.5  # of them, and for each other row, without a word
_AT_ONCE = 0.6  # of them, within two windows
_MOST_POOR_SHARE = 0.5  # of fits that are poor
_SMEARED_NM = 20.0  # from where most fits of bright particles are,
_DESCRIBED_NM = 15.0  # and where hardly any is
_NORMAL = (0.4549, 1.3863)  # medians of χ² with one and two degrees of freedom
_FEWEST_TURNED = 5  # particles of the other sign that make it worth a line,
_NEARLY_ALL = 0.9  # and their share
_FEWEST_SLOW = 5  # steps that are none that make it worth a line,
_MANY_SLOW = 0.1  # and their share of all events


def axes_warning(name: str, counts: NDArray[Any]) -> str:
    """Warn that time seems to run along the rows or columns of the frames.

    Images along the time axis change least, relative to their means: a pixel's light repeats but
    for noise, while neighbouring pixels have different light.

    Shapes: `counts` (t, y, x).
    """
    middle = tuple(slice(max(n - _LOOKED_AT, 0) // 2, (n + _LOOKED_AT) // 2) for n in counts.shape)
    part = counts[middle].astype(np.float64)
    part = part[np.isfinite(part).all(axis=(1, 2))]
    if len(part) < 2:
        return ""
    changes = []
    for axis in range(3):
        lines = np.moveaxis(part, axis, 0)
        mean = lines.mean(axis=(1, 2))
        lit = mean > 0
        steps = np.diff(lines[lit] / mean[lit, None, None], axis=0)
        changes.append(float(np.mean(steps**2)) if lit.sum() > 1 else math.nan)
    for axis, lines_of in ((1, "rows"), (2, "columns")):
        others = min(changes[0], changes[3 - axis])
        if _LEAST_CHANGE_RATIO * changes[axis] < others:
            return (
                f"{name}: frames differ more from each other than neighbouring {lines_of} of one "
                f"frame do ({math.sqrt(others / changes[axis]):.0f} times), as if time ran along "
                f"its {lines_of}: the axes must be (t, y, x); export it again in this order"
            )
    return ""


def pixel_warnings(defects: int, saturated: int) -> Iterator[str]:
    """Say how many pixels are left out, and why."""
    if defects:
        yield f"{count(defects, 'dead, hot or noisy pixel')} {_verb_be(defects)} left out"
    if saturated:
        yield (
            f"{count(saturated, 'pixel')} {_verb_be(saturated)} saturated in some frame and left "
            "out; lower the exposure or the laser power"
        )


def _verb_be(number: int) -> str:
    return "is" if number == 1 else "are"


def repeats_warning(movie: Stack, windows: Windows) -> str:
    """Warn of frames that repeat the one before, which sums count as frames of their own."""
    numbers = np.concatenate([np.arange(*windows.frames_before), np.arange(*windows.frames_after)])
    same = (np.diff(windows.power) == 0) & (np.diff(numbers) == 1)
    same &= well_lit(windows.power, DARK)[1:]  # of dark ones something else is said
    found = [n for n in numbers[1:][same].tolist() if _repeats(movie, n)]
    if not found:
        return ""
    return (
        f"{movie.name}: {'frames' if len(found) > 1 else 'frame'} {listed(found, 4)} of "
        f"{numbers.size} {'repeat' if len(found) > 1 else 'repeats'} the frame before "
        "(stuck in the camera), so that there is less light than it seems and σ is too small: "
        "record or export the movie without them"
    )


def _repeats(movie: Stack, number: int) -> bool:
    pair = movie.read(number - 1, number + 1)
    return np.array_equal(pair[0], pair[1])


def uneven_warning(
    config: Config, name: str, windows: Windows, explained: FloatArray | None = None
) -> str:
    """Warn that the light is uneven where one level is the background of all pixels.

    Shapes: `explained` (y, x).
    """
    level = windows.power_ratio * windows.before_e
    used = ~windows.masked & (level > 0)
    if windows.n_before or not used.any():
        return ""
    signal = np.zeros(level.shape) if explained is None else explained
    expected = level + signal if config.optics.scheme == "darkfield" else level * (1 + signal)
    used &= np.isfinite(expected) & (expected > 0)
    if used.sum() < _LEAST_PIXELS:
        return ""
    expected, after = expected[used], windows.after_e[used]
    light = after / expected
    noise = after + windows.read_variance_after_e2[used]
    shot = math.sqrt(max(float(np.median(noise / expected**2)), 0.0))
    middle = float(np.median(light))
    spread = _SIGMA_PER_MAD * float(np.median(np.abs(light - middle)))
    uneven = math.sqrt(max(spread**2 - shot**2, 0.0))
    if uneven <= max(shot, 0.0 if explained is not None else _RING_UNEVENNESS * middle):
        return ""
    times = float(f"{uneven / shot:.2g}")
    advice = "give frames without particles as background.frames"
    if config.fit.mode == "track":
        advice += ', or learn the background with background.method = "tracks"'
    elif config.optics.scheme != "darkfield":
        advice += ', or follow landings with background.method = "sliding"'
    return (
        f"{name}: the light differs by {100 * uneven / middle:.2g} % of its mean from pixel to "
        f'pixel, {times:g} times its noise, where background.method = "known" has '
        f"{config.background.level_e:g} in all of them: what differs is taken for particles, or "
        f"makes their masses and places wrong; {advice}"
    )


def misfit_warning(config: Config, events: Sequence[Event]) -> str:
    """Say what is probably wrong with the model, where it fails for the brightest particles."""
    if config.optics.psf == "measured":
        return ""
    alone = [e for e in events if not _DISTURBED.intersection(e.flags)]
    brightest = sorted(alone, key=lambda e: -e.snr)[:_BRIGHTEST]
    missed = [e for e in brightest if Status.POOR_FIT in e.flags]
    if 2 * len(missed) <= len(brightest):
        return ""
    cause = likely_cause(config, [(e.likelihood, e.fit.theta, e.fit.box.free) for e in missed])
    return cause.message if cause else ""


def line_warning(config: Config, table: pd.DataFrame) -> str:
    """Warn of contrasts that the calibration line cannot convert into a single mass."""
    line = config.calibration
    if line is None or not line.offset:
        return ""
    crossing = -line.offset / line.gradient_per_kda
    mass, sigma = table["mass_kda"], table["sigma_mass_kda"]
    if crossing > 0:
        near = mass.abs() - OUTWARD * sigma < 2 * crossing
        why = (
            f"its line is at zero at {crossing:.3g} kDa, so that below {2 * crossing:.3g} kDa two "
            "masses of opposite sign have one contrast, of which the one with its sign is given"
        )
    else:
        near = mass * table["contrast"] * line.gradient_per_kda < 0
        why = f"its line has the contrast {line.offset:.3g} without a particle, and they have less"
    near &= sigma.notna() & table["flags"].fillna("").str.contains(Status.AT_BOUND.value)
    number = int(near.sum())
    if not number:
        return ""
    return (
        f"[calibration] does not tell the mass of {count(number, 'fit')}, flagged at_bound: {why}; "
        "measure it with lighter standards, or set calibration.offset = 0 if its error allows it"
    )


def scale_warning(scale: MassScale) -> str:
    """Say how the mass scale was transferred from the optics of its standards, or why not."""
    line = scale.calibration
    if line is None or (not scale.refusal and abs(scale.carried - 1) < _LEAST_SCALE_CHANGE):
        return ""
    whose = (
        "the configured optics, at which its gradient is taken"
        if line.optics_assumed
        else ("the optics of its standards")
    )
    if scale.refusal:
        return (
            f"the scale of masses does not hold here: it belongs to {whose}, and {scale.refusal}; "
            f"all rows are flagged {Status.UNCALIBRATED_OPTICS.value}, their contrasts are right: "
            "measure standards as this movie is recorded (iscat calibrate mass)"
        )
    advice = (
        "; if the standards were measured with the optics of this movie, masses are wrong by that "
        "factor: calibrate with the folder of their analysis (iscat calibrate mass)"
        if line.optics_assumed
        else ""
    )
    return (
        f"the scale of masses is carried over from {whose}: a particle has {scale.carried:.4g} "
        f"times the contrast that it has there{advice}"
    )


def nonlinearity_warning(scale: MassScale, table: pd.DataFrame) -> str:
    """Warn of particles that are too heavy for a line through faint standards."""
    bent = is_bent(scale, table)
    if not bent.any():
        return ""
    masses = table["mass_kda"].abs().to_numpy(float)[bent]
    most = float(masses.max())
    share = float(scale.bend(np.array([most]))[0])
    verb = "is" if len(masses) == 1 else "are"
    return (
        f"{count(len(masses), 'particle')}, of up to {most:.4g} kDa, {verb} so heavy that contrast "
        "is not in proportion to the mass: it has the square of the scattered light, and the line "
        "of [calibration], where its standards are light, makes the heaviest "
        f"{100 * abs(share):.2g} % too {'light' if share > 0 else 'heavy'}; systematic_mass_kda "
        "has that; calibrate with standards as heavy as these"
    )


def large_warning(config: Config, table: pd.DataFrame) -> str:
    """Say which particles are no dipoles, and which spheres they are."""
    large = table[has_flag(table, Status.LARGE)]
    if not len(large):
        return ""
    each = large["model"].value_counts()
    known = ", ".join(f"{number} {name}" for name, number in each.items())
    text = (
        f"{count(len(large), 'particle')} of {len(table)} {'is' if len(large) == 1 else 'are'} no "
        f"dipole: fitted as spheres on the coverslip ({known}), flagged large, these have no mass "
        "and belong to no species"
    )
    poor = int(has_flag(large, Status.POOR_FIT).sum())
    if poor:
        untried = VESICLE in config.fit.spheres and not has_shells()
        shells = '; vesicles were not tried: pip install "iscat-analysis[shell]"' if untried else ""
        text += (
            f"; no sphere describes {poor} of them well (flagged poor_fit): add their material to "
            "fit.spheres; if they are not on the coverslip, use mode size; what is no sphere has "
            f"no diameter{shells}"
        )
    return text


def sign_warning(config: Config, table: pd.DataFrame) -> str:
    """Warn that nearly all particles have the opposite sign of the model."""
    mass = table.loc[table["status"] == Status.OK.value, "mass_kda"].dropna()
    turned = int((mass < 0).sum())
    if turned < _FEWEST_TURNED or turned < _NEARLY_ALL * len(mass):
        return ""
    brightens = float(table.loc[mass.index, "contrast"].median()) > 0
    seen, other = ("brighten", "darken") if brightens else ("darken", "brighten")
    by = "the configured optics" if config.calibration is None else "calibration.gradient_per_kda"
    return (
        f"{turned} of {count(len(mass), 'particle')} have a negative mass, as particles that "
        f"leave: they {seen} the image, and by {by} particles that land {other} it; if these "
        "particles land, correct that sign, or optics.focus_nm"
    )


def landing_rate_warning(table: pd.DataFrame) -> str:
    """Warn that the light of many steps changes slowly, not from one frame to the next.

    Their pictures may agree with the model; `Status.CHANGING` is about the light before and after.
    """
    slow = int(has_flag(table, Status.CHANGING).sum())
    if slow < _FEWEST_SLOW or slow < _MANY_SLOW * len(table):
        return ""
    return (
        f"the light of {slow} of {len(table)} events, flagged changing, goes on changing before or "
        "after the step, not from one frame to the next: "
        "particles that settle slowly, move on, bleach or blink; their masses are those of the "
        "mean change (sum frames before the analysis if they settle within a few, or lower "
        "background.window_frames if they change later)"
    )


def fixed_height_warning(config: Config, table: pd.DataFrame) -> str:
    """Warn that particles whose heights were fitted in every frame do not move along z."""
    if config.track.free != "joint":
        return ""
    good = table[table["status"] == Status.OK.value].sort_values(["track", "frame"])
    step = good[["track", "frame", "x_nm", "y_nm", "z_nm"]].diff()
    next_ones = (step["track"] == 0) & (step["frame"] == 1)
    if next_ones.sum() < _ENOUGH_STEPS:
        return ""
    noise = float((good["sigma_x_nm"] ** 2 + good["sigma_y_nm"] ** 2).median())
    step = step[next_ones]
    along = float((step["z_nm"] ** 2).median()) / _NORMAL[0]  # outliers change fringes
    across = float((step["x_nm"] ** 2 + step["y_nm"] ** 2).median()) / _NORMAL[1] - noise
    if along >= FLAT * across:
        return ""
    return (
        f"the particles move by {math.sqrt(across):.2g} nm from frame to frame along x and y but "
        f'by {math.sqrt(along):.2g} nm along z, as on a membrane: set track.free = "mass" and '
        f'particle.height_nm = {good["z_nm"].median():.3g}; with track.free = "joint" pictures '
        "are blurred along z as well, and masses come out too large"
    )


def smear_warning(config: Config, table: pd.DataFrame, smear_nm: FloatArray) -> str:
    """Warn that particles move too far within an exposure for their heights to be fitted.

    A picture is modelled with a normal distribution of positions about the mean, along z in phase
    too.  Of a long path no two pictures are alike.

    Shapes: `smear_nm` (n,).
    """
    if config.fit.mode != "joint" or len(table) < _ENOUGH_STEPS:
        return ""
    poor = table["flags"].fillna("").str.contains(Status.POOR_FIT.value)
    smear = float(np.median(smear_nm))
    if poor.mean() < _MOST_POOR_SHARE or smear < _SMEARED_NM:
        return ""
    rate, exposure = config.camera.frame_rate_hz, config.camera.exposure_ms
    if exposure is None and rate is not None:
        exposure = 1e3 / rate
    advice = ""
    if exposure is not None:
        advice = f" than {exposure:.3g} ms, about {exposure * (_DESCRIBED_NM / smear) ** 2:.1g} ms"
    return (
        f"the particles go {smear:.0f} nm (standard deviation) about their mean within an "
        f"exposure, and {poor.mean():.0%} of the fits are poor: along z that turns the phase by "
        "too much for one picture, and optics, gain and noise cannot be judged; expose for less"
        f"{advice}"
    )


def residue_warning(table: pd.DataFrame, window: int) -> str:
    """Say in one sentence that most of what was found is no particle, and when it was.

    Light that changes all over the field leaves residues everywhere, for as long as a window has
    frames of both sides.
    """
    left = table["status"] == Status.SIDELOBE.value
    frames = np.sort(table.loc[left, "frame"].to_numpy(float))
    if len(frames) < max(_FEWEST_RESIDUES, _MOST_RESIDUES * float((~left).sum())):
        return ""
    last = np.searchsorted(frames, frames + 2 * window, side="right")
    first = int(np.argmax(last - np.arange(len(frames))))
    inside = frames[first : last[first]]
    where = "all through the movie"
    if len(inside) > _AT_ONCE * len(frames):
        where = f"{len(inside)} of them in frames {inside[0]:.0f}:{inside[-1] + 1:.0f}"
    return (
        f"{len(frames)} rows are residues and no particles (status sidelobe), {where}: light that "
        "changes all over the field leaves them, as where one of two patterns of the illumination "
        "moves against the other; find what moves, a window, a mirror or the coverslip, leave "
        "these frames out (fit.frames), or shorten background.window_frames"
    )


def pattern_jitter_warning(movie: Stack, camera: Camera, frames: tuple[int, int]) -> str:
    """Warn that the fixed pattern shakes, where that is most of the noise beyond the light's.

    Moving particles add noise too, but not along the gradient of the mean frame.
    """
    counts = movie.read(frames[0], min(frames[1], frames[0] + SPECTRUM_FRAMES))
    try:
        found = diagnose_gain(counts, camera)
    except DataError:  # too dark to tell
        return ""
    return (found.message or "") if found.shakes else ""
