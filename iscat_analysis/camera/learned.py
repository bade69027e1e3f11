"""The numbers of the camera, as far as configuration, metadata and movie tell them.

The frames of a movie from which its camera is learned: with light, and in the dark.

The numbers of the camera, as far as the movie tells them: learned once, before anything else.

What the configuration leaves at "auto" is measured from the first frames: offset and read noise
from frames in the dark where there are some, the offset otherwise from where the light of the
pixels ends, the gain from the noise.  What cannot be told keeps its stated assumption.  From here
on the configuration has numbers, whatever they come from.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera.background import find_text, without_text
from iscat_analysis.camera.counts import (
    Camera,
    camera_from_config,
    padded_bits,
    rounding_variance_adu2,
)
from iscat_analysis.camera.noise import (
    averaged_noise,
    diagnose_gain,
    measure_spectrum,
    without_pattern_jitter,
)
from iscat_analysis.camera.transfer import (
    TOLD,
    Law,
    Response,
    Transfer,
    find_law,
    full_scale,
    judge_zero,
    linear,
    measure_transfer,
    response_of,
)
from iscat_analysis.config import ASSUMED, AUTO, CameraConfig, Config, Optics, plausible_pixel
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.findings import Finding, existing
from iscat_analysis.findings import files as of_files
from iscat_analysis.findings.camera import GAIN_ASSUMED, OFFSET_FROM_NOISE
from iscat_analysis.movie import Stack
from iscat_analysis.records import BoolArray, CountSource, StackMetadata
from iscat_analysis.units import count

S = TypeVar("S", CameraConfig, Optics)

_MOST_FRAMES, _MOST_COUNTS = 1024, 2**23  # that are looked at: it takes a second
_LEAST_FRAMES = 8
_FIRST_FRAMES = 64  # that may be dark, and that tell of noise and motion
_DARK_LIGHT_SHARE = 0.5  # of the usual counts, below which a frame may be without light


def sample(
    movie: CountSource, span: tuple[int, int], pixels: int
) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """Read the first frames with light, without repeats, and those in the dark.

    Shapes: `lit` (t, y, x), `dark` (k, y, x).
    """

    def levels(numbers: Iterable[int]) -> dict[int, float]:
        frames = ((k, _finite(movie.read(k, k + 1))) for k in numbers)
        return {k: float(frame.mean()) for k, frame in frames if len(frame)}

    # frames all over the movie, by which the usual light is known
    every = levels(np.unique(np.linspace(span[0], span[1] - 1, 24).astype(int)).tolist())
    first = levels(range(min(_FIRST_FRAMES, movie.shape[0])))
    if not every or not first:
        return movie.read(0, 0), None
    usual = float(np.quantile([*every.values()], 0.75))
    means = np.array([*first.values()])
    dim = (means < _DARK_LIGHT_SHARE * usual) & (means > 0)
    dim &= means - means.min() < 0.01 * usual  # and no shutter that is opening
    most = max(_LEAST_FRAMES, min(_MOST_FRAMES, _MOST_COUNTS // pixels))
    counts = _finite(movie.read(span[0], min(span[1], span[0] + most)))
    lit = counts.mean(axis=(1, 2)) > _DARK_LIGHT_SHARE * usual
    repeats = np.array([False, *(np.array_equal(a, b) for a, b in pairwise(counts))][: len(counts)])
    counts = counts[lit & ~repeats]
    if not dim.any() or dim.all() or len(counts) < _LEAST_FRAMES:
        return counts, None
    dark = np.concatenate([movie.read(k, k + 1) for k in np.array([*first])[dim].tolist()])
    return counts, dark if _is_dark(dark, counts) else None


def _finite(frames: NDArray[Any]) -> NDArray[Any]:
    """Drop frames with pixels that are not numbers; these are handled later.

    Shapes: `frames` and result (t, y, x).
    """
    return np.asarray(frames[np.isfinite(frames).all(axis=(1, 2))])


def _is_dark(dark: NDArray[Any], lit: NDArray[Any]) -> bool:
    """Tell whether frames have neither the pattern of light nor its noise.

    Shapes: `dark` (k, y, x), `lit` (t, y, x).
    """
    as_light = float(dark.mean()) / float(lit.mean())  # if all of it were light
    apart, pattern = (part.mean(axis=0) - part.mean() for part in (dark, lit))
    power = float(np.sum(pattern**2))
    share = float(np.sum(apart * pattern)) / power if power > 0 else 0.0
    rest = float(np.mean((apart - share * pattern) ** 2))
    error = math.sqrt(rest / power) if power > 0 else math.inf
    if error < 0.1 * as_light:  # a tenth of what the counts would show, if they were light
        return abs(share) < 0.1 * as_light + 3 * error
    noise = noise_adu2(dark) if len(dark) > 1 else noise_adu2(np.moveaxis(dark, 2, 0))
    # half of the noise that its counts would have as light
    return noise < 0.5 * as_light * noise_adu2(lit)


def noise_adu2(counts: NDArray[Any]) -> float:
    """Half the mean square of what successive frames differ by, without the laser's flicker."""
    steps = np.diff(counts[:_FIRST_FRAMES].astype(np.float64), axis=0)
    steps -= steps.mean(axis=(1, 2), keepdims=True)
    return float(np.mean(steps**2)) / 2


MEASURED, DARK, CONFIGURED, METADATA = "measured", "dark frames", "configured", "metadata"
EFFECTIVE, ASSUMPTION, ROUNDING = "effective", "assumed", "rounding"
"""Where a number comes from."""

_READ_E, _READ_STEPS = 30.0, 3.0  # read noise that a camera may have without anybody saying so [e]
_WORD = 16  # bits of most files


@dataclass(frozen=True)
class Number:
    """A number of the camera, its standard error, and where it comes from."""

    value: float
    se: float
    source: str


@dataclass(frozen=True, eq=False)
class LearnedCamera:
    """A camera with numbers, and what the movie says of it."""

    config: CameraConfig
    camera: Camera
    numbers: Mapping[str, Number]
    findings: tuple[Finding, ...]
    level_e: float = 0.0
    refusal: str = ""
    response: Response | None = None
    text: BoolArray | None = None
    padded: int = 0

    def padding(self, name: str) -> Finding | None:
        """Tell that the camera's bits are not the lowest."""
        if not self.padded:
            return None
        return of_files.BITS_PADDED(
            {"step": 2**self.padded, "bits": _WORD - self.padded}, where=name
        )

    @property
    def description(self) -> str:
        """Describe the numbers and their sources in one line."""
        parts = []
        words = "{} e per count", "offset {} counts", "read noise {} e"
        for text, number in zip(words, (self.numbers[key] for key in ASSUMED), strict=True):
            shown = f"{number.value:.4g}"
            if number.se > 0 and number.source != CONFIGURED:
                shown += f" ± {number.se:.2g}"
            parts.append(f"{text.format(shown)} ({number.source})")
        return "camera: " + ", ".join(parts)

    @property
    def summary(self) -> dict[str, Any]:
        """What ``summary.json`` says of the camera."""
        found: dict[str, Any] = {
            key: {"value": number.value, "se": number.se, "from": number.source}
            for key, number in self.numbers.items()
        }
        if self.level_e:
            found["light_adu"] = self.level_e / float(np.mean(self.camera.gain_e_per_adu))
        law = self.camera.law
        if law is not None:
            shown = ("kind", "value", "se", "contrast", "contrast_se", "flickers")
            found["law"] = {key: getattr(law, key) for key in shown} | {"alike": [*law.alike]}
        return found


def with_camera(
    movie: Stack, config: Config, span: tuple[int, int]
) -> tuple[Stack, Config, LearnedCamera]:
    """Apply the response curve to a movie, and set the numbers of its camera."""
    text = find_text(movie, span)
    movie = linear(movie, config.camera)
    optics, pixel_nm = config.optics, config.camera.pixel_size_nm or math.inf
    resolved = pixel_nm < 0.4 * optics.wavelength_nm / optics.na  # finer than any detail of light
    learned = learn_camera(
        movie,
        config.camera,
        span,
        additive=not optics.interferes,
        moving=config.fit.follows_tracks and resolved,
        metadata=movie.metadata,
        text=text,
    )
    if learned.refusal:
        raise DataError(f"{movie.name}: {learned.refusal}")
    if text is not None:
        movie = without_text(movie, text, learned.camera)
    return movie, config.model_copy(update={"camera": learned.config}), learned


def learn_camera(
    movie: CountSource,
    config: CameraConfig,
    span: tuple[int, int],
    *,
    additive: bool = False,
    moving: bool = False,
    metadata: StackMetadata | None = None,
    text: BoolArray | None = None,
) -> LearnedCamera:
    """Learn the numbers of the camera from a movie.

    `additive` where there is no reference; `moving` where particles move in all frames.  Gain and
    offset of the file's metadata stand where they cannot be measured.  Rows with a burnt-in `text`
    tell nothing.
    """
    shape = (movie.shape[1], movie.shape[2])
    camera = camera_from_config(config, shape, movie.dtype)
    if config.response is not None:
        camera = replace(camera, full_scale_adu=full_scale(config, movie.dtype))
    free = {key for key in ASSUMED if getattr(config, key) == AUTO}
    counts, dark = sample(movie, span, math.prod(shape))
    rows = np.flatnonzero(np.ones(shape[0]) if text is None else ~text.any(axis=1))
    seen = camera.part((rows,)) if text is not None else camera
    counts, dark = counts[:, rows], None if dark is None else dark[:, rows]
    found = _Learning(seen, free, counts, additive, moving)
    if metadata is not None and config.response is None:
        found.take_metadata(metadata)
    if dark is not None:
        found.take_dark(dark)
    found.learn()
    as_before = (ASSUMPTION, CONFIGURED)
    numbers = found.numbers
    changed = {key: each.value for key, each in numbers.items() if each.source not in as_before}
    return LearnedCamera(
        config=config.assumed.model_copy(update=changed),
        camera=replace(camera, law=found.law, **changed),
        numbers=numbers,
        findings=tuple(found.findings),
        level_e=found.level_e,
        refusal=found.refusal,
        response=found.response(),
        text=text,
        padded=padded_bits(counts) if counts.dtype.itemsize * 8 == _WORD else 0,
    )


class _Learning:
    """The numbers of a camera while they are being measured."""

    def __init__(
        self, camera: Camera, free: set[str], counts: NDArray[Any], additive: bool, moving: bool
    ) -> None:
        self.camera, self.free, self.counts = camera, free, counts
        self.additive, self.moving = additive, moving
        self.law: Law | None = None
        self.transfer: Transfer | None = None
        self.findings: list[Finding] = []
        self.level_e, self.refusal = 0.0, ""
        sources = {key: ASSUMPTION if key in free else CONFIGURED for key in ASSUMED}
        self.numbers = {
            key: Number(float(np.mean(getattr(camera, key))), 0.0, source)
            for key, source in sources.items()
        }
        """Of maps, their means."""
        self._dark_variance: float | None = None

    @property
    def gain(self) -> float:
        """Photoelectrons per count, on average."""
        return self.numbers["gain_e_per_adu"].value

    def response(self) -> Response | None:
        """Make the response curve where the counts follow a known law that is not linear."""
        law, found = self.law, self.transfer
        if law is None or found is None or not law.bent or not law.certain:
            return None
        highest = float(self.counts.max())
        top = max(self.camera.full_scale_adu or highest, highest)
        return response_of(law, found, self.camera, top)

    def take_metadata(self, metadata: StackMetadata) -> None:
        """Take the numbers that the driver of the camera wrote into the file."""
        step = 2 ** padded_bits(self.counts)  # whose driver counts in its own bits
        for key, per in (("gain_e_per_adu", 1 / step), ("offset_adu", step)):
            value = getattr(metadata, key)
            if value is not None and key in self.free:
                self._set(key, value * per, 0.0, METADATA)

    def take_dark(self, dark: NDArray[Any]) -> None:
        """Take offset and read noise from frames without light.

        Shapes: `dark` (k, y, x).
        """
        if "offset_adu" in self.free:
            pixels = dark.mean(axis=0)
            error = float(np.std(pixels)) / math.sqrt(pixels.size)
            self._set("offset_adu", float(np.mean(pixels)), error, DARK)
        if "read_noise_e" in self.free and len(dark) > 1:
            variance = np.mean(np.diff(dark.astype(np.float64), axis=0) ** 2, axis=0) / 2
            # pixels with more noise in the dark are left out
            usual = variance < 4.0 * np.median(variance)
            self._dark_variance = float(variance[usual].mean()) if usual.any() else None

    def learn(self) -> None:
        """Measure what is not configured, on frames with light."""
        if len(self.counts) < 2:
            self._cannot("it has no two frames with light")
        elif self.additive:
            self._learn_slope()
        elif self._learn_gain():
            self._learn_law()
            self._mind_rounding()
            self._mind_zero()

    def _set(self, key: str, value: float, se: float, source: str) -> None:
        self.camera = replace(self.camera, **{key: value})  # type: ignore[arg-type]
        self.numbers[key] = Number(value, se, source)

    def _uncertain(self, se: float) -> None:
        """Set the error of an offset that is assumed."""
        self.numbers["offset_adu"] = replace(self.numbers["offset_adu"], se=se)

    def _cannot(self, why: str) -> None:
        """Say once that the gain keeps its default."""
        if self.numbers["gain_e_per_adu"].source == ASSUMPTION:
            self.findings.append(GAIN_ASSUMED({"why": why, "gain": ASSUMED["gain_e_per_adu"]}))

    def _learn_gain(self) -> bool:
        """Measure the gain; False where it cannot be."""
        quiet = self._dark_variance is None and not np.any(self.camera.read_noise_e)
        # rounding has no part in the gain
        fine = noise_adu2(self.counts) > 1e4 * rounding_variance_adu2(self.counts)
        for _ in range(1 if quiet and fine else 3):  # what is no light depends on the gain
            if self._dark_variance is not None:
                self._set("read_noise_e", self.gain * math.sqrt(self._dark_variance), 0.0, DARK)
            if "gain_e_per_adu" not in self.free:
                return True
            try:
                gain, error, source = self._gain()
            except DataError as why:
                self._cannot(str(why))
                return False
            self._set("gain_e_per_adu", gain, error, source)
        return True

    def _gain(self) -> tuple[float, float, str]:
        """Measure the gain by the noise between neighbouring frames, or by that of averages."""
        camera, counts = self.camera, self.counts[:128]  # to some parts in a thousand
        noise, step2 = noise_adu2(counts), 12 * rounding_variance_adu2(counts)
        if step2 and 0 < noise < 0.16 * step2:  # less is lost in rounding
            as_stored = counts.astype(np.float64)  # of which nothing is taken off for rounding
            found = diagnose_gain(as_stored, replace(camera, read_noise_e=0.0))
            return found.gain_e_per_adu, found.gain_se, EFFECTIVE
        if self.moving:
            return *_gain_of_detail(counts, camera), MEASURED
        found = diagnose_gain(counts, camera)
        gain, gain_se = found.gain_e_per_adu, found.gain_se
        seen = replace(camera, gain_e_per_adu=gain)
        longer = averaged_noise(counts, seen)
        if longer is not None:
            return gain / longer, gain_se / longer, EFFECTIVE
        few = counts[:_FIRST_FRAMES].astype(np.float64)
        with contextlib.suppress(DataError):
            calm = diagnose_gain(without_pattern_jitter(few, seen), seen)
            ratio = calm.noise_ratio / diagnose_gain(few, seen).noise_ratio
            # motion made that share of the noise at least
            if ratio < 1 - 0.03 - 3 * calm.noise_ratio_se:
                return gain / ratio, gain_se / ratio, MEASURED
        spectrum = measure_spectrum(counts, seen)
        if spectrum is not None and spectrum.correlated:
            ratio, se = spectrum.summed
            return gain / ratio, math.hypot(gain_se, gain * se / ratio) / ratio, MEASURED
        return gain, gain_se, MEASURED

    def _learn_slope(self) -> None:
        """Measure gain against light, where most of the counts are offset."""
        if "gain_e_per_adu" not in self.free:
            return
        found = measure_transfer(self.counts, self.camera)
        if found is None or found.noise is None:
            self._cannot("its pixels are too alike, or too dark")
            return
        slope, _ = np.polyfit(found.light, found.variance, 1, w=1 / found.variance_se)
        if slope > 0:
            gain = self.gain / float(slope)
            self._set("gain_e_per_adu", gain, gain * found.noise.se / found.level, MEASURED)

    def _learn_law(self) -> None:
        """Find the law of the counts, with offset and read noise where these are free."""
        self.transfer = found = measure_transfer(self.counts, self.camera)
        if found is None:
            return
        self.level_e = found.level
        level_adu = found.level / self.gain
        dark = self.numbers["offset_adu"].source in (DARK, METADATA)
        lowest = -self.numbers["offset_adu"].value / level_adu
        most_read = self._most_read_e2 / found.level
        self.law = law = find_law(found, most_read=most_read, least_offset=lowest)
        if dark:
            return
        if "offset_adu" in self.free:
            if law.kind == "offset" and abs(law.value) > 4 * law.se:
                self._take_offset(law, level_adu)
            elif law.kind == "linear":
                self._uncertain(law.se * level_adu)  # of the assumption
        if law.kind == "read noise" and "read_noise_e" in self.free:
            share, level = law.value, found.level
            if "gain_e_per_adu" in self.free:
                gain, se = self.gain * (1 + share), self.numbers["gain_e_per_adu"].se
                self._set("gain_e_per_adu", gain, se, MEASURED)
                level *= 1 + share
            read = math.sqrt(share * level)
            self._set("read_noise_e", read, read * law.se / (2 * share), MEASURED)
            self.law = None

    def _take_offset(self, law: Law, level_adu: float) -> None:
        """Take the offset from the zero of the light, and measure the rest again."""
        offset = self.numbers["offset_adu"].value + law.value * level_adu
        error = law.se * level_adu
        self._set("offset_adu", offset, error, MEASURED)
        self.free.discard("offset_adu")
        if not law.flickers:
            self.findings.append(OFFSET_FROM_NOISE({"offset": offset, "error": error}))
        self._learn_gain()
        self._learn_law()

    @property
    def _most_read_e2(self) -> float:
        """Variance of the read noise that a camera may have without anybody saying so."""
        steps = math.sqrt(12 * rounding_variance_adu2(self.counts))
        return max(_READ_E, _READ_STEPS * steps * self.gain) ** 2

    def _mind_zero(self) -> None:
        """Refuse counts without a true zero, where neither offset nor gain is known otherwise."""
        measured = self.numbers["gain_e_per_adu"].source in (MEASURED, EFFECTIVE)
        if self.numbers["offset_adu"].source != ASSUMPTION or not measured:
            return
        law = self.law
        if law is not None and law.below_nothing:
            level = self.level_e / self.gain
            counts, error = law.offset * level, law.contrast_se * level
            self.refusal = (
                "counts were subtracted from it: noise and flicker of the pixels show the zero of "
                f"the light at {counts:.0f} ± {error:.0f} counts, so that contrasts and masses "
                f"would be {law.contrast:.2g} times too large; give the camera's raw counts, or "
                f"set camera.offset_adu = {counts:.0f}"
            )
            return
        if law is not None and law.contrast_se <= TOLD:
            return
        zero = judge_zero(
            self.counts, self.camera, most_read_e2=self._most_read_e2, moving=self.moving
        )
        if zero is not None and zero.cause:
            self.refusal = (
                f"its counts do not tell where the light is zero: {zero.cause}.  Without that "
                "there are no contrasts and no masses.  Was the movie divided by its background, "
                "or was that taken off, and the result scaled?  Give the camera's raw counts, or "
                "set camera.offset_adu, the counts without light, and camera.gain_e_per_adu"
            )
        elif zero is not None and zero.error is not None:
            told = law.se if law is not None else math.inf
            self.level_e = zero.level_e
            self._uncertain(min(told, zero.error) * zero.level_e / self.gain)

    def _mind_rounding(self) -> None:
        """Count rounding as read noise, unless it is far below the noise of the light."""
        rounding = rounding_variance_adu2(self.counts) * self.gain**2 - 1 / 12
        light = float(np.median(self.camera.to_electrons(self.counts.mean(axis=0))))
        read = float(np.mean(np.square(self.camera.read_noise_e)))
        if self.numbers["gain_e_per_adu"].source != EFFECTIVE and rounding > max(
            read, 1e-3 * light
        ):
            self._set("read_noise_e", math.sqrt(rounding), 0.0, ROUNDING)


def _gain_of_detail(counts: NDArray[Any], camera: Camera) -> tuple[float, float]:
    """Give the gain by the noise of the finest detail, and its standard error.

    Light that interferes has no detail finer than λ/NA: where pixels are smaller than half of that,
    differences of neighbouring frames hold particles that moved, but not in the finest detail,
    which is taken by fourth differences along both axes.

    Shapes: `counts` (t, y, x).
    """
    light = camera.steady(counts)
    if light is None:
        raise DataError("a frame is dark")
    mean, dark = light.mean(axis=0), camera.dark_variance_e2(counts)
    # 70: the sum of the squares of 1, −4, 6, −4, 1, the norm of both axes together
    scale = 70.0 * np.sqrt(2 * np.maximum(mean + dark, 1.0))
    squares = [
        np.mean(np.diff(np.diff((after - before) / scale, 4, axis=0), 4, axis=1) ** 2)
        for before, after in pairwise(light)
    ]
    level, other = float(mean.mean()), float(dark.mean())
    ratio = (float(np.mean(squares)) * (level + other) - other) / level
    error = float(np.std(squares)) * (level + other) / level / math.sqrt(len(squares))
    gain = float(np.mean(camera.gain_e_per_adu))
    if ratio <= 0:
        raise DataError("the frames are no noisier than camera.read_noise_e alone")
    return gain / ratio, gain * error / ratio**2


def resolve_metadata(config: Config, metadata: StackMetadata) -> tuple[Config, list[Finding]]:
    """Set what the configuration leaves open from the metadata of the movie."""
    camera, notes = _of_file(config.camera, metadata, _CAMERA_KEYS)
    shown_hz = metadata.displayed_hz
    if config.fit.follows_tracks and shown_hz is not None and metadata.frame_rate_hz is None:
        notes.append(of_files.DISPLAYED_RATE({"shown_hz": shown_hz}))
    if metadata.ticks is not None:
        missing = metadata.ticks[-1] + 1 - len(metadata.ticks)
        dropped = {"frames": count(missing, "frame"), "source": metadata.source}
        notes.append(of_files.FRAMES_DROPPED(dropped))
    if camera.pixel_size_nm is None:
        raise DataError(
            "the pixel size is neither in the configuration nor in the movie's metadata; "
            "set camera.pixel_size_nm, as in camera.pixel_size_nm = 84.4"
        )
    optics, taken_from_file = _of_file(config.optics, metadata, _OPTICS_KEYS)
    of_file = config.camera.pixel_size_nm is None
    where = f"in the movie's {metadata.source} metadata" if of_file else "in the configuration"
    config = config.model_copy(update={"camera": camera, "optics": optics})
    return config, existing([*notes, *taken_from_file, _coarse_pixels(config, where)])


_CAMERA_KEYS = {
    "pixel_size_nm": ("pixel size", " nm"),
    "exposure_ms": ("exposure", " ms"),
    "frame_rate_hz": ("frame rate", " Hz"),
}
_OPTICS_KEYS = {"wavelength_nm": ("wavelength", " nm"), "na": ("NA", "")}
"""Keys that a file may tell: words for them, and how their unit is written."""


def _of_file(
    section: S, metadata: StackMetadata, keys: Mapping[str, tuple[str, str]]
) -> tuple[S, list[Finding]]:
    """Replace defaults of a section by the metadata of the movie, and say what disagrees."""
    found: dict[str, float] = {}
    notes: list[Finding] = []
    optics = isinstance(section, Optics)
    for key, (words, unit) in keys.items():
        given: float | None = getattr(section, key)
        read: float | None = getattr(metadata, key)
        if read is None or given == read:
            continue
        values: dict[str, float | str] = {"words": words, "read": read, "given": given or math.nan}
        name = "optics" if optics else "camera"
        values |= {"unit": unit, "source": metadata.source, "key": f"{name}.{key}"}
        if given == type(section).model_fields[key].default:
            found[key] = read
            if optics:
                notes.append(of_files.OPTICS_OF_FILE(values))
        # rounding aside; an NA that was measured is some percent below the engraved one
        elif given is not None and abs(read / given - 1) > (0.05 if optics else 0.01):
            notes.append(of_files.METADATA_DISAGREES(values))
    if "pixel_size_nm" in found:
        _refuse_unlikely(found["pixel_size_nm"], metadata.source)
    if not optics:
        return section.model_copy(update=found), notes
    try:
        return type(section)(**{**section.model_dump(), **found}), notes
    except ConfigError as error:
        raise DataError(
            f"the movie's {metadata.source} metadata do not suit the configuration: {error}"
        ) from None


def _coarse_pixels(config: Config, where: str) -> Finding | None:
    """Find pixels that are larger than the spot of a particle; refuse twice that size."""
    optics, pixel_nm = config.optics, config.camera.pixel_size_nm
    spot_nm = optics.wavelength_nm / (2 * optics.na)
    if pixel_nm is None or pixel_nm <= spot_nm:
        return None
    finding = of_files.COARSE_PIXELS({"pixel_nm": pixel_nm, "where": where, "spot_nm": spot_nm})
    if pixel_nm > 2 * spot_nm:
        problem = finding.text.partition(", so that")[0]
        raise DataError(
            f"{problem}; give its size in the sample plane, as in camera.pixel_size_nm = 84.4"
        )
    return finding


def _refuse_unlikely(pixel_nm: float, source: str) -> None:
    try:
        plausible_pixel(pixel_nm)
    except ValueError as error:
        raise DataError(
            f"the movie's {source} metadata: {error}, as in camera.pixel_size_nm = 84.4"
        ) from None
