"""Estimators whose faults are known, which tests name as estimators_for_tests:FUNCTION."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from iscat_analysis.study import EstimatorSetup


def raises(*given: Any) -> dict[str, Any]:
    raise ZeroDivisionError(f"by design, of {len(given)}")


def raises_for_some(before: Any, _after: Any, setup: EstimatorSetup) -> dict[str, Any]:
    if len(before) > 1 or setup.start[0, 0] % 2 < 1:
        raise ValueError("a bad one")
    return {"x_nm": setup.start[:, 0]}


def hangs(*given: Any) -> dict[str, Any]:
    time.sleep(3600)
    return {"x_nm": np.zeros(len(given[0]))}


def gives_nan(*given: Any) -> dict[str, Any]:
    count = len(given[0])
    return {"x_nm": np.full(count, np.nan), "mass_kda": np.full(count, np.inf)}


def gives_a_list(*given: Any) -> list[float]:
    return [float(len(given))]


def ends_its_process(*given: Any) -> None:
    os._exit(4 + len(given))


def amplitude_of_the_middle(before: Any, after: Any, setup: EstimatorSetup) -> dict[str, Any]:
    image = setup.image(before, after)
    half = image.shape[1] // 2
    return {"amplitude": 1e6 * image[:, half, half], "sigma_amplitude": np.full(len(image), 1e3)}


# ---- hostile ones --------------------------------------------------------------------------------


def leaves_children(*given: Any) -> dict[str, Any]:
    """Start processes that outlive it and do not listen; their numbers stand beside its answers."""
    children = []
    for _ in range(20):
        if (child := os.fork()) == 0:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            time.sleep(3600)
            os._exit(0)
        children.append(child)
    Path(os.environ["CHILDREN"]).write_text(json.dumps(children), encoding="utf-8")
    return hangs(*given) if os.environ["HANG"] else {"x_nm": np.zeros(len(given[0]))}


def leaves_its_group(*given: Any) -> None:
    child = subprocess.Popen(
        [sys.executable, "-c", "import time; time.sleep(60)"], start_new_session=True
    )
    Path(os.environ["CHILDREN"]).write_text(json.dumps([child.pid]), encoding="utf-8")
    os._exit(4 + len(given))


def shouts(*given: Any) -> None:
    """Write 300 MB to its standard error, and a last line."""
    for _ in range(300):
        os.write(2, b"x" * 1_000_000)
    os.write(2, b"\nthe last line\n")
    os._exit(len(given))


def replaces_its_answers(*_: Any) -> None:
    """Put something else in the place of its answers, which is named in its command line."""
    answers, what = Path(sys.argv[2]), os.environ["ANSWERS"]
    answers.unlink()
    if what == "pipe":
        os.mkfifo(answers)
    elif what == "folder":
        answers.mkdir()
        (answers / "shut").mkdir(mode=0)
    elif what != "nothing":
        answers.symlink_to(what)
    os._exit(0)


def reads_the_truth(before: Any, _after: Any, _setup: Any) -> dict[str, Any]:
    """Look for the truth of a challenge, and blur it so that nobody wonders."""
    found = json.loads((Path(os.environ["CHALLENGE"]) / "truth.json").read_text(encoding="utf-8"))
    masses = np.array([one["mass_kda"] for one in found["events"]])
    return {
        "mass_kda": masses[: len(before)] * np.random.default_rng(1).normal(1, 0.1, len(before))
    }
