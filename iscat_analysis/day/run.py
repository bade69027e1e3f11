"""Jobs of a batch: finished ones are skipped, and a failure affects only its own job."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from iscat_analysis.config import Config, with_absolute_paths
from iscat_analysis.day.state import STATE, Records, key_of, results_in, saw, seen
from iscat_analysis.errors import IscatError, SchedulerError
from iscat_analysis.executors import Executor
from iscat_analysis.movie import open_stack
from iscat_analysis.movie.stack import not_shared
from iscat_analysis.pipeline import fit_stack
from iscat_analysis.records import Progress, silent
from iscat_analysis.threads import one_thread_algebra

Notify = Callable[[str], None]

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
    records: Records
    dry: bool
    progress: Progress
    notify: Notify
    command: str
    executor: Executor
    retry: bool = True

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
                    self.notify(f"{result.parent}: is damaged, and is made anew")
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
            record = {
                **kept,
                "key": key,
                "state": state,
                "why": why,
                "results": {} if why else results_in(result.parent),
                "inputs": {
                    each: {**found, **hashes.get(each, {})} for each, found in before.items()
                },
            }
            self.records.write(name, record)
            return Outcome(state, why, ran=True, record=record)

    def analyse(self, name: str, movie: Path, config: Config, folder: Path) -> Outcome:
        """Fit a movie unless that is done."""

        def work() -> dict[str, Any]:
            return self.executor.call(
                analyse_movie,
                self.out.absolute(),
                name,
                (movie, seen(movie)),
                with_absolute_paths(config),
                folder.absolute(),
                self.command,
                progress=self.progress,
            )

        return self.job(name, key_of(config), {"movie": movie}, folder / "summary.json", work)


def analyse_movie(
    out: Path,
    name: str,
    movie: tuple[Path, str],
    config: Config,
    folder: Path,
    command: str,
    *,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Fit a movie of a batch, wherever that is."""
    path, known = movie
    if not (out / STATE).is_dir():
        raise not_shared(out)
    if known and seen(path) != known:
        raise not_shared(path)
    with Records(out).held(f"{name}.work", lambda _: None), one_thread_algebra():
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
