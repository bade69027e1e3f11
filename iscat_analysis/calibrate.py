"""Counts become photoelectrons: the camera, what a file says of it, and whether that is believable.

A camera of gain g [e/count], offset o [counts] and read noise σ_r [e] turns N photoelectrons into
c = o + (N + σ_r·n)/g counts, n standard normal.  `Camera` undoes it; `diagnose_gain` measures g
from the noise itself; `check_counts` refuses numbers that no such camera produces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import ArrayLike, DTypeLike, NDArray

from iscat_analysis.config import CameraConfig, Config
from iscat_analysis.errors import DataError
from iscat_analysis.records import BoolArray, FloatArray, StackMetadata

_DISAGREEMENT = 0.01  # relative, between configuration and metadata
_NEGATIVE_SIGMAS = 6.0  # 1e-9 of pixels in the dark
_NEGATIVE_FRACTION = 0.01  # more pixels below the offset than a sensor has dead ones
_GAIN_TOLERANCE = 0.10  # of the noise variance, before the user is told
_GAIN_SIGMAS = 3.0  # and the excess over the tolerance that chance must not explain
_OUTLIER_SIGMAS = 8.0  # a blinking pixel, in standard deviations of one pixel's variance
_OUTLIER_FRAMES = 16  # fewer, and the variance of one pixel is too uncertain to call it an outlier


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera; `camera_from_config` makes it.

    Attributes
    ----------
    gain_e_per_adu : float or ndarray, shape (y, x)
        Photoelectrons per count [e/count].
    offset_adu : float or ndarray, shape (y, x)
        Counts in the dark [counts].
    read_noise_e : float or ndarray, shape (y, x)
        Standard deviation per frame [e].
    well_depth_e : float or None
        Full well [e]; None where unknown.
    full_scale_adu : float or None
        Largest number the stored type can hold [counts]; None for floats.
    """

    gain_e_per_adu: float | FloatArray = 1.0
    offset_adu: float | FloatArray = 0.0
    read_noise_e: float | FloatArray = 0.0
    well_depth_e: float | None = None
    full_scale_adu: float | None = None

    def to_electrons(self, counts: NDArray[Any]) -> FloatArray:
        """Convert counts to photoelectrons.

        Parameters
        ----------
        counts : ndarray, shape (..., y, x)
            As stored [counts].

        Returns
        -------
        ndarray of float64, shape (..., y, x)
            (counts − offset)·gain [e].
        """
        electrons = np.array(counts, dtype=np.float64)
        electrons -= self.offset_adu
        electrons *= self.gain_e_per_adu
        return electrons

    def saturated(self, counts: NDArray[Any]) -> BoolArray:
        """Find the pixels that were too bright to be measured.

        Parameters
        ----------
        counts : ndarray, shape (..., y, x)
            As stored [counts].

        Returns
        -------
        ndarray of bool, shape (..., y, x)
            At or above the well depth, or at the full scale of the stored type.
        """
        full = np.zeros(np.shape(counts), dtype=np.bool_)
        if self.full_scale_adu is not None:
            full |= counts >= self.full_scale_adu
        if self.well_depth_e is not None:
            full |= self.to_electrons(counts) >= self.well_depth_e
        return full

    def read_variance_e2(self, shape: tuple[int, int]) -> FloatArray:
        """Variance of the read noise of one frame.

        Parameters
        ----------
        shape : (int, int)
            Rows and columns.

        Returns
        -------
        ndarray, shape (y, x)
            σ_r² [e²].
        """
        return np.broadcast_to(np.square(self.read_noise_e, dtype=np.float64), shape).copy()


def camera_from_config(config: CameraConfig, shape_yx: tuple[int, int], dtype: DTypeLike) -> Camera:
    """Build the camera that a configuration describes, reading its maps.

    Parameters
    ----------
    config : CameraConfig
        The section ``[camera]``.
    shape_yx : (int, int)
        Rows and columns of the movie, which every map must have.
    dtype : dtype
        Type of the stored counts; the largest integer it holds is full scale.

    Returns
    -------
    Camera
        With a (y, x) map wherever the configuration names a file.

    Raises
    ------
    DataError
        A map cannot be read, has another shape, or holds values that are impossible.
    """
    stored = np.dtype(dtype)
    full_scale = float(np.iinfo(stored).max) if np.issubdtype(stored, np.integer) else None
    return Camera(
        gain_e_per_adu=_number_or_map(config.gain_e_per_adu, "gain_e_per_adu", shape_yx),
        offset_adu=_number_or_map(config.offset_adu, "offset_adu", shape_yx),
        read_noise_e=_number_or_map(config.read_noise_e, "read_noise_e", shape_yx),
        well_depth_e=config.well_depth_e,
        full_scale_adu=full_scale,
    )


def _number_or_map(value: float | str, key: str, shape_yx: tuple[int, int]) -> float | FloatArray:
    if not isinstance(value, str):
        return value
    where = f"{value}: camera.{key}"
    path = Path(value)
    if not path.is_file():
        raise DataError(f"{where} names a file that does not exist; check the path")
    try:
        image = np.squeeze(tifffile.imread(path))
    except (ValueError, RuntimeError, TypeError, IndexError, KeyError, OSError) as error:
        raise DataError(f"{where} needs a TIFF map, but it cannot be read ({error})") from None
    if image.shape != tuple(shape_yx):
        shown = " x ".join(str(n) for n in image.shape) or "one number"
        raise DataError(
            f"{where} is a map of {shown} pixels but the movie has {shape_yx[0]} x {shape_yx[1]}; "
            "crop the map as the movie was cropped"
        )
    if image.dtype.kind not in "uif":
        raise DataError(f"{where} holds {image.dtype} values; save the map as real numbers")
    values: FloatArray = image.astype(np.float64)
    bad = ~np.isfinite(values)
    if bad.any():
        raise DataError(f"{where} is not finite {_first(bad)}; repair the map")
    if key == "gain_e_per_adu" and (bad := values <= 0).any():
        raise DataError(f"{where} must be positive, but is not {_first(bad)}; repair the map")
    if key == "read_noise_e" and (bad := values < 0).any():
        raise DataError(f"{where} must not be negative, but is {_first(bad)}; repair the map")
    return values


def _first(bad: BoolArray) -> str:
    """Say how many pixels are bad and where the first one is."""
    y, x = np.unravel_index(int(np.argmax(bad)), bad.shape)
    count = int(np.count_nonzero(bad))
    return f"in {count} {'pixel' if count == 1 else 'pixels'}, the first at y = {y}, x = {x}"


def resolve_metadata(config: Config, metadata: StackMetadata) -> tuple[Config, tuple[str, ...]]:
    """Fill what the configuration leaves out from what the movie says of itself.

    Parameters
    ----------
    config : Config
        It wins wherever both speak.
    metadata : StackMetadata
        Of the movie.

    Returns
    -------
    Config
        With a pixel size, and an exposure and a frame rate where either knows them.
    tuple of str
        One sentence for each disagreement by more than 1 %.

    Raises
    ------
    DataError
        Neither gives the pixel size.
    """
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
            found[key] = read
        elif abs(read / given - 1) > _DISAGREEMENT:
            notes.append(
                f"the {words} is {given:g} {unit} in the configuration (camera.{key}) but "
                f"{read:g} {unit} in the movie's {metadata.source} metadata; "
                "the configuration is used"
            )
    if config.camera.pixel_size_nm is None and "pixel_size_nm" not in found:
        raise DataError(
            "the pixel size is neither in the configuration nor in the movie's metadata; "
            "set camera.pixel_size_nm, as in --set camera.pixel_size_nm=84.4"
        )
    camera = config.camera.model_copy(update=found)
    return config.model_copy(update={"camera": camera}), tuple(notes)


def check_counts(
    counts: NDArray[Any], first_frame: int, name: str, *, camera: Camera | None = None
) -> None:
    """Refuse frames that no working camera produces.

    A few pixels below the offset may be dead, and later stages mask them; a camera never counts
    below zero, so there one pixel is proof that the frames are not raw.

    Parameters
    ----------
    counts : ndarray, shape (t, y, x)
        As stored [counts].
    first_frame : int
        Number of the first of them in the movie.
    name : str
        What the message calls the movie.
    camera : Camera, optional
        Gives offset, read noise and saturation; without it, gain 1, offset 0, no read noise and the
        full scale of the type.

    Raises
    ------
    DataError
        A frame holds NaN or infinity, is zero throughout or saturated throughout, or lies further
        below the offset than six standard deviations of the read noise: in one pixel if the count
        itself is negative, otherwise in more than 1 % of the pixels.
    """
    if camera is None:
        integer = np.issubdtype(counts.dtype, np.integer)
        camera = Camera(full_scale_adu=float(np.iinfo(counts.dtype).max) if integer else None)
    lowest, highest = counts.min(axis=(1, 2)), counts.max(axis=(1, 2))
    floor = _negative_floor_adu(camera, counts.dtype)
    ceiling = _ceiling_adu(camera)
    for number in range(len(counts)):
        frame = counts[number]
        where = f"{name}: frame {first_frame + number}"
        low, high = float(lowest[number]), float(highest[number])
        if not (math.isfinite(low) and math.isfinite(high)):
            bad = ~np.isfinite(frame)
            raise DataError(
                f"{where} is NaN or infinite {_first(bad)}; "
                "leave the frame out or export the movie again"
            )
        if low == high == 0:
            raise DataError(
                f"{where} is zero throughout; it was dropped by the camera: leave it out"
            )
        if low < float(np.max(floor)):
            _refuse_negative(frame, floor, where)
        if low >= float(np.min(ceiling)) and bool(np.all(frame >= ceiling)):
            raise DataError(
                f"{where} is saturated throughout; lower the exposure or the laser power, "
                "or correct camera.well_depth_e"
            )


def _refuse_negative(frame: NDArray[Any], floor: float | FloatArray, where: str) -> None:
    below = np.asarray(frame < floor)
    if not (below & (frame < 0)).any() and below.mean() <= _NEGATIVE_FRACTION:
        return
    raise DataError(
        f"{where} lies below the camera's offset by more than its read noise {_first(below)} "
        f"(lowest count {float(frame.min()):g}); give raw counts, or correct camera.offset_adu and "
        "camera.read_noise_e"
    )


def _negative_floor_adu(camera: Camera, dtype: np.dtype[Any]) -> float | FloatArray:
    """Lowest believable count: offset less six standard deviations of read noise and rounding."""
    rounding = 1 / 12 if np.issubdtype(dtype, np.integer) else 0.0
    sigma = np.sqrt(np.square(np.divide(camera.read_noise_e, camera.gain_e_per_adu)) + rounding)
    floor: float | FloatArray = camera.offset_adu - _NEGATIVE_SIGMAS * sigma
    return floor


def _ceiling_adu(camera: Camera) -> float | FloatArray:
    """Count from which a pixel is saturated."""
    ceiling: float | FloatArray = math.inf
    if camera.well_depth_e is not None:
        ceiling = camera.offset_adu + np.divide(camera.well_depth_e, camera.gain_e_per_adu)
    return ceiling if camera.full_scale_adu is None else np.minimum(ceiling, camera.full_scale_adu)


@dataclass(frozen=True)
class GainDiagnosis:
    """Measured noise beside what the configured gain predicts.

    Attributes
    ----------
    noise_ratio : float
        R, measured noise variance over the predicted; 1 where gain and reality agree.
    noise_ratio_se : float
        Its standard error.
    configured_gain : float
        Mean of the configured gain over the pixels used [e/count].
    gain_e_per_adu : float
        Gain that would explain the noise, `configured_gain`/R [e/count].
    gain_se : float
        Its standard error [e/count].
    n_frames, n_pixels : int
        What was used.
    """

    noise_ratio: float
    noise_ratio_se: float
    configured_gain: float
    gain_e_per_adu: float
    gain_se: float
    n_frames: int
    n_pixels: int

    @property
    def off(self) -> bool:
        """Whether the gain is wrong by more than 10 %, and chance does not explain it."""
        return abs(self.noise_ratio - 1) > _GAIN_TOLERANCE + _GAIN_SIGMAS * self.noise_ratio_se

    @property
    def message(self) -> str | None:
        """One sentence for the user where the gain is off; else None."""
        if not self.off:
            return None
        # Noise that grows with the light itself can only add, so only an excess has two causes.
        cause = "unless the light itself is noisy, " if self.noise_ratio > 1 else ""
        return (
            f"the noise variance is {self.noise_ratio:.3g} ± {self.noise_ratio_se:.1g} times what "
            f"camera.gain_e_per_adu = {self.configured_gain:.4g} predicts; {cause}"
            f"set camera.gain_e_per_adu = {self.gain_e_per_adu:.4g}"
        )


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

    Parameters
    ----------
    counts : ndarray, shape (t, y, x)
        Successive background frames, t ≥ 2 [counts].
    camera : Camera
        As configured.
    masked : array_like of bool, shape (y, x), optional
        Pixels to leave out; saturated ones always are, and from 16 frames on those whose noise is
        far from their neighbours'.

    Returns
    -------
    GainDiagnosis
        The ratio R, its standard error, and the gain g/R.

    Raises
    ------
    DataError
        There are fewer than two frames, no light, or no noise beyond the read noise.
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
    excess = squares - read * camera.read_variance_e2(counts.shape[1:])[used]
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
    return GainDiagnosis(
        noise_ratio=ratio,
        noise_ratio_se=ratio_se,
        configured_gain=configured,
        gain_e_per_adu=configured / ratio,
        gain_se=configured * ratio_se / ratio**2,
        n_frames=n_frames,
        n_pixels=int(np.count_nonzero(kept)),
    )


def _without_outliers(ratios: FloatArray, n_frames: int) -> BoolArray:
    """Leave out pixels that blink, whose variance would outweigh all the others'."""
    if n_frames < _OUTLIER_FRAMES:
        return np.ones(ratios.shape, dtype=np.bool_)
    # Relative spread of half the mean squared successive difference of normal numbers
    # (von Neumann et al., Ann. Math. Stat. 12, 153, 1941).
    spread = math.sqrt(3 * n_frames - 4) / (n_frames - 1)
    centre = float(np.median(ratios))
    kept: BoolArray = ratios <= centre * (1 + _OUTLIER_SIGMAS * spread)
    return kept if centre > 0 else np.ones(ratios.shape, dtype=np.bool_)
