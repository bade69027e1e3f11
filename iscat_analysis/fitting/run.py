"""One run of the main job: findings, progress, times, compilation, and finished parts on disk."""

from __future__ import annotations

import gc
import hashlib
import io
import json
import math
import re
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields, is_dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numba.core import event
from numpy.typing import NDArray

from iscat_analysis import _kernels
from iscat_analysis.camera import Camera
from iscat_analysis.config import Config, config_to_toml
from iscat_analysis.executors import Executor
from iscat_analysis.files import whole_file
from iscat_analysis.findings import Finding, Findings, existing
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.inference.fit import compile_kernels
from iscat_analysis.inference.heights import has_prior
from iscat_analysis.reading import npz_of, parquet_of, read_bytes, read_json
from iscat_analysis.records import Clip, EventView, Progress, Trace, silent

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

_PART = re.compile(r"[0-9a-f]{32}-\d{5}\.npz(\.\d+-[0-9a-f]+\.partial)?")
_LARGEST_PART_BYTES = 2_000_000_000
_TREE = "tree"  # array that says how the others make a record


def packed(record: Any) -> dict[str, Any]:
    """Pack a record of arrays, tables, tuples, numbers and other records into few arrays.

    Arrays of one type are one after the other; a tree, in JSON, says what lies where.
    """
    pools: defaultdict[str, list[NDArray[Any]]] = defaultdict(list)
    sizes: Counter[str] = Counter()

    def branch(part: Any) -> Any:
        if isinstance(part, pd.DataFrame):
            return {"table": branch(np.frombuffer(part.to_parquet(), np.uint8))}
        if isinstance(part, np.ndarray):
            kind = part.dtype.name
            pools[kind].append(part.ravel())
            sizes[kind] += part.size
            return {"array": kind, "end": sizes[kind], "shape": part.shape}
        if is_dataclass(part):
            own = {one.name: branch(getattr(part, one.name)) for one in fields(part)}
            return {"record": type(part).__name__, "fields": own}
        return [branch(each) for each in part] if isinstance(part, tuple) else part

    tree = json.dumps(branch(record), default=lambda number: number.item())
    return {_TREE: np.array(tree)} | {kind: np.concatenate(pool) for kind, pool in pools.items()}


def unpacked(arrays: Mapping[str, NDArray[Any]], records: Iterable[type]) -> Any:
    """Make the record of packed arrays again; `records` are all classes that are in it."""
    classes = {each.__name__: each for each in records}

    def grown(part: Any) -> Any:
        match part:
            case {"table": columns}:
                return parquet_of(io.BytesIO(grown(columns).tobytes()))
            case {"array": kind, "end": end, "shape": shape}:
                return arrays[kind][end - math.prod(shape) : end].reshape(shape)
            case {"record": name, "fields": own}:
                return classes[name](**{key: grown(value) for key, value in own.items()})
        return tuple(map(grown, part)) if isinstance(part, list) else part

    return grown(json.loads(str(arrays[_TREE])))


class Checkpoint:
    """Records of finished parts on disk."""

    records: tuple[type, ...] = (EventView, Trace, Clip)
    """Classes of all records that are in a part."""

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
        settings = config.changed(compute={"workers": 1})
        text = json.dumps(
            [version("iscat-analysis"), identity, shape, span, config_to_toml(settings)]
        )
        digest = hashlib.sha256(text.encode())
        for value in (camera.gain_e_per_adu, camera.offset_adu, camera.read_noise_e):
            digest.update(np.asarray(value, dtype=np.float64).tobytes())
        self.key = digest.hexdigest()[:32]

    def load(self, number: int) -> Any:
        """Give the record of a finished part; None where there is none."""
        if self._folder is None:
            return None
        try:
            content = read_bytes(self._path(number), _LARGEST_PART_BYTES)
            found = unpacked(npz_of(content, _LARGEST_PART_BYTES), self.records)
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None
        self.kept += 1
        return found

    def save(self, number: int, record: Any) -> None:
        """Keep a finished part; on a full disk the run goes on, but cannot resume from it."""
        if self._folder is None:
            return
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with whole_file(self._path(number)) as partial, partial.open("wb") as file:
                np.savez(file, **packed(record))
            self.kept += 1
        except OSError:
            self._folder = None

    def _path(self, number: int) -> Path:
        return (self._folder or Path()) / f"{self.key}-{number:05d}.npz"


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

    notify: Notify = notify_nobody
    progress: Progress = silent
    partial: Path | None = None
    executor: Executor = field(default_factory=Executor)
    inject: int = 0
    clock: Clock = field(default_factory=Clock)
    findings: Findings = field(default_factory=Findings)

    def report(self, *findings: Finding | None) -> None:
        """Print findings, and keep them for the result; what is None was not found."""
        for finding in existing(findings):
            self.findings.add(finding)
            self.notify(finding.text)

    def warm_up(self, context: AnalysisContext) -> None:
        """Load or compile the kernels of fits."""
        config = context.config
        heights = config.fit.heights_free or has_prior(config)
        compile_kernels(context.model, heights=heights, posteriors=config.samples_posterior)
