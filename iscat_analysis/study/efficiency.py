"""Bounds as a service: for those who have simulated, and estimated, by themselves."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.bounds import plan
from iscat_analysis.bounds.experiment import height_of, reach_of
from iscat_analysis.config import Config, configure
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference.checks import choice_in, number_in
from iscat_analysis.movie.tables import refuse_twice
from iscat_analysis.optics.forward import forward_model
from iscat_analysis.records import FREE_PARAMETERS, PARAMETERS, FloatArray
from iscat_analysis.study.setting import OF_DIPOLES
from iscat_analysis.study.yardstick import Limits, limits_at, score_estimates

_MASS_STEP = 0.02
_Z_STEP_NM = 2.0
"""Particles nearer to each other than this have one bound."""

Setup = str | Path | Mapping[str, Any] | Config


def bounds_for(setup: Setup, *, mode: str | None = None) -> pd.DataFrame:
    """Give what no estimate can beat, for the particle and the frames of ``[bounds]``.

    Parameters
    ----------
    setup : str, Path, mapping or Config
        A configuration, or where it is.
    mode : {"mass", "localize", "joint"}, optional
        Which parameters are free; default ``fit.mode``.

    Returns
    -------
    pandas.DataFrame
        A row for each free parameter, in nm and kDa.  ``crb`` is the Cramér–Rao bound with the
        others unknown, ``crb_single`` with all else known; ``qcrb`` the quantum bound, of any
        measurement of the collected light; ``holevo`` what one measurement of all free parameters
        can reach at best.

    Raises
    ------
    ConfigError
        The configuration is impossible, or has no pixel size.

    Notes
    -----
    Physics: Dong et al., J. Phys. D 54, 394002 (2021), and the manual's page on bounds.
    """
    config, free = _resolved(setup, mode)
    experiment = plan(config)
    truth = np.array([*experiment.theta[:3], experiment.mass_kda])
    limits = limits_at(experiment, free, truth[None])
    single = experiment.bounds(free).crb_single[[PARAMETERS.index(name) for name in free]]
    columns = {"crb": limits.crb[0], "crb_single": single}
    columns |= {"qcrb": limits.qcrb[0], "holevo": limits.holevo[0]}
    table = pd.DataFrame(columns, index=pd.Index(free, name="parameter"))
    table.attrs["n_scattered"] = float(experiment.collected)
    return table


def efficiency(
    estimates: pd.DataFrame | Mapping[str, Any],
    truth: pd.DataFrame | Mapping[str, Any],
    setup: Setup,
    *,
    mode: str | None = None,
    seed: int = 1,
) -> pd.DataFrame:
    """Score estimates against the truth and the bounds of the experiment that they are of.

    Parameters
    ----------
    estimates : DataFrame or mapping of columns
        Any of ``x_nm``, ``y_nm``, ``z_nm``, ``mass_kda``, each with ``sigma_*`` where the estimator
        gives errors.  A row that failed has NaN, or is missing.
    truth : DataFrame or mapping of columns
        The same columns, for every free parameter that varies; ``z_nm`` and ``mass_kda`` may be
        left out where they are those of the configuration.  Where both tables have a column
        ``event``, rows are matched by it; otherwise both have the same rows.  Positions count from
        the centre of the first pixel of the region, or of anything else, for both alike.
    setup : str, Path, mapping or Config
        The configuration; ``[bounds]`` says how many frames and photons, for each particle alone.
    mode : {"mass", "localize", "joint"}, optional
        Which parameters the estimator had to find; default ``fit.mode``.
    seed : int
        Of the bootstrap; the same seed gives the same intervals.

    Returns
    -------
    pandas.DataFrame
        A row for each free parameter: bias, spread, rmse [nm, kDa], the bounds, ``efficiency_crb``
        (CRB² over mean square error), ratios of the spread to CRB, QCRB and Holevo bound, the
        gradient of the bias and the bound of an estimator that has it, width of the pulls and
        coverage of its own errors, each with ``_ci95``; ``below_bound`` and a ``verdict`` in words.

    Raises
    ------
    DataError
        The tables do not go together, or have no parameter in common.
    ConfigError
        The configuration is impossible.

    Notes
    -----
    Bound of biased estimators: H. L. Van Trees, Detection, Estimation, and Modulation Theory I
    (1968), section 2.4.2.
    """
    config, free = _resolved(setup, mode)
    seed = int(number_in("`seed`", seed, least=0, whole=True))
    columns, truths = matched(_table("estimates", estimates), _table("truth", truth), config, free)
    scored = score_estimates(columns, limits_of_many(config, free, truths), seed)
    if not scored:
        raise DataError(f"estimates: has none of the columns {', '.join(free)}")
    return pd.DataFrame(scored.values(), index=pd.Index(scored.keys(), name="parameter"))


def _table(name: str, value: Any) -> pd.DataFrame:
    """Make a table of what is one, with columns of different names."""
    if not isinstance(value, (pd.DataFrame, Mapping)):
        raise ConfigError(f"`{name}`: is {type(value).__name__}; give a table with columns as x_nm")
    try:
        table = pd.DataFrame(value)
    except (TypeError, ValueError) as error:
        raise DataError(f"{name}: is no table ({error})") from None
    refuse_twice(list(table.columns), table.columns, name)
    return table


def _numbers(table: pd.DataFrame, name: str) -> FloatArray:
    """Give the numbers of a column, NaN where a cell holds none.

    Shapes: result (n,).
    """
    cells = table[name].map(lambda cell: cell if isinstance(cell, (Real, str)) else math.nan)
    return np.asarray(pd.to_numeric(cells, errors="coerce"), dtype=float)


def limits_of_many(
    config: Config,
    free: tuple[str, ...],
    truths: FloatArray,
    frames: list[tuple[int, int]] | None = None,
) -> Limits:
    """Give the bounds of many particles, each alone in the middle of a field.

    Shapes: `truths` (n, 4).
    """
    highest = max(truths[:, 2].max() + _Z_STEP_NM, height_of(config))
    highest = max(float(highest), config.particle.nominal_height_nm)
    model = forward_model(config, reach_of(config), z_max_nm=highest)
    experiment = plan(config, model=model)
    height = np.round(truths[:, 2] / _Z_STEP_NM) * _Z_STEP_NM
    with np.errstate(divide="ignore", invalid="ignore"):
        mass = np.exp(np.round(np.log(np.abs(truths[:, 3])) / _MASS_STEP) * _MASS_STEP)
    at = config.bounds
    pairs = np.array(frames if frames is not None else [(at.n_before, at.n_after)] * len(truths))
    keys = np.column_stack([height, mass, pairs])
    kinds, inverse = np.unique(keys, axis=0, return_inverse=True)
    places = np.insert(kinds[:, :2], [0], [at.x_nm, at.y_nm], axis=1)
    one = limits_at(experiment, free, places, frames=kinds[:, 2:].astype(int).tolist())
    return replace(one.for_rows(inverse.reshape(-1).tolist()), truths=truths)


def _resolved(setup: Setup, mode: str | None) -> tuple[Config, tuple[str, ...]]:
    config = configure(setup)
    name = config.fit.mode if mode is None else mode
    choice_in("mode", name, OF_DIPOLES)
    return config.changed(fit={"mode": name}), FREE_PARAMETERS[name]


def matched(
    estimates: pd.DataFrame, truth: pd.DataFrame, config: Config, free: tuple[str, ...]
) -> tuple[dict[str, FloatArray], FloatArray]:
    """Put both tables into the rows of the truth.

    Shapes: columns (n,), truths (n, 4).
    """
    if "event" in estimates and "event" in truth:
        for name, table in (("estimates", estimates), ("truth", truth)):
            twice = table["event"][table["event"].duplicated()]
            if len(twice):
                raise DataError(f"{name}: event {twice.iloc[0]} is there twice; give each one row")
        estimates = estimates.set_index("event").reindex(truth["event"])
    elif len(estimates) != len(truth):
        raise DataError(
            f"estimates: has {len(estimates)} rows and truth {len(truth)}; give both a column "
            "event, or the same rows"
        )
    if not len(truth):
        raise DataError("truth: has no rows")
    usual = {"z_nm": height_of(config)}
    if "mass_kda" not in truth:
        usual["mass_kda"] = plan(config).mass_kda
    truths = np.empty((len(truth), 4))
    for k, name in enumerate(PARAMETERS):
        if name not in truth and name in estimates and name not in usual:
            raise DataError(f"truth: has no column {name}, which the estimates have")
        truths[:, k] = _numbers(truth, name) if name in truth else usual.get(name, 0.0)
    if not np.all(np.isfinite(truths)):
        raise DataError("truth: is not a finite number in every row")
    columns = {
        name: _numbers(estimates, name)
        for parameter in free
        for name in (parameter, f"sigma_{parameter}")
        if name in estimates
    }
    return columns, truths
