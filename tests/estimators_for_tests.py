"""Estimators whose faults are known, which tests name as estimators_for_tests:FUNCTION."""

from __future__ import annotations

import os
import time
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
