"""From a bare movie to a configuration: what the file says, what is measured, what is asked.

`write_setup` writes ``iscat.toml`` beside the movie, where `iscat-fit` finds it.  Every value in it
has its origin beside it: read from the file, measured from the movie, your answer, a named
instrument, assumed, or to be given; and whether it will be learned from the movie's particles.
Then the search looks at some frames, so that one sees whether the values make sense.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from iscat_analysis.camera import ASSUMPTION, METADATA, LearnedCamera
from iscat_analysis.camera import MEASURED as BY_NOISE
from iscat_analysis.config import AUTO, Config, configure, instruments, toml_value
from iscat_analysis.diagnosis import as_moving, look_at_changes
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.files import whole_file
from iscat_analysis.instrument.learning import why_not
from iscat_analysis.medians import robust_sigma
from iscat_analysis.movie import Stack, open_stack, setup_beside
from iscat_analysis.pipeline.preview import Preview
from iscat_analysis.records import StackMetadata
from iscat_analysis.text import in_toml
from iscat_analysis.units import count

ANSWER, DEFAULT, MEASURED = "your answer", "assumed", "measured from the movie"
READ, TO_GIVE = "read from the file", "to be given, by `iscat calibrate mass`"
"""Where a value comes from."""

SAMPLES = ("protein", "gold", "silica", "polystyrene")
"""Kinds of samples: what the particles are made of."""


@dataclass(frozen=True)
class Question:
    """A key that only the user may know, and its default; None where there is none."""

    key: str
    words: str
    default: float | str | None
    choices: tuple[str, ...] = ()


_DEFAULTS = Config()  # what is taken where nobody says anything
_QUESTIONS = (
    Question("camera.pixel_size_nm", "size of a pixel in the sample plane [nm]", None),
    Question("optics.wavelength_nm", "wavelength in vacuum [nm]", _DEFAULTS.optics.wavelength_nm),
    Question("optics.na", "numerical aperture of the objective", _DEFAULTS.optics.na),
    Question("particle.kind", "kind of sample", _DEFAULTS.particle.kind, SAMPLES),
)
_STANDING = ("optics.focus_nm", "optics.n_immersion", "optics.n_sample")  # may have to be changed
_LEARNED = {  # from the particles of a movie
    "optics.focus_nm": "will be learned",
    "optics.na": "will be learned",
    "optics.n_immersion": "an error of it will be learned as an aberration",
}
_SECTIONS = ("optics", "camera", "particle")  # of an instrument that a movie has to have
_CALIBRATION = "calibration.gradient_per_kda"
_EACH_MOVIE = ("camera.exposure_ms", "camera.frame_rate_hz")  # left to the metadata of each
_ORIGINS = {ASSUMPTION: DEFAULT, METADATA: READ, BY_NOISE: MEASURED}
_CAMERA = ("camera.gain_e_per_adu", "camera.offset_adu", "camera.read_noise_e")


@dataclass(frozen=True)
class Value:
    """A key of the configuration, its value, and its origin.

    Where it is not `written`, the file has it as a comment, because it is read from each movie.
    """

    key: str
    value: float | str
    origin: str
    se: float | None = None
    written: bool = True

    @property
    def shown(self) -> str:
        """The value as text, with its standard error where there is one."""
        if isinstance(self.value, str):
            return self.value
        return f"{self.value:.4g}" + (f" ± {self.se:.2g}" if self.se else "")


@dataclass(frozen=True)
class Setup:
    """What `write_setup` found, and the file that it wrote."""

    movie: str
    shape: tuple[int, int, int]
    values: tuple[Value, ...]
    config: Config
    notes: tuple[str, ...]
    preview: Mapping[str, Any]
    out: Path

    def to_dict(self) -> dict[str, Any]:
        """Give it as the document ``init``."""
        return {
            "movie": self.movie,
            "shape": list(self.shape),
            "values": {
                each.key: {"value": each.value, "se": each.se, "from": each.origin}
                for each in self.values
            },
            "notes": list(self.notes),
            "preview": dict(self.preview),
            "out": str(self.out),
        }


def write_setup(
    movie: Path,
    *,
    answers: Mapping[str, float | str] | None = None,
    ask: Callable[[Question], str] | None = None,
    instrument: str | None = None,
    note: Callable[[str], None] = lambda _: None,
    out: Path | None = None,
    overwrite: bool = False,
) -> Setup:
    """Write a configuration for a movie, and look at some of its frames with it.

    `answers` are keys of the configuration and what the user has said already; `ask` puts the
    questions that are left, and without it defaults are taken, or before these what a named
    `instrument` has; `note` is told what is known, line by line.
    """
    target = setup_beside(movie) if out is None else out
    if target.exists() and not overwrite:
        raise DataError(f"{target}: exists already; give another name, or pass `overwrite`")
    with open_stack(movie) as stack:
        frames, rows, columns = stack.shape
        note(f"{stack.name}: {frames} frames of {rows} × {columns} pixels, {stack.dtype}")
        known = _known_values(stack.metadata, answers or {}, instrument)
        note(_metadata_line(stack))
        values, config = _ask_the_rest(known, ask, note)
        if config.camera.pixel_size_nm is None:
            raise DataError(
                f"{stack.name}: its metadata do not say how large a pixel is, which nobody can "
                "guess: give `pixel_size_nm`, in the sample plane"
            )
        here = {each.key for each in values}
        values += [
            Value(key, attrgetter(key)(_DEFAULTS), DEFAULT) for key in _STANDING if key not in here
        ]
        preview = Preview(stack, config)
        mode, preview = _mode_of(preview, stack, config)
        values = [_with_learning(each, preview.config) for each in values]
        values += [mode, *_each_movie(stack.metadata), *_camera_values(preview.camera)]
        values.append(Value(_CALIBRATION, "", TO_GIVE, written=False))
        found = Setup(
            movie=stack.name,
            shape=stack.shape,
            values=tuple(values),
            config=preview.config,
            notes=preview.notes,
            preview=_search_preview(preview),
            out=target,
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(target) as partial:
        partial.write_text(_toml_text(found), encoding="utf-8")
    return found


def _known_values(
    metadata: StackMetadata, answers: Mapping[str, float | str], instrument: str | None
) -> list[Value]:
    """Collect values from answers, metadata and an instrument; answers win, then metadata."""
    known = []
    for question in _QUESTIONS:
        value = getattr(metadata, question.key.partition(".")[2], None)
        if question.key in answers:
            known.append(Value(question.key, answers[question.key], ANSWER))
        elif value is not None:
            known.append(Value(question.key, value, _origin_in_file(metadata)))
    if instrument is not None:
        here = {each.key for each in known}
        known += [
            Value(key, value, f"instrument {instrument}")
            for key, value in instruments[instrument].settings.items()
            if key not in here and key.partition(".")[0] in _SECTIONS
        ]
    return known


def _with_learning(value: Value, config: Config) -> Value:
    """Say of a value that is not known for certain whether it will be learned from the movie."""
    if value.key not in _LEARNED or value.origin == ANSWER:
        return value
    reason = why_not(config)
    said = f"not learned {reason}" if reason else _LEARNED[value.key]
    return replace(value, origin=f"{value.origin}, {said}")


def _ask_the_rest(
    known: list[Value], ask: Callable[[Question], str] | None, note: Callable[[str], None]
) -> tuple[list[Value], Config]:
    """Ask for each open key, again where an answer is invalid."""
    config = configure(None, settings={each.key: each.value for each in known})
    values = list(known)
    open_questions = [q for q in _QUESTIONS if q.key not in {each.key for each in known}]
    if open_questions:
        note("not known: " + ", ".join(question.words for question in open_questions))
    for question in open_questions:
        answer: float | str | None = question.default
        while ask is not None:
            answer = ask(question)
            try:
                config = configure(config, settings={question.key: answer})
                break
            except ConfigError as error:
                note(str(error))
        if answer is None:
            continue
        given = attrgetter(question.key)(config)
        values.append(Value(question.key, given, DEFAULT if given == question.default else ANSWER))
    config = configure(None, settings={each.key: each.value for each in values})
    return values, config


def _mode_of(preview: Preview, stack: Stack, config: Config) -> tuple[Value, Preview]:
    """Choose mode track where the frames clearly show moving particles, else keep the mode."""
    ready = preview.prepared
    changes = look_at_changes(ready.steady, ready.config, ready.camera, ready.span)
    if not as_moving(changes, stack.name):
        return Value("fit.mode", config.fit.mode, DEFAULT), preview
    moving = configure(config, settings={"fit.mode": "track"})
    return Value("fit.mode", "track", MEASURED), Preview(stack, moving)


def _each_movie(metadata: StackMetadata) -> list[Value]:
    """List values that each movie has in its own metadata, so that the file need not hold them."""
    stated = {key: getattr(metadata, key.partition(".")[2]) for key in _EACH_MOVIE}
    return [
        Value(key, value, _origin_in_file(metadata), written=False)
        for key, value in stated.items()
        if value is not None
    ]


def _camera_values(camera: LearnedCamera) -> list[Value]:
    """List the numbers of the camera, which are measured anew in each movie."""
    values = []
    for key in _CAMERA:
        number = camera.numbers[key.partition(".")[2]]
        origin = _ORIGINS.get(number.source, f"{MEASURED} ({number.source})")
        values.append(Value(key, number.value, origin, number.se or None, written=False))
    return values


def _search_preview(preview: Preview) -> dict[str, Any]:
    """Search some frames all over the movie."""
    (first, last), window = preview.frames, preview.window
    apart = 1 if preview.config.fit.follows_tracks else window
    # places in a movie at which the search looks
    places = max(1, min(5, (last - first) // (2 * apart)))
    at = np.linspace(first, last, places + 1)
    looks = [preview.look(int((a + b) / 2)) for a, b in pairwise(at)]
    found = [look.found() for look in looks]
    ready = preview.prepared
    start, stop = ready.span
    # frames whose light is averaged
    lit = ready.steady.read(start, min(start + 16, stop))
    strongest = max((float(table["snr"].abs().max()) for table in found if len(table)), default=0.0)
    return {
        "frames": [look.frame for look in looks],
        "window": window,
        "candidates": [len(table) for table in found],
        "threshold_snr": looks[0].threshold,
        "strongest_snr": strongest if strongest else None,
        "noise_contrast": float(np.median([_spread(look.image) for look in looks])),
        "light_e": float(np.mean(ready.camera.to_electrons(lit))),
    }


def _spread(image: np.ndarray[Any, Any]) -> float:
    """Give the standard deviation of the pixels, robust against a few particles.

    Shapes: `image` (y, x).
    """
    used = image[np.isfinite(image)]
    return robust_sigma(used - np.median(used)) if used.size else math.nan


def _toml_text(setup: Setup) -> str:
    """Write the file: each value, its meaning and its origin."""
    lines = [
        f"# Configuration for {in_toml(setup.movie)}, written by `iscat init`; iscat-fit finds it",
        "# where it lies beside a movie.  Behind each value stands where it comes from.  A line",
        "# that begins with # is unset; `iscat config` prints every key there is.",
    ]
    for section in Config.model_fields:
        own = [each for each in setup.values if each.key.startswith(f"{section}.")]
        unset = not any(each.written or each.key in _CAMERA for each in own)
        lines += ["", f"{'# ' if unset else ''}[{section}]"] if own else []
        for each in own:
            name = each.key.partition(".")[2]
            if each.key in _CAMERA:
                line = f"{name} = {toml_value(AUTO)}"
                origin = f"{each.shown} in this movie: {each.origin}"
            else:
                value = "" if each.value == "" else toml_value(each.value)
                line = f"{'' if each.written else '# '}{name} = {value}"
                of_each = each.key in _EACH_MOVIE
                origin = f"{each.origin}; taken from each movie" if of_each else each.origin
            lines.append(f"{line:<32} # {origin}")
    return "\n".join(lines) + "\n"


def _metadata_line(stack: Stack) -> str:
    """Describe the metadata of the file in one line."""
    metadata = stack.metadata
    parts = [
        words.format(value)
        for key, words in (
            ("pixel_size_nm", "pixels of {:.4g} nm"),
            ("wavelength_nm", "wavelength {:.4g} nm"),
            ("na", "NA {:.4g}"),
            ("magnification", "{:.4g}×"),
            ("binning", "binning {:.4g}"),
            ("exposure_ms", "exposure {:.4g} ms"),
            ("frame_rate_hz", "{:.4g} frames per second"),
            ("gain_e_per_adu", "{:.4g} e per count"),
            ("offset_adu", "offset {:.4g} counts"),
        )
        if (value := getattr(metadata, key)) is not None
    ]
    if not parts:
        return f"{stack.name}: the file has no metadata that help"
    return f"{stack.name}: its {metadata.source} metadata say " + ", ".join(parts)


def _origin_in_file(metadata: StackMetadata) -> str:
    return f"{READ} ({metadata.source})"


def preview_lines(setup: Setup) -> list[str]:
    """Describe in a few lines what the search found."""
    seen = setup.preview
    total, places = sum(seen["candidates"]), len(seen["frames"])
    moving = setup.config.fit.follows_tracks
    where = count(places, "frame" if moving else "place")
    windows = "" if moving else f", with windows of {count(seen['window'], 'frame')}"
    strongest = f", the strongest at {seen['strongest_snr']:.1f}" if seen["strongest_snr"] else ""
    return [
        f"light: {seen['light_e']:.3g} photoelectrons in a pixel of a frame; noise of the contrast "
        f"that is searched: {seen['noise_contrast']:.2g}",
        f"preview: {count(total, 'candidate')} at {where} of the movie{windows}; threshold "
        f"{seen['threshold_snr']:.1f} times the noise{strongest}",
    ]
