"""Estimators that can be compared: what they are given, what they return, and which there are.

An estimator is a function ``(before, after, setup) -> table``.  `before` and `after` are the
photoelectrons summed over the frames before and with the particle, (n, y, x), and `setup` says what
is known of the experiment.  The table has any of the columns ``x_nm``, ``y_nm``, ``z_nm``,
``mass_kda`` or ``amplitude``, and ``sigma_*`` of each; ``index`` says which region a row is of, and
may be left out where there is a row for each.  An amplitude of any unit becomes a mass by one
factor, from the noiseless image of a particle of known mass.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.errors import ConfigError
from iscat_analysis.reading import first_line
from iscat_analysis.records import PARAMETERS, FloatArray
from iscat_analysis.study import EstimatorSetup

GROUP = "iscat_analysis.estimators"
"""Entry points of packages that offer estimators."""

TRUSTED = "trusted code: they could read what the user can, a truth that is at hand among it"
"""What scores say of estimators of others: no system walls off processes of one user."""

COLUMNS = (*PARAMETERS, "amplitude")
"""What an estimator may return, each also with ``sigma_`` before its name."""


Estimate = Callable[[FloatArray, FloatArray, EstimatorSetup], Any]
"""The function itself; it returns a DataFrame, or a mapping of columns."""


@dataclass(frozen=True)
class Estimator:
    """Where an estimator is found; `module` is what `install` installs for it, if anything."""

    name: str
    target: str
    about: str = ""
    module: str = ""
    install: str = ""

    @property
    def missing(self) -> str:
        """Say what has to be installed; empty where nothing is missing."""
        package = self.module.partition(".")[0]
        if not package or find_spec(package) is not None:
            return ""
        return f"not installed: pip install {self.install}"

    def load(self) -> Estimate:
        """Import the function."""
        if self.missing:
            raise ConfigError(f"estimator {self.name}: {self.missing}")
        module, _, function = self.target.partition(":")
        try:
            found = import_module(module)
            for part in function.split("."):
                found = getattr(found, part)
        except Exception as error:
            raise ConfigError(
                f"estimator {self.name}: {self.target} cannot be imported "
                f"({type(error).__name__}: {first_line(error)})"
            ) from None
        if not callable(found):
            raise ConfigError(f"estimator {self.name}: {self.target} is no function")
        made: Estimate = found
        return made


_ABOUT = {
    "iscat": "this program's fit, in the mode that is studied",
    "gauss-ls": "Gaussian on the contrast, least squares",
    "gauss-mle": "Gaussian on the counts, maximum likelihood",
    "matched-filter": "highest correlation with the model",
    "dog": "highest difference of Gaussians",
    "radial-symmetry": "centre of the gradients' lines",
    "centroid": "centre of mass of the contrast",
    "peak": "highest pixel",
    "picasso-gausslq": "Picasso's Gaussian, least squares",
    "picasso-gaussmle": "Picasso's Gaussian, maximum likelihood",
    "piscat": "PiSCAT's Gaussian, least squares",
    "trackpy": "trackpy's refined centre of mass",
}
_PACKAGES = {
    "picasso": '"iscat-analysis[picasso]"',
    # Its requirements, which the fit does not use, contradict ours: pandas < 2.
    "piscat": "--no-deps piscat==1.1.4",
    "trackpy": "",
}


def _built_in(name: str, about: str) -> Estimator:
    """Make the estimator of a function in `simple`, or in `peers` if it is of another package."""
    package = name.partition("-")[0]
    install = _PACKAGES.get(package)
    module, needed = ("simple", "") if install is None else ("peers", package)
    target = f"iscat_contest.{module}:{name.replace('-', '_')}"
    return Estimator(name, target, about, needed, install or "")


BUILT_IN = tuple(_built_in(*named) for named in _ABOUT.items())
"""What can be named without a module; nothing of it is imported before it is run."""


def known_estimators() -> tuple[Estimator, ...]:
    """List the built-in estimators and those that other packages offer."""
    names = {one.name for one in BUILT_IN}
    offered = (
        Estimator(point.name, point.value, f"of {point.dist.name if point.dist else point.module}")
        for point in entry_points(group=GROUP)
    )
    return (*BUILT_IN, *(one for one in offered if one.name not in names))


def find_estimator(text: str) -> Estimator:
    """Find an estimator by its name, or by the PACKAGE:FUNCTION that it is."""
    known = {one.name: one for one in known_estimators()}
    if text in known:
        return known[text]
    module, colon, function = text.partition(":")
    named = all(part.isidentifier() for part in (*module.split("."), *function.split(".")))
    if not colon or not named:
        raise ConfigError(
            f"estimator {text!r}: is neither PACKAGE:FUNCTION nor one of {', '.join(known)}"
        )
    return Estimator(text, text)


def checked_table(table: Any, count: int) -> dict[str, FloatArray]:
    """Put what an estimator returned into one row for each region; NaN where it gave none.

    Shapes: columns (count,).
    """
    if not isinstance(table, (pd.DataFrame, Mapping)):
        raise ConfigError(f"returned {type(table).__name__}, no table (DataFrame or dict)")
    columns = {str(name): np.asarray(table[name]).reshape(-1) for name in table}
    known = [name for name in columns if name.removeprefix("sigma_") in COLUMNS]
    if not set(known) & set(COLUMNS):
        raise ConfigError(f"returned none of the columns {', '.join(COLUMNS)}")
    lengths = {columns[name].size for name in known}
    index = columns.get("index", np.arange(count))
    if lengths != {index.size}:
        raise ConfigError(
            f"returned {sorted(lengths)} rows for {count} regions: give one for each, or say which "
            "in a column index"
        )
    rows = np.asarray(index, dtype=np.int64)
    if np.any(rows != index) or np.any((rows < 0) | (rows >= count)):
        raise ConfigError(f"returned an index that is not one of 0 … {count - 1}")
    if np.unique(rows).size != rows.size:
        raise ConfigError("returned two rows for one region")
    out = {name: np.full(count, np.nan) for name in known}
    for name, values in out.items():
        given = columns[name].astype(np.float64)
        values[rows] = np.where(np.isfinite(given), given, np.nan)
    return out
