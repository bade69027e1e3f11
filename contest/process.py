"""Run an estimator in a process of its own, which may fail, hang or grow without harm to others.

The parent writes what is asked for into a file, and starts this module; the child adds an answer
to another file as soon as a job is done.  What is there when the time is up counts.
"""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from iscat_analysis.reading import first_line
from iscat_analysis.records import FloatArray, Progress
from iscat_analysis.study import EstimatorSetup, Setting, setup_of
from iscat_contest.estimators import Estimate, Estimator, checked_table


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
        return json.dumps({**vars(self), "columns": columns})

    @classmethod
    def of_line(cls, line: str) -> Answer:
        """Read a line."""
        found = json.loads(line)
        columns = {name: np.array(values, float) for name, values in found["columns"].items()}
        return cls(**{**found, "columns": columns})


def run_estimator(
    estimator: Estimator, jobs: Sequence[Job], limit_s: float, paths: Sequence[str] = ()
) -> list[Answer]:
    """Let an estimator do jobs in a process of its own, within a time for all of them.

    What it did not answer is counted as failed, with the reason.
    """
    with tempfile.TemporaryDirectory(prefix="estimator-") as name:
        request, answers, said = (Path(name) / part for part in ("request", "answers", "said"))
        request.write_bytes(pickle.dumps((estimator, list(jobs), [*paths])))
        answers.touch()
        command = [sys.executable, "-m", __name__, str(request), str(answers)]
        with said.open("wb") as stream:
            try:
                ended = subprocess.run(
                    command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=stream,
                    timeout=limit_s, check=False,
                )  # fmt: skip
                lines = said.read_text(encoding="utf-8", errors="replace").strip().splitlines()
                # characters of what a process said last
                last = f": {lines[-1][-200:]}" if lines else ""
                why = f"its process ended with status {ended.returncode}{last}"
            except subprocess.TimeoutExpired:
                why = f"no answer within {limit_s:g} s"
        done = _read(answers)
    missing = [Answer(failures={why: len(job.before)}) for job in jobs[len(done) :]]
    return [*done, *missing]


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


def _read(path: Path) -> list[Answer]:
    """Read the answers that are whole, of a process that runs what others wrote."""
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    return [Answer.of_line(line) for line in lines if line.endswith("\n")]


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
    values = [v for name, v in columns.items() if not name.startswith("sigma_")]
    answered = int(np.isfinite(values).any(axis=0).sum()) if values else 0
    if unanswered := count - answered - sum(failures.values()):
        failures["no number"] = unanswered
    return Answer(columns, failures, clock, processor, _peak_mb())


def _one_by_one(estimate: Estimate, job: Job, failures: dict[str, int]) -> dict[str, FloatArray]:
    """Give the regions one at a time, so that one that fails costs no other."""
    count = len(job.before)
    columns: dict[str, FloatArray] = {}
    for i in range(count):
        before, after = job.before[i : i + 1], job.after[i : i + 1]
        try:
            row = checked_table(estimate(before, after, job.setup.of(i, i + 1)), 1)
        except Exception as error:
            why = f"{type(error).__name__}: {first_line(error)}"
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
