"""What is finished, on disk: records beside the results, and locks for runs at the same time.

A result is as its job asks for if its record holds the job's key, a hash of the program's version
and the resolved configuration, if its files are whole, and if the movie is the one
that the record saw: of the same size, time and ends, or, where it was copied, of the same SHA-256.

Jobs of a batch: finished ones are skipped, and a failure affects only its own job.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
import pyarrow.parquet as pq
from filelock import FileLock, Timeout

from iscat_analysis.answers.output import Notify, tell
from iscat_analysis.config import Config, config_to_toml, with_absolute_paths
from iscat_analysis.errors import DataError, IscatError, SchedulerError
from iscat_analysis.executors import Executor
from iscat_analysis.files import fingerprint, sha256_of_files, take, whole_file
from iscat_analysis.movie import files_of, not_shared, open_stack, split_address
from iscat_analysis.pipeline import fit_stack
from iscat_analysis.records import Progress, silent
from iscat_analysis.threads import one_thread_algebra

STATE = ".batch"
"""Folder of records and locks; it marks a folder as that of a batch."""

_MAPS = ("gain_e_per_adu", "offset_adu", "read_noise_e", "response")


class Records:
    """Records and locks of one batch."""

    def __init__(self, out: Path) -> None:
        self._folder = out / STATE

    def read(self, name: str) -> dict[str, Any]:
        """Give the record of a job."""
        try:
            found = json.loads(self._path(name).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return found if isinstance(found, dict) else {}

    def write(self, name: str, values: Mapping[str, Any]) -> None:
        """Keep the record of a job, whole or not at all."""
        path = self._path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, json.dumps(dict(values), indent=1, sort_keys=True) + "\n")

    def drop(self, name: str) -> None:
        """Forget a job, before its result is changed."""
        self._path(name).unlink(missing_ok=True)

    def forget_failed(self) -> None:
        """Forget every job that failed, so that it is tried again."""
        for path in self._folder.rglob("*.json"):
            name = path.relative_to(self._folder).with_suffix("").as_posix()
            if self.read(name).get("state") == "failed":
                self.drop(name)

    @contextmanager
    def held(self, name: str, notify: Notify | None = None) -> Iterator[None]:
        """Lock a job, so that no other run does it at the same time."""
        path = self._path(name).with_suffix(".lock")
        path.parent.mkdir(parents=True, exist_ok=True)
        # between two looks at a lock that another run holds
        lock = FileLock(path, thread_local=False, fallback_to_soft=False, poll_interval=0.2)
        try:
            # after which the waiting is told
            held = take(lock, 2.0)
        except Timeout:
            tell([f"waiting for another run, which is at {name}"], notify)
            held = take(lock, -1)
        try:
            yield
        finally:
            if held:  # the system releases the lock however the process ends
                lock.release()

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.json"


def claim_folder(out: Path) -> None:
    """Make the folder of a batch, and refuse one that holds something else."""
    state = out / STATE
    try:
        if state.is_symlink():
            raise DataError(
                f"{state}: is a link, where a batch keeps files of its own, and is left alone; "
                "remove it, or choose another `out`"
            )
        held = sorted(p.name for p in out.iterdir()) if out.is_dir() else []
        if held and not state.is_dir():  # asked last: another part may just have begun
            raise DataError(
                f"{out}: holds {held[0]!r} and is no earlier batch, and is left alone; choose "
                "another `out`"
            )
        state.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise DataError(f"{out}: is a file, not a folder; choose another `out`") from None
    except OSError as error:
        raise DataError(f"{out}: cannot be made ({error.strerror}); choose another `out`") from None


def write_whole(path: Path, content: str) -> None:
    """Write a text file atomically."""
    with whole_file(path) as partial:
        partial.write_text(content, encoding="utf-8")


def key_of(config: Config, *further: Any) -> str:
    """Hash the input of an analysis."""
    compute = type(config.compute)(seed=config.compute.seed)
    settings = config.model_copy(update={"compute": compute})
    numbers = config.camera.assumed
    maps = [sha256_of(Path(v)) for n in _MAPS if isinstance(v := getattr(numbers, n), str)]
    return hash_of(config_to_toml(settings, comments=False), maps, *further)


def hash_of(*parts: Any) -> str:
    """Hash the input of a job, and the version of the program."""
    text = json.dumps([version("iscat-analysis"), *parts])
    return hashlib.sha256(text.encode()).hexdigest()


def sha256_of(path: Path) -> str:
    """Hash a file, or a movie as `Stack.sha256` does."""
    try:
        return sha256_of_files(files_of(path), split_address(path)[1])
    except (DataError, OSError):
        return ""


def seen(path: Path) -> str:
    """Hash size, time and both ends of a movie; empty where it cannot be read."""
    try:
        return fingerprint(files_of(path), split_address(path)[1])
    except OSError:
        return ""


def saw(record: Mapping[str, Any], path: Path) -> bool:
    """Tell whether a record belongs to a movie in its present state."""
    now, known = seen(path), record.get("sha256")
    same = record.get("fingerprint") == now
    return bool(now) and (same or (bool(known) and known == sha256_of(path)))


def results_in(folder: Path) -> dict[str, str]:
    """Give the state of the files of a result that other jobs and the page need.

    That is the hash of a document, of which a part may be a document as well, and of a table
    whether it can be read.
    """
    found: dict[str, str] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix in (".json", ".toml"):
            found[path.name] = sha256_of(path)
        elif path.suffix == ".parquet":
            state = path.stat()
            found[path.name] = _reads(path, state.st_size, state.st_mtime_ns)
    return found


# tables that were read
@lru_cache(maxsize=2**14)
def _reads(path: Path, size: int, changed_ns: int) -> str:
    """Tell whether a table can be read to its end, once until it changes."""
    del size, changed_ns
    try:
        with path.open("rb") as file:
            pq.read_table(file)
    except (OSError, ValueError, MemoryError, pa.ArrowException):
        return "damaged"
    return "whole"


State = Literal["done", "failed", "missing"]


@dataclass(frozen=True)
class Outcome:
    """Result of a job."""

    state: State
    why: str = ""
    ran: bool = False
    record: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class Runner:
    """Runs jobs that are not finished yet."""

    out: Path
    executor: Executor
    command: str
    progress: Progress
    notify: Notify | None
    dry: bool
    retry: bool

    @property
    def records(self) -> Records:
        """What is known of the jobs of this folder."""
        return Records(self.out)

    def job(
        self,
        name: str,
        key: str,
        inputs: Mapping[str, Path],
        result: Path,
        work: Callable[[], Mapping[str, Any]],
    ) -> Outcome:
        """Do a job unless it is done."""
        with self.records.held(name, self.notify):
            record = self.records.read(name)
            files = record.get("inputs", {})
            current = record.get("key") == key and set(files) == set(inputs)
            current = current and all(saw(files[each], path) for each, path in inputs.items())
            if current and record["state"] == "done" and result.is_file():
                found = results_in(result.parent)
                whole = record.get("results", found)
                if "damaged" not in found.values() and found == whole:
                    return Outcome("done", record=record)
                if not self.dry:
                    tell([f"{result.parent}: is damaged, and is made anew"], self.notify)
            failed = current and record["state"] == "failed"
            if self.dry or (failed and not self.retry):
                return Outcome("failed" if failed else "missing", record.get("why", ""))
            self.records.drop(name)
            before = {each: {"fingerprint": seen(path)} for each, path in inputs.items()}
            kept: Mapping[str, Any] = {}
            why = ""
            try:
                kept = work()
            except SchedulerError:  # the cluster failed, not this job
                raise
            except IscatError as error:
                why = str(error)
            except Exception as error:  # noqa: BLE001  (the other movies go on)
                if isinstance(error.__cause__ or error.__context__, KeyboardInterrupt):
                    raise KeyboardInterrupt from None  # compiled code wraps it in another error
                why = f"unexpected {type(error).__name__}: {error}"
            state: State = "failed" if why else "done"
            hashes = kept.get("inputs", {})
            results = {} if why else results_in(result.parent)
            known = {each: {**found, **hashes.get(each, {})} for each, found in before.items()}
            record = {**kept, "key": key, "state": state, "why": why}
            record |= {"results": results, "inputs": known}
            self.records.write(name, record)
            return Outcome(state, why, ran=True, record=record)

    def analyse(self, name: str, movie: Path, config: Config, folder: Path) -> Outcome:
        """Fit a movie unless that is done."""

        def work() -> dict[str, Any]:
            absolute, known = with_absolute_paths(config), (movie, seen(movie))
            places = self.out.absolute(), folder.absolute()
            return self.executor.call(
                analyse_movie, name, known, absolute, places, self.command, progress=self.progress
            )

        return self.job(name, key_of(config), {"movie": movie}, folder / "summary.json", work)


def analyse_movie(
    name: str,
    movie: tuple[Path, str],
    config: Config,
    places: tuple[Path, Path],
    command: str,
    *,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Fit a movie of a batch, wherever that is; `places` are those of batch and result."""
    out, folder = places
    path, known = movie
    if not (out / STATE).is_dir():
        raise not_shared(out)
    if known and seen(path) != known:
        raise not_shared(path)
    with Records(out).held(f"{name}.work"), one_thread_algebra():
        with open_stack(path) as stack:
            shape = [int(n) for n in stack.shape]
        summary = fit_stack(
            path, config, out=folder, overwrite=True, progress=progress, command=command
        ).summary
    return {
        "shape": shape,
        "events": summary["events"],
        "inputs": {"movie": {"sha256": summary["input"]["sha256"]}},
    }
