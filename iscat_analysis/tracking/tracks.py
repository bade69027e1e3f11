"""Tables, messages and films of the tracks of mode ``track``, and motion that all particles share.

A vibrating stage or beam moves all of them by the same.  Where a frame is missing, all of them go
as far as in two frames.  Both make D too large, and no single track shows it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from scipy.ndimage import map_coordinates

from iscat_analysis.camera import Camera, add_frames, start_power
from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError
from iscat_analysis.findings import Finding, existing
from iscat_analysis.findings.tracks import (
    ALL_JUMP,
    ALL_MOVE_TOGETHER,
    EXPOSURE_IN_SECONDS,
    EXPOSURE_UNKNOWN,
    FRAME_RATE_UNKNOWN,
    FRAMES_SEEM_DROPPED,
    MASSES_CHANGE_TOGETHER,
    SHORT_FOR_D,
    STEPS_TOO_LONG,
    TRACKS_CROSS,
)
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.events import Region, region_likelihood
from iscat_analysis.fitting.ranges import background_mode
from iscat_analysis.optics.forward import ForwardModel, PixelGrid
from iscat_analysis.optics.model import blurred, path_variance_nm2, signals_within
from iscat_analysis.optics.scatterers import material
from iscat_analysis.records import (
    BoolArray,
    Film,
    FloatArray,
    FrameSource,
    IntArray,
    Progress,
    Status,
    TrackStatus,
    Windows,
    track_numbers,
)
from iscat_analysis.species.tracks import (
    NO_PLACE,
    Correlation,
    TrackSetup,
    changes_together,
    describe_tracks,
)
from iscat_analysis.threads import one_thread_algebra
from iscat_analysis.tracking.frames import exposure_of
from iscat_analysis.units import listed

FEWEST_PARTICLES = 3
"""Particles in a pair of frames, at least."""

LEAST_COMMON_SHARE = 0.05
"""Of the square of a particle's step, what is common to all, from which on it is said."""

MANY_FRAMES_MISSING = 8
"""Frames missing at once, which are not the run of two or three where single ones are dropped."""

_UNLIKELY = 8.0  # of log-likelihood: one good movie in e⁸ at most


@dataclass(frozen=True)
class _Steps:
    """Steps from a frame to the next, in the order of the frames."""

    frame: IntArray
    """Number of the pair of frames, from 0."""
    numbers: IntArray
    """Of each pair, that of its second frame in the movie."""
    step: FloatArray
    """Along x and y [nm], shape (n, 2)."""
    variance: FloatArray
    """Of the steps of this track along each axis [nm²]."""

    def total(self, values: FloatArray) -> FloatArray:
        """Add up what belongs to each pair of frames."""
        sums = np.bincount(self.frame, weights=values, minlength=len(self.numbers))
        return sums.astype(np.float64)


def common_motion(
    fits: pd.DataFrame, frame_rate_hz: float | None, ticks: IntArray | None = None
) -> list[Finding]:
    """Find motion that all particles share; `ticks` (t,) tells which frames are missing."""
    steps = _steps_of(fits, ticks)
    if steps is None:
        return []
    shaken = _shared_steps(steps, frame_rate_hz)
    jumps, dropped = _jumps(steps), _dropped(steps)
    if many := [jump for missing, jump in jumps if missing >= MANY_FRAMES_MISSING]:
        others = many
    elif dropped and not shaken:
        others = [dropped]
    else:
        others = [jump for _, jump in jumps]
    return existing([shaken, *others])


def _steps_of(fits: pd.DataFrame, ticks: IntArray | None) -> _Steps | None:
    """Gather the steps of all tracks; None where too few particles are seen at once."""
    # a track of which half of the rows are not ok may be two halves of something else
    sound = fits["status"].eq(Status.OK).groupby(fits["track"]).transform("mean") > 0.5
    good = fits.loc[sound & ~fits["status"].isin(NO_PLACE), ["track", "frame", "x_nm", "y_nm"]]
    good = good.sort_values(["track", "frame"])
    time = good["frame"] if ticks is None else ticks[good["frame"].to_numpy(int)]
    step = good.assign(time=time).diff()
    next_ = (step["track"] == 0) & (step["time"] == 1) & (step["frame"] == 1)
    steps = good[["track", "frame"]].assign(x=step["x_nm"], y=step["y_nm"])[next_]
    of_track = (steps["x"] ** 2 + steps["y"] ** 2).groupby(steps["track"])
    steps["variance"] = of_track.transform("median") / (2 * math.log(2))
    # 20 steps tell how far a particle goes
    steps = steps[(of_track.transform("size") >= 20) & (steps["variance"] > 0)]
    steps = steps[steps.groupby("frame")["track"].transform("size") >= FEWEST_PARTICLES]
    steps = steps.sort_values("frame", kind="stable")
    numbers, pair = np.unique(steps["frame"].to_numpy(np.int64), return_inverse=True)
    if len(numbers) < 30:
        return None
    return _Steps(pair, numbers, steps[["x", "y"]].to_numpy(), steps["variance"].to_numpy())


def _shared_steps(steps: _Steps, frame_rate_hz: float | None) -> Finding | None:
    """Find whether all particles move by the same from frame to frame.

    The variance of the common step is the mean product of the steps of two different particles.
    """
    length = np.hypot(*steps.step.T) / np.sqrt(steps.variance)
    # a step counts as if it were of 4 standard deviations at most
    cut = steps.step / np.maximum(length / 4.0, 1.0)[:, None]
    weight = 1 / steps.variance
    both = [steps.total(weight * cut[:, k]) ** 2 for k in (0, 1)]
    own = steps.total(weight**2 * (cut**2).sum(axis=1))
    pairs = steps.total(weight) ** 2 - steps.total(weight**2)
    product = both[0] + both[1] - own
    mean, error = product.mean(), product.std() / math.sqrt(len(product))
    common = float(product.sum() / (2 * pairs.sum()))  # variance along each axis
    # 5 standard errors
    if mean < 5.0 * error or common < LEAST_COMMON_SHARE * np.median(steps.variance):
        return None
    by = ""
    if frame_rate_hz is not None:
        by = f", by up to {1e-6 * common * frame_rate_hz / 2:.2g} um2/s"
    return ALL_MOVE_TOGETHER({"step_nm": math.sqrt(common), "by": by})


def _normalized_squares(steps: _Steps) -> tuple[FloatArray, FloatArray]:
    """Give |step|²/2v of each step, 1 on average, and the number of steps of each frame pair."""
    square = (steps.step**2).sum(axis=1) / (2 * steps.variance)
    return square, steps.total(np.ones(len(steps.frame)))


def _jumps(steps: _Steps) -> list[tuple[int, Finding]]:
    """Find frames between which all particles go so far that frames must be missing."""
    surprise, particles = _normalized_squares(steps)
    total, largest = steps.total(surprise), np.zeros(len(particles))
    np.maximum.at(largest, steps.frame, surprise)
    gaps = np.array([2, 3, 5, 8, 13, 20, 30, 50, 80])[:, None]
    gain = total * (1 - 1 / gaps) - particles * np.log(gaps)
    most, missing = gain.max(axis=0), gaps[gain.argmax(axis=0), 0] - 1
    rest = (total - largest) * (1 - 1 / gaps) - (particles - 1) * np.log(gaps)
    others = rest.max(axis=0)
    # 7.0 of log-likelihood without the farthest particle, which may be another
    found: BoolArray = (most > _UNLIKELY + math.log(len(total))) & (others > 7.0)
    out = []
    for k in np.flatnonzero(found)[:3].tolist():
        number, gap = int(steps.numbers[k]), int(missing[k])
        values = {"before": number - 1, "frame": number, "steps": gap + 1, "missing": gap}
        out.append((gap, ALL_JUMP({**values, "particles": int(particles[k])})))
    return out


def _dropped(steps: _Steps) -> Finding | None:
    """Find whether many single frames are missing."""
    surprise, particles = _normalized_squares(steps)
    most = 4.0  # |step|²/2v: no single particle, which may be lost, decides over all
    clipped = np.minimum(surprise, most)
    # mean of exp(½ min(e, c)) over e of mean 1: what the clipped odds must be divided by
    norm = 2 - math.exp(-most / 2)
    gain = steps.total(clipped) / 2 - particles * math.log(norm)
    odds = np.exp(np.minimum(gain, 50.0))
    shares = np.linspace(0.005, 0.5, 100)
    likely = np.log1p(shares[:, None] * (odds - 1)).sum(axis=1)
    best = int(np.argmax(likely))
    if likely[best] < _UNLIKELY:
        return None
    return FRAMES_SEEM_DROPPED({"pairs": len(particles), "share": float(shares[best])})


SHORT_MOVIE = 20
"""Fewer frames than this hardly tell a diffusion coefficient."""

FILMS = 3
"""Tracks of each kind, the best and the worst, that are shown frame by frame."""

FILM_FRAMES = 40
"""Frames of such a film, at most."""

_OF_FILM = ("frame", "x_px", "y_px", "chi2_reduced")
_PLACE = ("frame", "x_nm", "y_nm", "z_nm", "mass_kda")
_ROUNDING = 1e-9  # an exposure that is the whole interval may exceed it by this share


def judge_times(config: Config, frames: int, name: str) -> list[Finding]:
    """Find what the frame rate, exposure and length of a movie leave unknown about its tracks."""
    found = []
    rate, exposure = config.camera.frame_rate_hz, config.camera.exposure_ms
    if rate is None:
        others = "positions and masses do not need it"
        if config.fits_sizes:
            others = "spheres are fitted as if they rested, and if they move, diameters are wrong"
        found.append(FRAME_RATE_UNKNOWN({"others": others}))
    elif exposure is None:
        found.append(EXPOSURE_UNKNOWN({"interval_ms": 1e3 / rate}))
    elif exposure > 1e3 / rate * (1 + _ROUNDING):
        raise ConfigError(
            f"camera.exposure_ms = {exposure:g} is longer than the {1e3 / rate:.4g} ms from frame "
            f"to frame at camera.frame_rate_hz = {rate:g}: correct one of them"
        )
    elif exposure <= (1 + _ROUNDING) / rate:
        values = {"exposure_ms": exposure, "interval_ms": 1e3 / rate}
        found.append(EXPOSURE_IN_SECONDS({**values, "written_ms": 1e3 * exposure}))
    learnt = config.background.way == "tracks"
    if learnt and frames < config.track.min_frames:
        raise ConfigError(
            f"track.min_frames = {config.track.min_frames} is more than the {frames} frames of "
            f"{name} that are tracked, so that no track is long enough: lower it"
        )
    # A movie without any is refused, as is one of few frames whose background is learnt.
    if 0 < frames < SHORT_MOVIE and not learnt:
        none = ""
        if frames < config.track.min_frames:
            none = f", and none at all below track.min_frames = {config.track.min_frames}"
        percent = 100 / math.sqrt(max(frames - 1, 1))
        values = {"frames": frames, "percent": percent, "least": SHORT_MOVIE}
        found.append(SHORT_FOR_D({**values, "none_at_all": none}, where=name))
    return found


def tracks_of(
    context: AnalysisContext,
    fits: pd.DataFrame,
    windows: Windows,
    *,
    masses: pd.DataFrame | None,
    ticks: IntArray | None,
    progress: Progress,
) -> tuple[pd.DataFrame, dict[str, Any], list[Finding]]:
    """Describe the tracks of a movie, with entries of its summary and what is found."""
    setup = replace(track_setup(context, windows), ticks=ticks)
    setup = replace(setup, change=changes_together(fits, setup.frames))
    with one_thread_algebra():
        tracks = describe_tracks(
            fits,
            setup,
            correlation=mass_correlation(context, fits),
            masses=masses,
            seed=context.config.compute.seed,
            workers=context.config.compute.workers,
            progress=progress,
        )
    found = [cut_steps(tracks, setup, context.config.track.max_step_nm)]
    met = tracks[tracks["nearest_nm"] < setup.near_nm]
    if len(met):
        values = {"limit_nm": setup.near_nm, "nearest_nm": float(met["nearest_nm"].min())}
        found.insert(0, TRACKS_CROSS({**values, "tracks": listed(met["track"], 3)}))
    if setup.change:
        found.insert(0, MASSES_CHANGE_TOGETHER({"percent": 100 * setup.change}))
    summary = {"tracks": len(tracks), "motion": _summary(tracks, setup)}
    return tracks, summary, existing(found)


def track_setup(context: AnalysisContext, windows: Windows) -> TrackSetup:
    """Gather what all tracks of a movie have in common."""
    config = context.config
    rows, columns = windows.after_e.shape
    matter = material(config.particle, config.optics.wavelength_nm)
    # a refractive index describes a permittivity whose imaginary part is below 1e-6
    absorbs = abs(matter.permittivity.imag) > 1e-6 or matter.permittivity.real <= 0
    return TrackSetup(
        frame_rate_hz=config.camera.frame_rate_hz,
        exposure_ms=config.camera.exposure_ms,
        frames=windows.frames_after,
        field_nm=((rows - 1) * context.pixel_nm, (columns - 1) * context.pixel_nm),
        near_nm=config.detection.min_separation_nm,
        min_frames=config.track.min_frames,
        volume=config.track.heights_free,
        viscosity_mpa_s=config.track.viscosity_mpa_s,
        temperature_c=config.track.temperature_c,
        index=None
        if absorbs or config.particle.is_sphere
        else float(np.sqrt(matter.permittivity.real)),
        density_kg_m3=matter.density_kg_m3,
        n_medium=config.optics.n_sample,
        hidden_nm=config.optics.resolution_nm if background_mode(config) == "tracks" else 0.0,
    )


def mass_correlation(context: AnalysisContext, fits: pd.DataFrame) -> Correlation | None:
    """Give the correlation of the masses of frames that share a background recorded before.

    A mass is the picture h times the pixels, over Σ h², and of their pictures two frames have
    K = Σ h(u) h(u − r)/Σ h² in common.  With n frames before, the noise of their mean (f = 1) or
    median is s = f/(f + n) of a frame's variance: (1 − s) I + s K.  Where the height is fitted as
    well, h is what of the picture its derivative along z does not explain.
    Of a background that is learnt from the same n frames, the masses have the information I − s K.
    """
    config = context.config
    before = fits["n_before"].median() if len(fits) else 0
    learnt = background_mode(config) == "tracks"
    known = config.background.is_known or learnt != context.additive
    if known or not before > 0:
        return None
    share = context.background_variance / (context.background_variance + before)
    side = context.roi_px
    middle = (side - 1) / 2 * context.pixel_nm
    grid = PixelGrid.region((0, side), (0, side), context.pixel_nm)
    height, mass = (float(fits[name].median()) for name in ("z_nm", "mass_kda"))
    slopes = context.model.gradient(grid, middle, middle, height, mass)[1]
    picture = slopes[3]
    if fits["sigma_z_nm"].notna().any():
        along = slopes[2]
        picture = picture - along * np.sum(along * picture) / np.sum(along**2)
    light = np.abs(np.fft.rfft2(picture, (2 * side - 1, 2 * side - 1))) ** 2
    common = np.fft.fftshift(np.fft.irfft2(light, (2 * side - 1, 2 * side - 1)))
    common /= common[side - 1, side - 1]

    def correlation(places_nm: FloatArray) -> FloatArray:
        apart = (places_nm[:, None] - places_nm) / context.pixel_nm + (side - 1)
        shared = map_coordinates(common, [apart[..., 1], apart[..., 0]], order=1)
        both = (shared + shared.T) / 2
        if learnt:  # with the background of the same frames
            return np.asarray(np.linalg.inv(np.eye(len(both)) - share * both))
        return np.asarray((1 - share) * np.eye(len(both)) + share * both)

    return correlation


def cut_steps(tracks: pd.DataFrame, setup: TrackSetup, reach_nm: float) -> Finding | None:
    """Find whether D is too small because long steps cannot be linked.

    Steps in the plane of variance s² along each axis exceed R with p = exp(−R²/2s²).  Without these
    their mean square is less by the share R²/2s² p/(1 − p).
    """
    d = tracks.loc[tracks["status"] == TrackStatus.OK, "d_um2_s"].max()
    if setup.frame_rate_hz is None or not d > 0:
        return None
    step = 1e3 * float(np.sqrt(2 * d / setup.frame_rate_hz))
    ratio = reach_nm**2 / (2 * step**2)
    longer = float(np.exp(-ratio))
    # 1 % of D is lost with the steps that are too long to be linked
    if ratio * longer / (1 - longer) < 0.01:
        return None
    # 4 in 10⁶ steps in the plane are longer than 5 times the step along an axis
    values = {"step_nm": step, "reach_nm": reach_nm, "enough_nm": 5.0 * step}
    return STEPS_TOO_LONG({**values, "percent": 100 * longer})


def _summary(tracks: pd.DataFrame, setup: TrackSetup) -> dict[str, Any]:
    """Count and take medians over the tracks that are ok."""
    good = tracks[tracks["status"] == TrackStatus.OK]

    def median(values: pd.Series[float]) -> float | None:
        return float(values.median()) if values.notna().any() else None

    names = ("n_frames", "mass_kda", "d_um2_s", "diameter_nm", "refractive_index")
    flags = Counter(flag for flags in tracks["flags"] for flag in flags.split(";") if flag)
    return {
        "frame_rate_hz": setup.frame_rate_hz,
        "exposure_ms": setup.exposure_ms,
        "status": dict(sorted(Counter(tracks["status"]).items())),
        "flags": dict(sorted(flags.items())),
        "medians": {name: median(good[name]) for name in names},
        "sigma_d_over_d_median": median(good["sigma_d_um2_s"] / good["d_um2_s"]),
        "begin_inside": int((tracks["begins"] == "inside").sum()),
        "end_inside": int((tracks["ends"] == "inside").sum()),
        "cross_border": int(((tracks["begins"] == "border") | (tracks["ends"] == "border")).sum()),
        "crossed": int((tracks["nearest_nm"] < setup.near_nm).sum()),
    }


def make_films(
    context: AnalysisContext,
    movie: FrameSource,
    camera: Camera,
    windows: Sequence[Windows],
    fits: pd.DataFrame,
    tracks: pd.DataFrame,
) -> tuple[Film, ...]:
    """Draw the best and the worst tracks frame by frame."""
    numbers = track_numbers(fits)
    of_film = fits[list(_OF_FILM)].assign(track=numbers)
    chosen = [
        (track, why, _shown(of_film[of_film["track"] == track].sort_values("frame"), worst))
        for track, why, worst in _chosen(tracks)
    ]
    chosen = [film for film in chosen if len(film[2])]
    frames = np.unique([t for *_, rows in chosen for t in rows["frame"]])
    known = fits["frame"].isin(frames) & fits["mass_kda"].notna()
    there = fits.loc[known, list(_PLACE)]
    frame, x, y, z, mass = (there[name].to_numpy() for name in _PLACE)
    z = np.clip(z, *context.wide.z_range_nm)
    theta = np.column_stack([x, y, z, context.wide.scale.amplitudes(mass)])
    of_row = numbers[known].to_numpy()
    particles = [
        (model, frame[mine], theta[mine])
        for track, model in _models(context, tracks).items()
        if (mine := of_row == track).any()
    ]

    def single(frame: int) -> Windows:
        """Give one frame and its background, scaled to the power of the frame."""
        spans = ((w, w.frames_after) for w in windows)
        here = next((w for w, (first, last) in spans if first <= frame < last), windows[0])
        one = add_frames(here, camera, movie.read(frame, frame + 1), frame)
        if not context.config.background.power_normalization:
            return one
        if background_mode(context.config) != "tracks":
            return start_power(one)
        before, after = np.split(here.power, [here.n_before])
        power = float(after[frame - here.frames_after[0]] / before.sum())
        return replace(one, power_ratio=power)

    def film(track: int, why: str, shown: pd.DataFrame) -> Film:
        """Draw data, model and residual of some frames of a track, with all particles in them."""
        region, frames = _square(context, windows[0], shown), shown["frame"].to_numpy(int)
        grid = PixelGrid.region(region.rows, region.columns, context.pixel_nm)
        data, model, residual = np.zeros((3, len(frames), *region.shape))
        for own, when, places in particles:
            here = np.isin(when, frames)
            model[np.searchsorted(frames, when[here])] += signals_within(own, grid, places[here])
        for number, frame in enumerate(frames.tolist()):
            likelihood = region_likelihood(context, single(frame), region, None)
            data[number] = likelihood.measured_signal()
            information = likelihood.signal_information(model[number])
            residual[number] = (data[number] - model[number]) * np.sqrt(information)
            if context.additive:
                data[number] *= likelihood.data[2]
                model[number] *= likelihood.data[2]
        return Film(track, tuple(frames.tolist()), why, data, model, residual)

    return tuple(film(*each) for each in chosen)


def _models(context: AnalysisContext, tracks: pd.DataFrame) -> dict[int, ForwardModel]:
    """Make the model of each track, sharp or blurred by its motion, as it was fitted."""
    known = np.nan_to_num(tracks["d_um2_s"].to_numpy(float))
    if background_mode(context.config) != "tracks" and not context.model.is_sized:
        known[:] = 0.0
    exposure_s = exposure_of(context.config)
    upwards = context.config.track.heights_free
    return {
        int(track): blurred(context.wide, path_variance_nm2(d, exposure_s), upwards=upwards)
        for track, d in zip(tracks["track"], known, strict=True)
    }


def _chosen(tracks: pd.DataFrame) -> Iterator[tuple[int, str, bool]]:
    """Choose the tracks to show: the longest that are ok, and those with the most serious flags."""
    good = tracks[tracks["status"] == TrackStatus.OK].sort_values(
        ["n_frames", "mass_scatter"], ascending=[False, True]
    )
    for track, frames in good[["track", "n_frames"]].head(FILMS).to_numpy().tolist():
        yield track, f"one of the longest that are ok: {frames} frames", False
    rank = tracks["status"].map([str(status) for status in TrackStatus].index)
    bad = tracks.assign(rank=rank)[tracks["status"] != TrackStatus.OK]
    shown = bad[bad["status"] != TrackStatus.FEW_FRAMES].sort_values(
        ["rank", "n_frames"], ascending=[True, False]
    )
    for track, status in shown[["track", "status"]].head(FILMS).to_numpy().tolist():
        yield track, TrackStatus(status).advice, True
    rest = good.iloc[FILMS:].sort_values("mass_scatter", ascending=False)
    for row in rest[["track", "mass_scatter"]].head(max(0, FILMS - len(shown))).itertuples():
        text = f"ok; its frames scatter most, {row.mass_scatter:.2f} times their errors"
        yield int(row.track), text, True


def _shown(rows: pd.DataFrame, worst: bool) -> pd.DataFrame:
    """Choose the frames to show: the first ones, or those around the worst fit of a bad track."""
    if len(rows) < 2:  # not enough for a film
        return rows[:0]
    start = 0
    if worst and rows["chi2_reduced"].notna().any():
        start = int(np.nanargmax(rows["chi2_reduced"].to_numpy(float))) - FILM_FRAMES // 2
    start = max(0, min(start, len(rows) - FILM_FRAMES))
    return rows.iloc[start : start + FILM_FRAMES]


def _square(context: AnalysisContext, windows: Windows, rows: pd.DataFrame) -> Region:
    """Choose a square of the field around the median of the positions."""
    spans = []
    for name, size in zip(("y_px", "x_px"), windows.after_e.shape, strict=True):
        side = min(context.roi_px, size)
        middle = (rows[name].min() + rows[name].max()) / 2
        low = int(np.clip(round(middle - side / 2), 0, size - side))
        spans.append((low, low + side))
    return Region(*spans)
