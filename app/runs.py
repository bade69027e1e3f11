"""The queue of what is to be done with movies, each in a process of its own, one after the other.

It belongs to the server and not to a page, so that pages may be closed and opened as it works.
"""

from __future__ import annotations

import os
import shlex
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from multiprocessing.resource_tracker import ensure_running
from pathlib import Path
from typing import Any, Literal

from iscat_analysis.options import Told

State = Literal["waiting", "running", "stopping", "done", "stopped", "failed"]


Kind = Literal["fit", "camera", "optics", "day"]
"""What is done with a movie, or with a folder of them: the command of that name."""


@dataclass(frozen=True)
class Job:
    """What is to be done, and where its result goes."""

    movie: Path
    config: Path | None
    out: Path
    kind: Kind = "fit"
    overwrite: bool = False
    dark: Path | None = None
    scheduler: str = "threads"

    @property
    def title(self) -> str:
        """Name what is done."""
        what = {"camera": "camera of ", "optics": "optics of ", "day": "all of "}
        return f"{what.get(self.kind, '')}{self.movie.name}"

    @property
    def command(self) -> str:
        """The command line that does the same."""
        calibrate = {kind: f"iscat calibrate {kind}" for kind in ("camera", "optics")}
        program = calibrate | {"fit": "iscat-fit", "day": "iscat batch"}
        words = [*program[self.kind].split(), str(self.movie)]
        words += ["--dark", str(self.dark)] if self.dark else []
        words += ["--config", str(self.config)] if self.config and self.kind != "camera" else []
        words += ["--scheduler", self.scheduler] if self.scheduler != "threads" else []
        words += ["--out", str(self.out)]
        return shlex.join([*words, *(["--overwrite"] if self.overwrite else [])])


@dataclass
class Run:
    """A job that is, was or will be done."""

    number: int
    job: Job
    state: State = "waiting"
    is_asked_to_stop: bool = False
    stage: str = ""
    done: int = 0
    total: int = 0
    stage_began: float = 0.0
    log: list[str] = field(default_factory=list)

    @property
    def ended(self) -> bool:
        """Whether nothing more will happen."""
        return self.state in ("done", "stopped", "failed")

    @property
    def seconds_left(self) -> float | None:
        """How long the stage will take, judged by its pace."""
        if self.state != "running" or not 0 < self.done < self.total:
            return None
        return (time.monotonic() - self.stage_began) * (self.total / self.done - 1)

    def say(self, text: str) -> None:
        """Keep a line for the log."""
        self.log = [*self.log, text][-200:]  # lines of a run that are kept


class Queue:
    """Runs, one after the other; whoever shows them looks at `version`."""

    def __init__(self) -> None:
        self.runs: list[Run] = []
        self.version = 0
        self._lock = threading.Lock()
        self._process: BaseProcess | None = None
        self._closed = False
        self._wake = threading.Condition(self._lock)
        threading.Thread(target=self._work, daemon=True, name="queue").start()

    def add(self, job: Job) -> Run:
        """Put a job at the end; one that waits or runs already is not put twice."""
        with self._wake:
            for run in self.runs:
                if run.job.out == job.out and not run.ended:
                    return run
            run = Run(len(self.runs) + 1, job)
            self.runs.append(run)
            self.version += 1
            self._wake.notify_all()
            return run

    def stop(self, run: Run) -> None:
        """Stop a run; what it has finished is kept, and the same job goes on from there."""
        with self._wake:
            if run.state == "waiting":
                run.state = "stopped"
            elif run.state == "running" and self._process is not None and self._process.pid:
                run.state, run.is_asked_to_stop = "stopping", True
                os.kill(self._process.pid, signal.SIGINT)
            self.version += 1

    def close(self) -> None:
        """Stop what runs and begin nothing more."""
        with self._wake:
            self._closed = True
            process = self._process
            self._wake.notify_all()
        if process is not None and process.is_alive() and process.pid:
            os.kill(process.pid, signal.SIGINT)
            # That a run has to end by itself when the server ends; finished parts are on the disk
            # by then
            process.join(1.0)
            if process.is_alive():
                process.terminate()

    def _work(self) -> None:
        while True:
            with self._wake:
                while not self._closed and not any(r.state == "waiting" for r in self.runs):
                    self._wake.wait()
                if self._closed:
                    return
                run = next(r for r in self.runs if r.state == "waiting")
                run.state = "running"
                self.version += 1
                try:
                    here, self._process = _started(run.job)
                except Exception as error:  # noqa: BLE001, whatever it is, the others have their turn
                    run.state = "failed"
                    run.say(f"the process could not be started: {type(error).__name__}: {error}")
                    self.version += 1
                    continue
            self._follow(run, here)
            self._process.join()
            with self._wake:
                if not run.ended:  # it was ended from outside
                    run.state = "stopped" if run.is_asked_to_stop else "failed"
                    run.say("the process ended without a word; perhaps memory ran out")
                self._process = None
                self.version += 1

    def _follow(self, run: Run, here: Connection) -> None:
        """Take down what a process says until it has nothing more to say."""
        while True:
            try:
                kind, *what = here.recv()
            except (EOFError, OSError):
                return
            with self._lock:
                if kind == "progress":
                    stage, run.done, run.total = what
                    if stage != run.stage:
                        run.stage, run.stage_began = stage, time.monotonic()
                elif kind == "note":
                    run.say(*what)
                else:
                    run.state = kind
                    for line in what:
                        run.say(line)
                self.version += 1


def _started(job: Job) -> tuple[Connection, BaseProcess]:
    """Start a process for a job, and give where it says how far it is."""
    context = get_context("spawn")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_work_on, args=(job, there))
    with there, _interrupts_held():
        process.start()
    return here, process


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Start a process that sees an interrupt only when it is ready to answer it."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    ensure_running()  # which would let interrupts through again
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _work_on(job: Job, to: Connection) -> None:
    """Do one job, in a process of its own, and tell how far it is."""
    said = 0.0
    lock = threading.Lock()

    def progress(stage: str, done: int, total: int) -> None:
        nonlocal said
        with lock:
            if done in (0, total) or time.monotonic() - said > 0.2:
                said = time.monotonic()
                to.send(("progress", stage, done, total))

    def notify(text: str) -> None:
        with lock:
            to.send(("note", text))

    try:
        from iscat_analysis.errors import IscatError

        # An interrupt that came during these imports is raised here.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(signal.SIG_SETMASK, ())
        try:
            to.send(("done", _WORK[job.kind](job, {"progress": progress, "notify": notify})))
        except IscatError as error:
            to.send(("failed", str(error)))
        except (OSError, MemoryError) as error:
            to.send(("failed", f"{type(error).__name__}: {error}"))
    except KeyboardInterrupt as stop:
        to.send(("stopped", str(stop) or "stopped; what was finished is kept"))


def _fit(job: Job, told: Told) -> str:
    from iscat_analysis.config import load_config
    from iscat_analysis.executors import open_executor
    from iscat_analysis.pipeline import fit_stack

    config = load_config(job.config)
    how: Any = {"overwrite": job.overwrite, "command": job.command}
    with open_executor(job.scheduler) as executor:
        analysis = fit_stack(job.movie, config, out=job.out, executor=executor, **how, **told)
    return f"{len(analysis.table)} rows; results in {job.out}"


def _camera(job: Job, told: Told) -> str:
    from iscat_analysis.answers.calibrations import camera_calibration

    camera_calibration([job.movie], job.out, dark=job.dark, overwrite=job.overwrite, **told)
    return f"the camera is in {job.out}"


def _optics(job: Job, told: Told) -> str:
    from iscat_analysis.answers.calibrations import optics_calibration
    from iscat_analysis.config import load_config
    from iscat_analysis.errors import DataError

    config = load_config(job.config)
    found = optics_calibration(job.movie, config, job.out, overwrite=job.overwrite, **told)
    if not found.accepted:
        raise DataError(f"the optics are refused: {'; '.join(found.measured.refusals)}")
    return f"the optics are in {job.out}"


def _day(job: Job, told: Told) -> str:
    from iscat_analysis.day import batch
    from iscat_analysis.day.table import TABLES

    table = next((job.movie / name for name in TABLES if (job.movie / name).is_file()), job.movie)
    how: Any = {"config": job.config, "scheduler": job.scheduler, "command": job.command}
    found = batch(table, out=job.out, **how, **told)
    for name, why in found.failed:
        told["notify"](f"{name}: {why}")
    return f"{len(found.movies)} movies; the page is {found.page}"


_WORK = {"fit": _fit, "camera": _camera, "optics": _optics, "day": _day}
