"""Metadata of a movie, and whether its noise agrees with them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iscat_analysis.camera.counts import Camera
from iscat_analysis.camera.pattern_jitter import (
    MOST_EXPLAINED,
    PatternJitter,
    measure_pattern_jitter,
)
from iscat_analysis.config import Config, Optics, plausible_pixel
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.records import BoolArray, FloatArray, StackMetadata
from iscat_analysis.units import count

_DISAGREEMENT = 0.01  # relative, between configuration and metadata
_OPTICS_DISAGREEMENT = 0.05  # the aperture that was measured is some percent below the engraved one
_GAIN_TOLERANCE = 0.10  # of the noise variance, before the user is told
_GAIN_SIGMAS = 3.0  # and the excess over the tolerance that chance must not explain
_OUTLIER_SIGMAS = 8.0  # a blinking pixel, in standard deviations of one pixel's variance
_OUTLIER_FRAMES = 16  # fewer, and the variance of one pixel is too uncertain to call it an outlier


def resolve_metadata(config: Config, metadata: StackMetadata) -> tuple[Config, tuple[str, ...]]:
    """Set what the configuration leaves open from the metadata of the movie."""
    notes = []
    found: dict[str, float] = {}
    for key, unit, words in (
        ("pixel_size_nm", "nm", "pixel size"),
        ("exposure_ms", "ms", "exposure"),
        ("frame_rate_hz", "Hz", "frame rate"),
    ):
        given: float | None = getattr(config.camera, key)
        read: float | None = getattr(metadata, key)
        if read is None:
            continue
        if given is None:
            if key == "pixel_size_nm":
                _refuse_unlikely(read, metadata.source)
            found[key] = read
        elif abs(read / given - 1) > _DISAGREEMENT:
            notes.append(
                f"the {words} is {given:g} {unit} in the configuration (camera.{key}) but "
                f"{read:g} {unit} in the movie's {metadata.source} metadata; "
                "the configuration is used"
            )
    shown_hz = metadata.displayed_hz
    if config.fit.mode == "track" and shown_hz is not None and metadata.frame_rate_hz is None:
        notes.append(
            f"the {shown_hz:g} frames per second in the file are the speed at which ImageJ shows "
            "the movie, which tells nothing of the camera, and are not used"
        )
    if metadata.ticks is not None:
        missing = metadata.ticks[-1] + 1 - len(metadata.ticks)
        notes.append(
            f"the camera dropped {count(missing, 'frame')}, by the times in the movie's "
            f"{metadata.source} metadata; diffusion coefficients and rates count the time that "
            "passed"
        )
    if config.camera.pixel_size_nm is None and "pixel_size_nm" not in found:
        raise DataError(
            "the pixel size is neither in the configuration nor in the movie's metadata; "
            "set camera.pixel_size_nm, as in camera.pixel_size_nm = 84.4"
        )
    camera = config.camera.model_copy(update=found)
    optics, taken_from_file = _with_optics(config.optics, metadata)
    notes += taken_from_file
    config = config.model_copy(update={"camera": camera, "optics": optics})
    source = f"in the movie's {metadata.source} metadata" if "pixel_size_nm" in found else ""
    return config, (*notes, *_coarse_pixels(config, source or "in the configuration"))


def _with_optics(optics: Optics, metadata: StackMetadata) -> tuple[Optics, list[str]]:
    """Replace defaults of the optics by the metadata of the movie."""
    found: dict[str, float] = {}
    notes = []
    for key, unit, words in (("wavelength_nm", " nm", "wavelength"), ("na", "", "NA")):
        given: float = getattr(optics, key)
        read: float | None = getattr(metadata, key)
        if read is None:
            continue
        where = f"in the movie's {metadata.source} metadata"
        if given == read:
            continue
        if given == type(optics).model_fields[key].default:
            found[key] = read
            notes.append(
                f"the {words} is {read:g}{unit}, as {where}, and not {given:g}{unit}, which is "
                f"the default of optics.{key}"
            )
        elif abs(read / given - 1) > _OPTICS_DISAGREEMENT:
            notes.append(
                f"the {words} is {given:g}{unit} in the configuration (optics.{key}) but "
                f"{read:g}{unit} {where}; the configuration is used"
            )
    if not found:
        return optics, notes
    try:
        return Optics(**{**optics.model_dump(), **found}), notes
    except ConfigError as error:
        raise DataError(
            f"the movie's {metadata.source} metadata do not suit the configuration: {error}"
        ) from None


def _coarse_pixels(config: Config, where: str) -> Iterator[str]:
    """Warn that pixels are larger than the spot of a particle; refuse twice that size."""
    optics, pixel_nm = config.optics, config.camera.pixel_size_nm
    spot_nm = optics.wavelength_nm / (2 * optics.na)
    if pixel_nm is None or pixel_nm <= spot_nm:
        return
    problem = (
        f"a pixel of {pixel_nm:g} nm, as {where}, is larger than the spot of a particle is wide: "
        f"about {spot_nm:.3g} nm, optics.wavelength_nm over twice optics.na"
    )
    advice = "give its size in the sample plane, as in camera.pixel_size_nm = 84.4"
    if pixel_nm > 2 * spot_nm:
        raise DataError(f"{problem}; {advice}")
    yield f"{problem}, so that pictures are not resolved; unless it was binned so far, {advice}"


def _refuse_unlikely(pixel_nm: float, source: str) -> None:
    try:
        plausible_pixel(pixel_nm)
    except ValueError as error:
        raise DataError(
            f"the movie's {source} metadata: {error}, as in camera.pixel_size_nm = 84.4"
        ) from None


@dataclass(frozen=True)
class GainDiagnosis:
    """Measured noise over that of the configured gain."""

    noise_ratio: float
    noise_ratio_se: float
    configured_gain: float
    gain_e_per_adu: float
    gain_se: float
    n_frames: int
    n_pixels: int
    noise_counts: float = math.inf
    pattern_jitter: PatternJitter | None = None

    @property
    def off(self) -> bool:
        """Whether the gain is wrong by more than 10 %, and chance does not explain it."""
        return abs(self.noise_ratio - 1) > _GAIN_TOLERANCE + _GAIN_SIGMAS * self.noise_ratio_se

    @property
    def shakes(self) -> bool:
        """Whether motion of the fixed pattern explains most of an excess."""
        return (
            self.off
            and self.pattern_jitter is not None
            and self.pattern_jitter.share > MOST_EXPLAINED
        )

    @property
    def message(self) -> str | None:
        """One sentence for the user where the gain is off; else None."""
        if not self.off:
            return None
        problem = (
            f"the noise variance is {self.noise_ratio:.3g} ± {self.noise_ratio_se:.1g} times what "
            f"camera.gain_e_per_adu = {self.configured_gain:.4g} predicts"
        )
        if self.noise_counts < 1:
            return (
                f"{problem}, but the noise is smaller than a count ({self.noise_counts:.2g}) and "
                "rounding hides it: record or export the movie with more bits"
            )
        if self.pattern_jitter is not None and self.shakes:
            return (
                f"{problem}; the gain is not the cause: the fixed pattern shakes by "
                f"{self.pattern_jitter.rms_px:.2g} pixels from frame to frame, which explains "
                f"{min(self.pattern_jitter.share, 1.0):.0%} of what is too much: damp vibrations "
                "of the stage and the beam"
            )
        # Noise that grows with the light itself can only add, so only an excess has two causes.
        cause = "unless the light itself is noisy, " if self.noise_ratio > 1 else ""
        return f"{problem}; {cause}set camera.gain_e_per_adu = {self.gain_e_per_adu:.4g}"


def diagnose_gain(
    counts: NDArray[Any], camera: Camera, *, masked: ArrayLike | None = None
) -> GainDiagnosis:
    r"""Measure the gain from the noise of frames in which nothing happens.

    Let e_kp be the photoelectrons that the configured gain g makes of pixel p in frame k, g₀ the
    true gain, and r = g/g₀.  Then e_kp = r·N_kp + read noise, N_kp Poisson of mean ρ_k·μ_p, with
    ρ_k the relative laser power, so that

        E e_kp = r·ρ_k·μ_p,        Var e_kp = r²·ρ_k·μ_p + σ_r² .

    Dividing by ρ_k, measured as the frame's total over the mean total, removes the power noise.
    The difference d_kp of successive normalised frames loses everything static as well, and

        E d_kp² = r·m_p·(1/ρ_k + 1/ρ_{k+1})·(1 − Σ_q w_q²) + σ_r²·(1/ρ_k² + 1/ρ_{k+1}²),

    with m_p = r·μ_p the mean normalised frame and w = μ/Σμ.  The factor in w is exact for pure shot
    noise, when the counts given their total are multinomial: normalising by the total costs one
    degree of freedom.  Summed over pairs and pixels, with the read noise taken off,

        R = Σ_p a_p / Σ_p b_p  →  r,      a_p = Σ_k d_kp² − read noise,   b_p = the terms in m_p,

    (half the variance of a difference over the mean, weighted by the light).  Pixels are
    independent, so the standard error is that of a ratio over pixels, √Σ(a_p − R·b_p)² / Σ b_p; it
    holds although successive differences share a frame.

    Shapes: `counts` (t, y, x), `masked` (y, x).
    """
    n_frames = len(counts)
    if n_frames < 2:
        raise DataError(
            f"the gain needs two background frames or more to be measured, not {n_frames}"
        )
    used = np.ones(counts.shape[1:], dtype=np.bool_)
    if masked is not None:
        used &= ~np.asarray(masked, dtype=np.bool_)
    for frame in counts:
        used &= ~camera.saturated(frame)
    total = np.zeros(counts.shape[1:])
    for frame in counts:
        total += camera.to_electrons(frame)
    used &= total > 0
    if np.count_nonzero(used) < 2:
        raise DataError("the gain cannot be measured: no pixel is lit and unsaturated throughout")

    power = np.array([camera.to_electrons(frame)[used].sum() for frame in counts])
    if power.min() <= 0:
        raise DataError(
            f"the gain cannot be measured: background frame {int(power.argmin())} is dark"
        )
    power /= power.mean()
    mean = total[used] / n_frames
    share = mean / mean.sum()
    squares = np.zeros(mean.shape)
    before = camera.to_electrons(counts[0])[used] / power[0]
    for number in range(1, n_frames):
        after = camera.to_electrons(counts[number])[used] / power[number]
        squares += np.square(after - before)
        before = after
    shot = float(np.sum(1 / power[:-1] + 1 / power[1:]))
    read = float(np.sum(1 / power[:-1] ** 2 + 1 / power[1:] ** 2))
    excess = squares - read * camera.dark_variance_e2(counts)[used]
    expected = shot * (1 - float(np.sum(share**2))) * mean

    kept = _without_outliers(excess / expected, n_frames)
    excess, expected = excess[kept], expected[kept]
    ratio = float(excess.sum() / expected.sum())
    if ratio <= 0:
        raise DataError(
            "the gain cannot be measured: the frames are no noisier than camera.read_noise_e "
            "alone; lower it"
        )
    ratio_se = float(np.sqrt(np.sum((excess - ratio * expected) ** 2)) / expected.sum())
    gain = np.broadcast_to(camera.gain_e_per_adu, counts.shape[1:])[used][kept]
    configured = float(gain.mean())
    whole = np.issubdtype(counts.dtype, np.integer)
    per_count = np.sqrt(np.sum(excess) / (shot * len(excess))) / configured
    found = GainDiagnosis(
        noise_ratio=ratio,
        noise_ratio_se=ratio_se,
        configured_gain=configured,
        gain_e_per_adu=configured / ratio,
        gain_se=configured * ratio_se / ratio**2,
        n_frames=n_frames,
        n_pixels=int(np.count_nonzero(kept)),
        noise_counts=float(per_count) if whole else math.inf,
    )
    return with_pattern_jitter(found, counts, camera, masked=~used)


def with_pattern_jitter(
    found: GainDiagnosis, counts: NDArray[Any], camera: Camera, *, masked: BoolArray | None
) -> GainDiagnosis:
    """Measure how much of an excess of noise the motion of the fixed pattern explains.

    Shapes: `counts` (t, y, x), `masked` (y, x).
    """
    if not found.off or found.noise_ratio < 1 or found.pattern_jitter is not None:
        return found
    return replace(found, pattern_jitter=measure_pattern_jitter(counts, camera, masked=masked))


def _without_outliers(ratios: FloatArray, n_frames: int) -> BoolArray:
    """Leave out blinking pixels, whose variance would outweigh that of all others."""
    if n_frames < _OUTLIER_FRAMES:
        return np.ones(ratios.shape, dtype=np.bool_)
    # Relative spread of half the mean squared successive difference of normal numbers
    # (von Neumann et al., Ann. Math. Stat. 12, 153, 1941).
    spread = math.sqrt(3 * n_frames - 4) / (n_frames - 1)
    centre = float(np.median(ratios))
    kept: BoolArray = ratios <= centre * (1 + _OUTLIER_SIGMAS * spread)
    return kept if centre > 0 else np.ones(ratios.shape, dtype=np.bool_)
