"""Findings about pixels, axes, mass scale and model of a movie, most of them from its table."""

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
from iscat_analysis.findings import Finding
from iscat_analysis.findings import camera as of
from iscat_analysis.findings.files import AXES_SWAPPED
from iscat_analysis.fitting.events import Event
from iscat_analysis.inference.cause import likely_cause
from iscat_analysis.inference.fit import OUTWARD
from iscat_analysis.medians import robust_sigma
from iscat_analysis.movie import Stack
from iscat_analysis.optics.model import MassScale
from iscat_analysis.optics.scatterers import has_shells
from iscat_analysis.optics.sized import VESICLE
from iscat_analysis.records import FloatArray, Status, Windows, has_flag
from iscat_analysis.search.frames import DARK, well_lit
from iscat_analysis.trust.systematic import is_bent
from iscat_analysis.units import are, count, frames_listed

_DISTURBED = frozenset({Status.SATURATED, Status.SIDELOBE, Status.TOO_CLOSE, Status.LARGE})
_ENOUGH_STEPS = 30  # of particles that move, to tell their heights or their blur
_FEWEST_ROWS, _FEWEST_RESIDUES = 5, 12  # rows of a kind that make it worth a line
_NORMAL = (0.4549, 1.3863)  # medians of χ² with one and two degrees of freedom


def axes_warning(name: str, counts: NDArray[Any]) -> Finding | None:
    """Find whether time seems to run along the rows or columns of the frames.

    Images along the time axis change least, relative to their means: a pixel's light repeats but
    for noise, while neighbouring pixels have different light.  Of each axis the middle is read.

    Shapes: `counts` (t, y, x).
    """
    # 96 frames, rows and columns at most
    middle = tuple(slice(max(n - 96, 0) // 2, (n + 96) // 2) for n in counts.shape)
    part = counts[middle].astype(np.float64)
    part = part[np.isfinite(part).all(axis=(1, 2))]
    if len(part) < 2:
        return None
    changes = []
    for axis in range(3):
        lines = np.moveaxis(part, axis, 0)
        mean = lines.mean(axis=(1, 2))
        lit = mean > 0
        steps = np.diff(lines[lit] / mean[lit, None, None], axis=0)
        changes.append(float(np.mean(steps**2)) if lit.sum() > 1 else math.nan)
    for axis, lines_of in ((1, "rows"), (2, "columns")):
        others = min(changes[0], changes[3 - axis])
        if 10 * changes[axis] < others:
            times = math.sqrt(others / changes[axis])
            return AXES_SWAPPED({"lines": lines_of, "times": times}, where=name)
    return None


def pixel_warnings(defects: int, saturated: int) -> Iterator[Finding]:
    """Find how many pixels are left out, and why."""
    if defects:
        pixels = count(defects, "dead, hot or noisy pixel")
        yield of.PIXELS_DEFECT({"pixels": pixels, "are": are(defects)})
    if saturated:
        yield of.PIXELS_SATURATED({"pixels": count(saturated, "pixel"), "are": are(saturated)})


def repeats_warning(movie: Stack, windows: Windows) -> Finding | None:
    """Find frames that repeat the one before, which sums count as frames of their own."""
    numbers = np.concatenate([np.arange(*windows.frames_before), np.arange(*windows.frames_after)])
    same = (np.diff(windows.power) == 0) & (np.diff(numbers) == 1)
    same &= well_lit(windows.power, DARK)[1:]  # of dark ones something else is said
    pairs = ((n, movie.read(n - 1, n + 1)) for n in numbers[1:][same].tolist())
    found = [n for n, pair in pairs if np.array_equal(*pair)]
    if not found:
        return None
    repeat = "repeats" if len(found) == 1 else "repeat"
    return of.FRAMES_REPEATED(
        {"frames": frames_listed(found), "of": numbers.size, "repeat": repeat}, where=movie.name
    )


def uneven_warning(
    config: Config, name: str, windows: Windows, explained: FloatArray | None = None
) -> Finding | None:
    """Find light that is uneven where one level is the background of all pixels.

    Rings of many bright particles make it uneven by 1 % where these are not `explained`.

    Shapes: `explained` (y, x).
    """
    level = windows.power_ratio * windows.before_e
    used = ~windows.masked & (level > 0)
    if windows.n_before or not used.any():
        return None
    signal = np.zeros(level.shape) if explained is None else explained
    expected = level * (1 + signal) if config.optics.interferes else level + signal
    used &= np.isfinite(expected) & (expected > 0)
    if used.sum() < 100:
        return None
    expected, after = expected[used], windows.after_e[used]
    light = after / expected
    noise = after + windows.read_variance_after_e2[used]
    shot = math.sqrt(max(float(np.median(noise / expected**2)), 0.0))
    middle = float(np.median(light))
    uneven = math.sqrt(max(robust_sigma(light - middle) ** 2 - shot**2, 0.0))
    if uneven <= max(shot, 0.0 if explained is not None else 0.01 * middle):
        return None
    method = ""
    if config.fit.follows_tracks:
        method = ', or learn the background with background.method = "tracks"'
    elif config.optics.interferes:
        method = ', or follow landings with background.method = "sliding"'
    values = {"percent": 100 * uneven / middle, "times": float(f"{uneven / shot:.2g}")}
    values["level_e"] = float(config.background.level_e or 0.0)
    return of.LIGHT_UNEVEN({**values, "or_method": method}, where=name)


def misfit_warning(config: Config, events: Sequence[Event]) -> str:
    """Say what is probably wrong with the model, where it fails for the brightest particles."""
    if config.optics.psf == "measured":
        return ""
    alone = [e for e in events if not _DISTURBED.intersection(e.flags)]
    tested = sorted(alone, key=lambda e: -e.snr)[:8]
    missed = [e for e in tested if Status.POOR_FIT in e.flags]
    if 2 * len(missed) <= len(tested):
        return ""
    cause = likely_cause(config, [(e.likelihood, e.fit.theta, e.fit.box.free) for e in missed])
    return cause.message if cause else ""


def line_warning(config: Config, table: pd.DataFrame) -> Finding | None:
    """Find contrasts that the calibration line cannot convert into a single mass."""
    line = config.calibration
    if line is None or not line.offset:
        return None
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
    near &= sigma.notna() & has_flag(table, Status.AT_BOUND)
    number = int(near.sum())
    return of.LINE_AMBIGUOUS({"fits": count(number, "fit"), "why": why}) if number else None


def scale_warning(scale: MassScale) -> Finding | None:
    """Tell how the mass scale was transferred from the optics of its standards, or why not."""
    line = scale.calibration
    if line is None or (not scale.refusal and abs(scale.carried - 1) < 0.01):
        return None
    whose, advice = "the optics of its standards", ""
    if line.optics_assumed:
        whose = "the configured optics, at which its gradient is taken"
        advice = (
            "; if the standards were measured with the optics of this movie, masses are wrong by "
            "that factor: calibrate with the folder of their analysis (iscat calibrate mass)"
        )
    if scale.refusal:
        flag = Status.UNCALIBRATED_OPTICS.value
        return of.SCALE_REFUSED({"whose": whose, "refusal": scale.refusal, "flag": flag})
    return of.SCALE_CARRIED({"whose": whose, "carried": scale.carried, "advice": advice})


def nonlinearity_warning(scale: MassScale, table: pd.DataFrame) -> Finding | None:
    """Find particles that are too heavy for a line through faint standards."""
    bent = is_bent(scale, table)
    if not bent.any():
        return None
    masses = table["mass_kda"].abs().to_numpy(float)[bent]
    most = float(masses.max())
    share = float(scale.bend(np.array([most]))[0])
    way = "light" if share > 0 else "heavy"
    words = {"particles": count(len(masses), "particle"), "are": are(len(masses)), "way": way}
    return of.CONTRAST_NONLINEAR({**words, "most_kda": most, "percent": 100 * abs(share)})


def large_warning(config: Config, table: pd.DataFrame) -> Finding | None:
    """Find particles that are no dipoles, and tell which spheres they are."""
    large = table[has_flag(table, Status.LARGE)]
    if not len(large):
        return None
    models = ", ".join(f"{n} {name}" for name, n in large["model"].value_counts().items())
    text = ""
    if poor := int(has_flag(large, Status.POOR_FIT).sum()):
        untried = VESICLE in config.fit.spheres and not has_shells()
        shells = '; vesicles were not tried: pip install "iscat-analysis[shell]"' if untried else ""
        text = (
            f"; no sphere describes {poor} of them well (flagged poor_fit): add their material to "
            "fit.spheres; if they are not on the coverslip, use mode size; what is no sphere has "
            f"no diameter{shells}"
        )
    words = {"particles": count(len(large), "particle"), "are": are(len(large)), "models": models}
    return of.PARTICLES_LARGE({**words, "of": len(table), "poor": text, "poor_fits": poor})


def sign_warning(config: Config, table: pd.DataFrame) -> Finding | None:
    """Find whether nearly all particles have the opposite sign of the model."""
    mass = table.loc[table["status"] == Status.OK.value, "mass_kda"].dropna()
    turned = int((mass < 0).sum())
    if turned < _FEWEST_ROWS or turned < 0.9 * len(mass):
        return None
    brightens = float(table.loc[mass.index, "contrast"].median()) > 0
    change, other = ("brighten", "darken") if brightens else ("darken", "brighten")
    by = "the configured optics" if config.calibration is None else "calibration.gradient_per_kda"
    words = {"particles": count(len(mass), "particle"), "change": change, "other": other, "by": by}
    return of.SIGN_TURNED({"turned": turned, **words})


def landing_rate_warning(table: pd.DataFrame) -> Finding | None:
    """Find whether the light of many steps changes slowly, not from one frame to the next.

    Their pictures may agree with the model; `Status.CHANGING` is about the light before and after.
    """
    slow = int(has_flag(table, Status.CHANGING).sum())
    if slow < _FEWEST_ROWS or slow < 0.1 * len(table):
        return None
    return of.LIGHT_OF_EVENTS_CHANGES({"slow": slow, "of": len(table)})


def fixed_height_warning(config: Config, table: pd.DataFrame) -> Finding | None:
    """Find whether particles whose heights were fitted in every frame do not move along z."""
    if not config.track.heights_free:
        return None
    good = table[table["status"] == Status.OK.value].sort_values(["track", "frame"])
    step = good[["track", "frame", "x_nm", "y_nm", "z_nm"]].diff()
    next_ones = (step["track"] == 0) & (step["frame"] == 1)
    if next_ones.sum() < _ENOUGH_STEPS:
        return None
    noise = float((good["sigma_x_nm"] ** 2 + good["sigma_y_nm"] ** 2).median())
    step = step[next_ones]
    along = float((step["z_nm"] ** 2).median()) / _NORMAL[0]  # outliers change fringes
    across = float((step["x_nm"] ** 2 + step["y_nm"] ** 2).median()) / _NORMAL[1] - noise
    # near the coverslip those that do not move in a plane have less along z too, but not so much
    if along >= 0.05 * across:
        return None
    values = {"across_nm": math.sqrt(across), "along_nm": math.sqrt(along)}
    return of.HEIGHT_FIXED({**values, "height_nm": float(good["z_nm"].median())})


def smear_warning(config: Config, table: pd.DataFrame, smear_nm: FloatArray) -> Finding | None:
    """Find whether particles move too far within an exposure for their heights to be fitted.

    A picture is modelled with a normal distribution of positions about the mean, along z in phase
    too.  Of a long path no two pictures are alike: of bright particles most fits are poor from
    20 nm on, and hardly any is at 15 nm.

    Shapes: `smear_nm` (n,).
    """
    if config.fit.mode != "joint" or len(table) < _ENOUGH_STEPS:
        return None
    poor = float(has_flag(table, Status.POOR_FIT).mean())
    smear = float(np.median(smear_nm))
    if poor < 0.5 or smear < 20:
        return None
    rate, exposure = config.camera.frame_rate_hz, config.camera.exposure_ms
    if exposure is None and rate is not None:
        exposure = 1e3 / rate
    than = ""
    if exposure is not None:
        than = f" than {exposure:.3g} ms, about {exposure * (15 / smear) ** 2:.1g} ms"
    return of.EXPOSURE_SMEARS({"smear_nm": smear, "poor": poor, "than": than})


def residue_warning(table: pd.DataFrame, window: int) -> Finding | None:
    """Find whether most rows are no particles, and in which frames they are.

    Light that changes all over the field leaves residues everywhere, for as long as a window has
    frames of both sides.
    """
    left = table["status"] == Status.SIDELOBE.value
    frames = np.sort(table.loc[left, "frame"].to_numpy(float))
    if len(frames) < max(_FEWEST_RESIDUES, 0.5 * float((~left).sum())):
        return None
    last = np.searchsorted(frames, frames + 2 * window, side="right")
    first = int(np.argmax(last - np.arange(len(frames))))
    inside = frames[first : last[first]]
    where = "all through the movie"
    if len(inside) > 0.6 * len(frames):
        where = f"{len(inside)} of them in frames {inside[0]:.0f}:{inside[-1] + 1:.0f}"
    return of.RESIDUES({"rows": len(frames), "where": where})


def pattern_jitter_warning(movie: Stack, camera: Camera, frames: tuple[int, int]) -> Finding | None:
    """Find whether the fixed pattern shakes, and makes most of the noise beyond the light's.

    Moving particles add noise too, but not along the gradient of the mean frame.
    """
    counts = movie.read(frames[0], min(frames[1], frames[0] + SPECTRUM_FRAMES))
    try:
        found = diagnose_gain(counts, camera)
    except DataError:  # too dark to tell
        return None
    return found.finding if found.shakes else None
