"""Profiles between the heights of a table, in vector registers, against the polynomial itself."""

from __future__ import annotations

import numpy as np
import pytest

from iscat_analysis._kernels.radial import AxialTable, profile_at

ROUNDING = 1e-13


def reference(table: AxialTable, z_nm: float) -> list[np.ndarray]:
    """Profile (channels, width) at a height and its derivatives along z, by solving for them."""
    heights, first_nm, step_nm, kappa = table
    i = int((z_nm - first_nm) / step_nm)
    t = (z_nm - first_nm) / step_nm - i
    k = np.arange(6)
    rows = []  # value, slope and second derivative at both ends, of six powers
    for end in (0.0, 1.0):
        rows += [end**k, k * end ** np.maximum(k - 1, 0), k * (k - 1) * end ** np.maximum(k - 2, 0)]
    known = heights[i : i + 2].reshape(6, -1)
    powers = np.linalg.solve(np.array(rows), known).reshape(6, *heights.shape[2:])
    plain = [
        np.tensordot(factor / step_nm**order, powers, 1)
        for order, factor in enumerate((
            t**k, k * t ** np.maximum(k - 1, 0), k * (k - 1) * t ** np.maximum(k - 2, 0)
        ))
    ]  # fmt: skip
    f, d, b = (part[0::2] + 1j * part[1::2] for part in plain)
    turn = np.exp(1j * kappa * z_nm)
    full = [f, d + 1j * kappa * f, b + 2j * kappa * d - kappa**2 * f]
    return [np.stack([(o * turn).real, (o * turn).imag], 1).reshape(-1, f.shape[1]) for o in full]


@pytest.mark.parametrize("orders", [1, 2, 3])
@pytest.mark.parametrize("z_nm", [10.0, 37.5, 69.999])
@pytest.mark.parametrize("stop", [12, 16, 30])
def test_radial(orders: int, z_nm: float, stop: int) -> None:
    rng = np.random.default_rng(orders)
    table = AxialTable(rng.normal(size=(4, 3, 4, 30)), 10.0, 20.0, 0.02)
    got = np.full((5, 6, 4 * orders), np.nan)
    profile_at(table, z_nm, 0, stop, got)
    flat = got.reshape(30, 4 * orders).T
    want = np.concatenate(reference(table, z_nm)[:orders])
    np.testing.assert_allclose(flat[:, :stop], want[:, :stop], rtol=ROUNDING, atol=ROUNDING)
    assert np.isnan(flat[:, stop:]).all()


@pytest.mark.parametrize("orders", [1, 2, 3])
@pytest.mark.parametrize("components", [1, 2])
@pytest.mark.parametrize("span", [(0, 25), (3, 11), (5, 22)])
def test_lattice(orders: int, components: int, span: tuple[int, int]) -> None:
    rng = np.random.default_rng(orders)
    table = AxialTable(rng.normal(size=(4, 3, 2 * components, 25)), 10.0, 20.0, 0.02)
    got = np.full((2 * components * orders, 5, 5), np.nan)
    profile_at(table, 53.0, *span, got)
    flat, inside = got.reshape(-1, 25), slice(*span)
    want = np.concatenate(reference(table, 53.0)[:orders])
    np.testing.assert_allclose(flat[:, inside], want[:, inside], rtol=ROUNDING, atol=ROUNDING)
    flat[:, inside] = np.nan
    assert np.isnan(flat).all()
