"""Where a mass line meets a table of events: its contrasts become masses, and the errors follow."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from iscat_analysis.calibration.mass.result import (
    MassCalibration,
    line_sigma_kda,
    mass_from_contrast,
)
from iscat_analysis.calibration.mass.standards import Standards, contrast_over
from iscat_analysis.config import Calibration, Config, StandardsCamera, load_config, parse_config
from iscat_analysis.config.files import read_toml
from iscat_analysis.config.overrides import Source
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.reading import is_file, is_folder
from iscat_analysis.records import FloatArray, Status

Line: TypeAlias = str | Path | Calibration | MassCalibration
"""A mass line: the file that ``iscat calibrate mass`` writes, its section, or what measured it."""

_SAME = 1e-3  # by which masses of two lines may differ that are one but for rounding


def mass_line(given: Line) -> Calibration:
    """Give the line of a file or a calibration."""
    if isinstance(given, Calibration):
        return given
    where = "`calibration`"
    if isinstance(given, MassCalibration):
        values = tomllib.loads(given.to_toml())
    elif isinstance(given, (str, Path)):
        path, where = Path(given), str(given)
        values = read_toml(path / "calibration.toml" if is_folder(path) else path)
    else:
        raise ConfigError(
            f"`calibration`: is {type(given).__name__}; give the path of a mass line, as iscat "
            "calibrate mass writes it, or what `calibrate_mass` returns"
        )
    own = {key: value for key, value in values.items() if key == "calibration"}
    line = parse_config(own, where=where).calibration
    if line is None:
        raise ConfigError(
            f"{where}: has no section [calibration]; give the mass line that iscat calibrate mass "
            "writes, calibration.toml"
        )
    return line


def with_line(
    config: Source | Sequence[Source] | None, calibration: Line | None
) -> Source | Sequence[Source] | None:
    """Add a line to what `configure` is given, in place of the lines that are in it."""
    if calibration is None:
        return config
    given: list[Any] = [*config] if isinstance(config, (list, tuple)) else [config]
    line = mass_line(calibration).model_dump(exclude_none=True)
    return [*filter(None, given), {"calibration": line}]


def made_with(table: pd.DataFrame) -> Config | None:
    """Read the configuration with which a table of ours was made; None where it is not known."""
    path = Path(table.attrs.get("file", ""))
    beside = path.with_name("config.toml") if path.name else path
    if path.stem != "fits" or not is_file(beside):
        return None
    try:
        return load_config(beside)
    except ConfigError:
        return None


def measured_contrasts(table: pd.DataFrame, source: object) -> pd.DataFrame:
    """Select the events whose contrasts are right, with the errors of these where they are known.

    Optics that a line does not fit make the masses wrong, not the contrasts.
    """
    if len(table) and table["contrast"].isna().all():
        raise DataError(
            f"{source}: has masses and no contrasts, which a calibration begins with; export the "
            "table with contrasts"
        )
    if "status" in table:
        table = table[table["status"].isin([Status.OK.value, Status.UNCALIBRATED_OPTICS.value])]
    if "sigma_mass_kda" in table and table["sigma_mass_kda"].notna().any():
        relative = table["sigma_mass_kda"] / table["mass_kda"].abs()
        table = table.assign(sigma_contrast=relative * table["contrast"].abs())
    if not table["contrast"].notna().any():
        raise DataError(
            f"{source}: holds no event with status ok and a contrast; a calibration needs landing "
            "events of the standards"
        )
    return table


def weighed(table: pd.DataFrame, line: Calibration, source: object) -> tuple[pd.DataFrame, str]:
    """Give the events of a table the masses of a line, and say what of its own masses is replaced.

    Where the optics of both are known, the model converts the line from one to the other.
    """
    table = measured_contrasts(table, source)
    contrast = table["contrast"].to_numpy(float)
    ratio = _ratio(table, line, source)
    mass = mass_from_contrast(contrast / ratio, line.gradient_per_kda, line.offset)
    made = table.assign(mass_kda=mass)
    own = table["mass_kda"].to_numpy(float)
    if "sigma_contrast" in table:
        error = table["sigma_contrast"].to_numpy(float) / ratio
        made["sigma_mass_kda"] = error / abs(line.gradient_per_kda)
    made = made.drop(columns="systematic_mass_kda", errors="ignore")
    if line.gradient_se_per_kda or line.offset_se:
        shared = made.get("systematic_contrast", pd.Series(0.0, made.index)).fillna(0.0)
        made["systematic_mass_kda"] = line_sigma_kda(
            mass, line.gradient_per_kda, _covariance(line), shared.to_numpy(float) / ratio
        )
    made = made.drop(columns=["sigma_contrast", "systematic_contrast"], errors="ignore")
    if "status" in made:
        made["status"] = Status.OK.value
    known = np.isfinite(own) & np.isfinite(mass) & (own != 0)
    times = float(np.median(np.abs(mass[known] / own[known]))) if known.any() else 1.0
    if abs(times - 1) < _SAME:
        return made, ""
    return made, f"masses are those of `calibration`, {times:.4g} times the table's own (median)"


def _covariance(line: Calibration) -> FloatArray:
    both = line.correlation * line.gradient_se_per_kda * line.offset_se
    return np.array([[line.gradient_se_per_kda**2, both], [both, line.offset_se**2]])


def _ratio(table: pd.DataFrame, line: Calibration, source: object) -> float:
    """Contrast per mass of a table over that of the standards; 1 where optics are not known."""
    config = made_with(table)
    if config is None or line.optics is None:
        return 1.0
    height = config.particle.nominal_height_nm if line.height_nm is None else line.height_nm
    camera = line.camera or StandardsCamera()
    ratio, refusal = contrast_over(config, Standards(line.optics, line.covariance, height, camera))
    if refusal:
        raise DataError(
            f"{source}: `calibration` is of other optics, and the model does not convert it: "
            f"{refusal}; calibrate with standards in the optics of this table"
        )
    return ratio
