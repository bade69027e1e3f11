"""Run an estimator in a process of its own, which may fail, hang or grow without harm to others.

The parent writes what is asked for into a file, and starts this module; the child adds an answer
to another file as soon as a job is done.  What is there when the time is up counts.  Nothing that
the child leaves is trusted: its answers and its last words have a size and a form, and all that it
started ends with it.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from iscat_analysis.reading import first_line, model_of, read_bytes
from iscat_analysis.records import FloatArray, Progress
from iscat_analysis.study import EstimatorSetup, Setting, setup_of
from iscat_contest.estimators import COLUMNS, Estimate, Estimator, checked_table

GRACE_S = 1.0
"""Time between asking an estimator's processes to end and killing them."""

_LAST_WORDS = 65_536  # bytes of what a process wrote to its standard error
_MOST_BYTES = 5_000  # of an answer, for each region and for what is about all of them
_LONGEST_REASON = 300  # characters


@dataclass(frozen=True, eq=False)
class Job:
    """Regions to be estimated, and the noiseless image of one particle of known mass.

    Shapes: `before, after` (n, y, x), `reference` (2, y, x).
    """

    before: FloatArray
    after: FloatArray
    setup: EstimatorSetup
    reference: FloatArray
    reference_setup: EstimatorSetup


def job_of(setting: Setting, before: FloatArray, after: FloatArray, start: FloatArray) -> Job:
    """Give an estimator counts, starts, and the noiseless image of the particle of a setting.

    Shapes: `before, after` (n, y, x), `start` (n, 4) [nm, kDa].
    """
    noiseless = setting.draw(setting.truth, None)
    reference = np.stack([noiseless.before_e, noiseless.after_e])
    known = setup_of(setting, setting.truth[None].copy())
    return Job(before, after, setup_of(setting, start), reference, known)


@dataclass(frozen=True, eq=False)
class Answer:
    """What an estimator made of one job; `failures` counts regions by what went wrong."""

    columns: dict[str, FloatArray] = field(default_factory=dict)
    failures: dict[str, int] = field(default_factory=dict)
    seconds: float = float("nan")
    processor_seconds: float = float("nan")
    peak_mb: float = float("nan")

    def line(self) -> str:
        """Write it as one line of JSON."""
        columns = {name: values.tolist() for name, values in self.columns.items()}
        return _Line.model_construct(**{**vars(self), "columns": columns}).model_dump_json()

    @classmethod
    def of_line(cls, line: bytes, count: int) -> Answer:
        """Read a line about so many regions, or raise ValueError."""
        found = model_of(_Line, line)
        columns = {name: np.array(values, float) for name, values in found.columns.items()}
        named = {name.removeprefix("sigma_") for name in columns} <= {*COLUMNS}
        if not named or any(values.size != count for values in columns.values()):
            raise ValueError(f"its columns are not {', '.join(COLUMNS)} of {count} regions")
        if _answered(columns) + sum(found.failures.values()) != count:
            raise ValueError(f"it does not account for {count} regions")
        numbers = np.array([found.seconds, found.processor_seconds, found.peak_mb], float)
        return cls(columns, found.failures, *numbers.tolist())


_Number = Annotated[float, Field(allow_inf_nan=False)] | None
_Reason = Annotated[str, Field(max_length=_LONGEST_REASON)]


class _Line(BaseModel):
    """What a line of the answers' file holds."""

    model_config = ConfigDict(extra="forbid")

    columns: dict[str, list[_Number]]
    failures: dict[_Reason, Annotated[int, Field(ge=1)]]
    seconds: _Number
    processor_seconds: _Number
    peak_mb: _Number


def run_estimator(
    estimator: Estimator, jobs: Sequence[Job], limit_s: float, paths: Sequence[str] = ()
) -> list[Answer]:
    """Let an estimator do jobs in a process of its own, within a time for all of them.

    What it did not answer is counted as failed, with the reason.
    """
    # What the child left there may refuse to be removed.
    with tempfile.TemporaryDirectory(prefix="estimator-", ignore_cleanup_errors=True) as name:
        request, answers = (Path(name) / part for part in ("request", "answers"))
        request.write_bytes(pickle.dumps((estimator, list(jobs), [*paths])))
        answers.touch()
        why = _run([sys.executable, "-m", __name__, str(request), str(answers)], limit_s)
        done, refused = read_answers(answers, [len(job.before) for job in jobs])
    missing = [Answer(failures={refused or why: len(job.before)}) for job in jobs[len(done) :]]
    return [*done, *missing]


def _run(command: Sequence[str], limit_s: float) -> str:
    """Run a command within a time, end all that it started, and say how it ended."""
    reading, writing = os.pipe()
    last_words = bytearray()
    reader = threading.Thread(target=_keep_end, args=(reading, last_words), daemon=True)
    try:
        child = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=writing,
            start_new_session=True,
        )  # fmt: skip
    finally:
        os.close(writing)
        reader.start()
    try:
        status = child.wait(limit_s)
    except subprocess.TimeoutExpired:
        return f"no answer within {limit_s:g} s"
    finally:
        _end(child)
        reader.join(GRACE_S)  # a process that left the group may hold the pipe for ever
    lines = bytes(last_words).decode(errors="replace").strip().splitlines()
    # characters of what a process said last
    return f"its process ended with status {status}" + (f": {lines[-1][-200:]}" if lines else "")


def _keep_end(handle: int, kept: bytearray) -> None:
    """Read a pipe to its end, and keep the last of it."""
    with os.fdopen(handle, "rb", buffering=0) as pipe:
        while chunk := pipe.read(_LAST_WORDS):
            kept += chunk
            del kept[:-_LAST_WORDS]


def _end(child: subprocess.Popen[bytes]) -> None:
    """End a process and its group, which are asked first and then killed."""
    if sys.platform == "win32":
        child.kill()
        return
    for number in (signal.SIGTERM, signal.SIGKILL):
        with suppress(OSError):
            os.killpg(child.pid, number)
        with suppress(subprocess.TimeoutExpired):
            child.wait(GRACE_S)


def run_estimators(
    estimators: Sequence[Estimator], jobs: Sequence[Job], limit_s: float, progress: Progress
) -> dict[str, list[Answer]]:
    """Give all estimators the same jobs, one after the other; their answers, by name."""
    answers: dict[str, list[Answer]] = {}
    for done, estimator in enumerate(estimators, 1):
        paths = [path for path in sys.path if path]
        answers[estimator.name] = run_estimator(estimator, jobs, limit_s, paths)
        progress("estimators", done, len(estimators))
    return answers


def read_answers(path: Path, counts: Sequence[int]) -> tuple[list[Answer], str]:
    """Read answers that are whole, about so many regions each; and say why others are refused."""
    done: list[Answer] = []
    try:
        if path.is_symlink():
            raise ValueError("their file is a link")
        lines = read_bytes(path, _MOST_BYTES * (len(counts) + sum(counts))).split(b"\n")[:-1]
        if len(lines) > len(counts):
            raise ValueError(f"there are {len(lines)}, and {len(counts)} were asked for")
        for line, count in zip(lines, counts, strict=False):
            done.append(Answer.of_line(line, count))
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else None
        return done, f"its answers are refused: {why or first_line(error)}"
    return done, ""


def answer(estimate: Estimate, job: Job) -> Answer:
    """Do one job: the reference, which also compiles what is to be compiled, then all regions."""
    count = len(job.before)
    factor = _mass_per_amplitude(estimate, job)
    clock, processor = time.perf_counter(), time.process_time()
    failures: dict[str, int] = {}
    try:
        columns = checked_table(estimate(job.before, job.after, job.setup), count)
    except Exception:
        columns = _one_by_one(estimate, job, failures)
    clock, processor = time.perf_counter() - clock, time.process_time() - processor
    for prefix, scale in (("", factor), ("sigma_", abs(factor))):
        amplitude = columns.pop(f"{prefix}amplitude", None)
        if amplitude is not None:
            columns.setdefault(f"{prefix}mass_kda", scale * amplitude)
    if unanswered := count - _answered(columns) - sum(failures.values()):
        failures["no number"] = unanswered
    return Answer(columns, failures, clock, processor, _peak_mb())


def _answered(columns: Mapping[str, FloatArray]) -> int:
    """Count the regions for which there is a number other than an error."""
    values = [v for name, v in columns.items() if not name.startswith("sigma_")]
    return int(np.isfinite(values).any(axis=0).sum()) if values else 0


def _one_by_one(estimate: Estimate, job: Job, failures: dict[str, int]) -> dict[str, FloatArray]:
    """Give the regions one at a time, so that one that fails costs no other."""
    count = len(job.before)
    columns: dict[str, FloatArray] = {}
    for i in range(count):
        before, after = job.before[i : i + 1], job.after[i : i + 1]
        try:
            row = checked_table(estimate(before, after, job.setup.of(i, i + 1)), 1)
        except Exception as error:
            text = f"{type(error).__name__}: {first_line(error)}"[:_LONGEST_REASON]
            why = text.encode(errors="replace").decode()  # JSON has no halves of characters
            failures[why] = failures.get(why, 0) + 1
            continue
        for name, value in row.items():
            columns.setdefault(name, np.full(count, np.nan))[i] = value[0]
    return columns


def _mass_per_amplitude(estimate: Estimate, job: Job) -> float:
    """Calibrate the amplitude as well as can be: on the noiseless image of a known mass."""
    before, after = job.reference[:1], job.reference[1:]
    try:
        row = checked_table(estimate(before, after, job.reference_setup), 1)
    except Exception:
        return float("nan")
    amplitude = row.get("amplitude", np.full(1, np.nan))[0]
    return float(job.reference_setup.start[0, 3] / amplitude) if amplitude else float("nan")


def _peak_mb() -> float:
    """Give the most memory that this process ever held; NaN where the system does not tell."""
    try:
        import resource
    except ImportError:
        return float("nan")
    kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(kilobytes * (1 if sys.platform == "darwin" else 1024) / 2.0**20)


def main(request: str, answers: str) -> int:
    """Do what a file asks for; 1 where the estimator cannot be had."""
    loaded: Any = pickle.loads(Path(request).read_bytes())
    estimator, jobs, paths = loaded
    sys.path[:0] = [path for path in paths if path not in sys.path]
    try:
        estimate = estimator.load()
    except Exception as error:
        sys.stderr.write(f"{first_line(error)}\n")
        return 1
    with Path(answers).open("a", encoding="utf-8") as file:
        for job in jobs:
            file.write(f"{answer(estimate, job).line()}\n")
            file.flush()
    return 0


if __name__ == "__main__":
    # what is pickled has to be of the module that the parent knows, which is not __main__
    from iscat_contest.process import main as run

    sys.exit(run(*sys.argv[1:]))
