"""Small systems on some of the parameters, against LAPACK."""

from __future__ import annotations

import numpy as np
import pytest

from iscat_analysis._kernels.hessian import invert
from iscat_analysis._kernels.loops import factorise
from iscat_analysis._kernels.scoring import scoring_step

UNITS = np.array([1e-3, 2e-3, 5e-4, 40.0, 1.0])  # of numbers as different as nm and amplitudes
CHOSEN = [(0, 1, 3, 4), (0, 1, 2, 3, 4), (2,)]


def _matrix(seed: int) -> np.ndarray:
    parts = np.random.default_rng(seed).normal(size=(5, 12))
    return UNITS[:, None] * (parts @ parts.T) * UNITS


@pytest.mark.parametrize("chosen", CHOSEN)
@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_a_step_an_inverse_and_a_factor_of_some_parameters(
    chosen: tuple[int, ...], damping: float
) -> None:
    matrix, score = _matrix(1), np.random.default_rng(2).normal(size=5)
    index = np.array(chosen)
    part = matrix[np.ix_(index, index)]
    scale = 1 / np.sqrt(np.diag(matrix))
    lower = np.zeros((index.size, index.size))
    assert factorise(matrix, index, scale[index], damping, lower)
    scaled = part * np.outer(scale[index], scale[index]) + damping * np.eye(index.size)
    np.testing.assert_allclose(lower, np.linalg.cholesky(scaled), atol=1e-13)

    active, step, inverse = np.isin(np.arange(5), index), np.empty(5), np.empty((5, 5))
    assert scoring_step(score, matrix, active, damping, step)
    damped = part + damping * np.diag(np.diag(part))
    np.testing.assert_allclose(step[index], np.linalg.solve(damped, score[index]), rtol=1e-9)
    assert invert(matrix, matrix, active, inverse)
    np.testing.assert_allclose(inverse[np.ix_(index, index)], np.linalg.inv(part), rtol=1e-9)
    assert not step[~active].any()
    assert not inverse[~active].any()


def test_what_is_not_positive_is_refused() -> None:
    matrix = _matrix(3)
    matrix[1], matrix[:, 1] = matrix[0] * 2, matrix[:, 0] * 2
    matrix[1, 1] = 4 * matrix[0, 0]
    scale, active = 1 / np.sqrt(np.diag(matrix)), np.ones(5, bool)
    lower, step, inverse = np.zeros((5, 5)), np.empty(5), np.empty((5, 5))
    assert not factorise(matrix, np.arange(5), scale, 0.0, lower)
    assert not scoring_step(np.ones(5), matrix, active, 0.0, step)
    assert not invert(matrix, matrix, active, inverse)
    assert np.isnan(inverse).all()
    assert scoring_step(np.ones(5), matrix, active, 0.1, step)
    assert not factorise(np.full((5, 5), np.nan), np.arange(5), scale, 0.0, lower)
