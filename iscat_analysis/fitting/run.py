"""One run of the main job: findings, progress, times, compilation, and finished parts on disk."""

from __future__ import annotations

import gc
import hashlib
import json
import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numba.core import event

from iscat_analysis import _kernels
from iscat_analysis.camera import Camera
from iscat_analysis.config import Config, config_to_toml
from iscat_analysis.executors import Executor
from iscat_analysis.files import whole_file
from iscat_analysis.findings import Finding, Findings, existing, remark
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.inference.heights import has_prior
from iscat_analysis.inference.noise import compile_kernels, parts_of
from iscat_analysis.reading import npz_of, read_bytes, read_json, read_parquet
from iscat_analysis.records import FREE_PARAMETERS, Clip, EventView, FloatArray, Progress, Trace

PATIENCE_S = 1.0  # of compilation, before it is announced
_ROOM = f"{_kernels.__name__}."
ANNOUNCED = threading.Event()
"""Set once this process has said it."""


class Compilation(event.Listener):  # type: ignore[misc]  # Numba is not typed
    """Listens to Numba; `compiling` makes it.

    Compilers leave few cycles of objects, and to look for them takes a tenth of the time.
    """

    def __init__(self, notify: Callable[[str], None]) -> None:
        self._notify = notify
        self._depth = 0
        self._timer: threading.Timer | None = None
        self._collects = gc.isenabled()

    def on_start(self, event: event.Event) -> None:
        """Note that a function is being compiled."""
        self._depth += 1
        gc.disable()
        ours = event.data["dispatcher"].py_func.__module__.startswith(_ROOM)
        if ours and self._timer is None:
            self._timer = threading.Timer(PATIENCE_S, self._announce)
            self._timer.daemon = True
            self._timer.start()

    def on_end(self, event: event.Event) -> None:
        """Note that it is compiled."""
        del event
        self._depth -= 1
        if self._collects and not self._depth:
            gc.enable()

    def _announce(self) -> None:
        if self._depth and not ANNOUNCED.is_set():
            ANNOUNCED.set()
            self._notify("compiling the numerical kernels of this analysis; later runs load them…")

    def close(self) -> None:
        """Stop listening."""
        if self._timer is not None:
            self._timer.cancel()


@contextmanager
def compiling(notify: Callable[[str], None]) -> Iterator[None]:
    """Say once in this process that kernels are compiled, if they are while the block runs."""
    listener = Compilation(notify)
    try:
        with event.install_listener("numba:compile", listener):
            yield
    finally:
        listener.close()


RESUMPTION_HINT = "what was finished is kept, and the same command goes on from there"
"""What an interrupt says where it is so."""

_PART = re.compile(r"[0-9a-f]{32}-\d{5}\.(parquet|npz)(\.\d+-[0-9a-f]+\.partial)?")
_LARGEST_PART_BYTES = 2_000_000_000
_NO_TRACE = (0.0,) * 9
_NO_CLIP = (0,) * 4


class Checkpoint:
    """Tables and arrays of finished parts on disk."""

    def __init__(
        self,
        folder: Path | None,
        config: Config,
        identity: str,
        shape: tuple[int, int],
        span: tuple[int, int],
        camera: Camera,
    ) -> None:
        self._folder = folder if identity else None
        self.kept = 0
        settings = config.model_copy(
            update={"compute": config.compute.model_copy(update={"workers": 1})}
        )
        text = json.dumps(
            [version("iscat-analysis"), identity, shape, span, config_to_toml(settings)]
        )
        digest = hashlib.sha256(text.encode())
        for value in (camera.gain_e_per_adu, camera.offset_adu, camera.read_noise_e):
            digest.update(np.asarray(value, dtype=np.float64).tobytes())
        self.key = digest.hexdigest()[:32]

    def read(self, number: int) -> tuple[pd.DataFrame, dict[str, Any]] | None:
        """Load the table and the arrays of a finished part; None where there are none."""
        if self._folder is None:
            return None
        table_path, path = self._paths(number)
        try:
            arrays = npz_of(read_bytes(path, _LARGEST_PART_BYTES), (), _LARGEST_PART_BYTES)
            found = read_parquet(table_path), arrays
        except (OSError, ValueError):
            return None
        self.kept += 1
        return found

    def write(self, number: int, table: pd.DataFrame, arrays: Mapping[str, Any]) -> None:
        """Save a finished part; on a full disk the run goes on, but cannot resume from it."""
        if self._folder is None:
            return
        table_path, path = self._paths(number)
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            table.to_parquet(table_path, index=False)
            with whole_file(path) as partial, partial.open("wb") as file:
                np.savez(file, **arrays)
            self.kept += 1
        except OSError:
            self._folder = None

    def _paths(self, number: int) -> tuple[Path, Path]:
        folder = self._folder or Path()
        stem = f"{self.key}-{number:05d}"
        return folder / f"{stem}.parquet", folder / f"{stem}.npz"


def packed_views(views: Sequence[EventView]) -> dict[str, FloatArray]:
    """Pack images into arrays for a file."""
    flat = [np.stack([v.contrast, v.model, v.residual]).reshape(3, -1) for v in views]
    traces = [v.trace for v in views]
    clips = [v.clip for v in views]
    return {
        "traces": np.concatenate([np.empty(0), *(t.contrast for t in traces if t)]),
        "trace_marks": np.array([_NO_TRACE if t is None else _marks(t) for t in traces]),
        "clips": np.concatenate(
            [np.empty(0, dtype=np.float32), *(c.contrast.ravel() for c in clips if c)]
        ),
        "clip_frames": np.array([n for c in clips if c for n in c.frames], dtype=np.int64),
        "clip_marks": np.array(
            [_NO_CLIP if c is None else (*c.contrast.shape, c.window_frames) for c in clips]
        ),
        "images": np.concatenate(flat or [np.empty((3, 0))], axis=1),
        "corners": np.array([(v.row_px, v.column_px) for v in views]).reshape(-1, 2),
        "sizes": np.array([v.contrast.shape for v in views]).reshape(-1, 2),
    }


def unpacked_views(data: Mapping[str, Any]) -> tuple[EventView, ...]:
    """Unpack images from such arrays."""
    views, at = [], 0
    traces, clips = _traces(data), _clips(data)
    for i, (row, column) in enumerate(data["corners"]):
        rows, columns = (int(n) for n in data["sizes"][i])
        stack = data["images"][:, at : at + rows * columns].reshape(3, rows, columns)
        at += rows * columns
        views.append(
            EventView(
                i, int(row), int(column), stack[0], stack[1], stack[2],
                trace=next(traces), clip=next(clips),
            )
        )  # fmt: skip
    return tuple(views)


def _marks(trace: Trace) -> tuple[float, ...]:
    """Give the numbers of a trace beside its contrasts."""
    return (
        trace.contrast.size, trace.first, trace.sigma, trace.frame, trace.half_width,
        *trace.used, trace.before, trace.after,
    )  # fmt: skip


def _traces(data: Mapping[str, Any]) -> Iterator[Trace | None]:
    at = 0
    for size, first, sigma, frame, half_width, start, stop, before, after in data["trace_marks"]:
        end = at + int(size)
        yield None if end == at else Trace(
            int(first), data["traces"][at:end], float(sigma), int(frame), int(half_width),
            (int(start), int(stop)), float(before), float(after),
        )  # fmt: skip
        at = end


def _clips(data: Mapping[str, Any]) -> Iterator[Clip | None]:
    at, frame = 0, 0
    for images, rows, columns, window in data["clip_marks"].tolist():
        end, stop = at + images * rows * columns, frame + images
        yield None if not images else Clip(
            tuple(data["clip_frames"][frame:stop].tolist()), window,
            data["clips"][at:end].reshape(images, rows, columns),
        )  # fmt: skip
        at, frame = end, stop


def partial_folder(folder: Path) -> Path:
    """Name the hidden folder beside an output folder that holds its finished chunks."""
    return folder.with_name(f".{folder.name}.partial")


def remove_parts(folder: Path) -> None:
    """Remove the finished chunks of a folder, and the folder if it holds nothing else."""
    with suppress(OSError):
        for path in folder.iterdir():
            if _PART.fullmatch(path.name):
                path.unlink(missing_ok=True)
        folder.rmdir()


def saying(stop: KeyboardInterrupt, what: str) -> KeyboardInterrupt:
    """Append a text to the message of an interrupt."""
    return KeyboardInterrupt("; ".join(filter(None, [str(stop), what])))


@contextmanager
def parts_kept(folder: Path | None) -> Iterator[None]:
    """Append to an interrupt that finished parts are kept, when all of them are."""
    try:
        yield
    except KeyboardInterrupt as stop:
        if folder is None or not any(folder.glob("*.npz")):
            raise
        raise saying(stop, RESUMPTION_HINT) from None


def is_resumable(folder: Path) -> bool:
    """Whether a folder is what an interrupted run left, with finished chunks or without any."""
    try:
        summary = read_json(folder / "summary.json")
        goes_on = partial_folder(folder).is_dir() or not summary["events"]
        return bool(summary["interrupted"]) and goes_on
    except (OSError, ValueError, KeyError, TypeError):
        return False


Notify = Callable[[str], None]


def notify_nobody(text: str) -> None:
    """Drop a message."""


class Clock:
    """Measures the seconds of each stage."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.seconds: dict[str, float] = {}

    def lap(self, name: str) -> None:
        """Store the time since the last call under a name."""
        now = time.perf_counter()
        self.seconds[name] = now - self._last
        self._last = now


@dataclass(frozen=True)
class Run:
    """The settings of one run, and the findings that it collects."""

    notify: Notify
    progress: Progress
    partial: Path | None
    executor: Executor
    inject: int
    clock: Clock = field(default_factory=Clock)
    findings: Findings = field(default_factory=Findings)

    def report(self, *findings: Finding | None) -> None:
        """Print findings, and keep them for the result; what is None was not found."""
        for finding in existing(findings):
            self.findings.add(finding)
            self.notify(finding.text)

    def warn(self, text: str) -> None:
        """Report a sentence that has no code yet."""
        self.report(remark(text))

    def warm_up(self, context: AnalysisContext) -> None:
        """Load or compile the kernels of fits."""
        config = context.config
        parts = parts_of(
            FREE_PARAMETERS[context.mode],
            heights=has_prior(config),
            posteriors=config.samples_posterior,
        )
        compile_kernels(context.model, parts)
