"""The line between contrast and mass, and the conversion of contrasts.

The optics of the standards, which a mass calibration stores.

Contrast per mass depends on the optics with which it was measured.  A calibration that stores them
can be used for movies with other optics too, because the model converts it (`MassScale`).

Where a mass line meets a table of events: its contrasts become masses, and the errors follow.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.special import ndtri

from iscat_analysis.config import (
    MOVING,
    Calibration,
    Config,
    Optics,
    OpticsCovariance,
    Source,
    StandardsCamera,
    load_config,
    parse_config,
    read_toml,
    toml_value,
)
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.findings import Finding, Noted
from iscat_analysis.optics.forward import PEAK_SEARCH_RADIUS, forward_model
from iscat_analysis.reading import is_file, is_folder
from iscat_analysis.records import FloatArray, Status

Landing = Literal["dark", "bright"]


def mass_from_contrast(
    contrast: ArrayLike, gradient_per_kda: float, offset: float = 0.0
) -> FloatArray:
    """Convert signed peak contrasts to masses."""
    if gradient_per_kda == 0 or not math.isfinite(gradient_per_kda):
        raise ConfigError(f"gradient_per_kda = {gradient_per_kda:g} says nothing about mass")
    c = np.asarray(contrast, dtype=np.float64)
    direction = math.copysign(1.0, gradient_per_kda)
    return np.asarray(np.sign(direction * c) * (direction * np.abs(c) - offset) / gradient_per_kda)


def line_sigma_kda(
    mass_kda: ArrayLike,
    gradient_per_kda: float,
    covariance: FloatArray,
    sigma_contrast: ArrayLike = 0.0,
) -> FloatArray:
    """Propagate the errors of the line, and of a contrast, into a mass.

    Shapes: `covariance` (2, 2).
    """
    mass = np.abs(np.asarray(mass_kda, dtype=np.float64))
    variance = (
        np.square(np.asarray(sigma_contrast, dtype=np.float64))
        + mass**2 * covariance[0, 0]
        + 2 * mass * covariance[0, 1]
        + covariance[1, 1]
    )
    return np.asarray(np.sqrt(variance) / abs(gradient_per_kda))


@dataclass(frozen=True)
class ContrastPeak:
    """A peak of |contrast|."""

    contrast: float
    contrast_se: float
    width: float
    count: float


@dataclass(frozen=True, eq=False)
class MassCalibration(Noted):
    """The line between contrast and mass; `calibrate_mass` makes it."""

    gradient_per_kda: float
    offset: float
    covariance: FloatArray
    chi2: float
    dof: int
    standards: pd.DataFrame
    peaks: tuple[ContrastPeak, ...]
    landing: Landing
    events: int
    findings: tuple[Finding, ...] = ()
    recorded: Standards | None = None

    def mass_kda(self, contrast: ArrayLike) -> FloatArray:
        """Convert signed peak contrasts to masses."""
        return mass_from_contrast(contrast, self.gradient_per_kda, self.offset)

    def sigma_kda(self, contrast: ArrayLike, sigma_contrast: ArrayLike = 0.0) -> FloatArray:
        """Give the standard deviation of such a mass."""
        return line_sigma_kda(
            self.mass_kda(contrast), self.gradient_per_kda, self.covariance, sigma_contrast
        )

    def prediction_interval(
        self, contrast: ArrayLike, sigma_contrast: ArrayLike = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """Give the interval that holds the true mass with a probability of 95 %."""
        reach = float(ndtri(0.975)) * self.sigma_kda(contrast, sigma_contrast)
        mass = self.mass_kda(contrast)
        return mass - reach, mass + reach

    def to_toml(self) -> str:
        """Write the section ``[calibration]`` to paste into a configuration.

        The section contains the standard errors of the line and their correlation, from which an
        analysis computes the contribution of the calibration to the error of each mass.  It also
        contains the optics of the standards if they are known.
        """
        s_se, o_se = (math.sqrt(self.covariance[k, k]) for k in (0, 1))
        return (
            "[calibration]\n"
            f"gradient_per_kda = {self.gradient_per_kda:.6g}\n"
            f"offset = {self.offset:.6g}\n"
            f"gradient_se_per_kda = {s_se:.4g}  # {100 * abs(s_se / self.gradient_per_kda):.2g} %\n"
            f"offset_se = {o_se:.4g}\n"
            f"correlation = {self.covariance[0, 1] / (s_se * o_se):.5f}\n"
            f"dof = {self.dof}\n"
            f"{self.recorded.to_toml() if self.recorded else ''}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Give what ``calibration.json`` holds."""
        return {
            "gradient_per_kda": self.gradient_per_kda,
            "gradient_se": math.sqrt(self.covariance[0, 0]),
            "offset": self.offset,
            "offset_se": math.sqrt(self.covariance[1, 1]),
            "covariance": self.covariance.tolist(),
            "chi2": self.chi2,
            "dof": self.dof,
            "landing": self.landing,
            "events": self.events,
            "standards": self.standards.to_dict("records"),
            "peaks": [vars(peak) for peak in self.peaks],
            "notes": list(self.notes),
            "recorded": None if self.recorded is None else self.recorded.to_dict(),
        }


_OF_A_MOVIE = {"file": None, "covariance": None, "calibrate": "auto", **MOVING}
"""Keys of [optics] that do not change the contrast of standards, and their neutral values."""


@dataclass(frozen=True)
class Standards:
    """Optics and camera with which the standards of a calibration were recorded and analysed."""

    optics: Optics
    covariance: OpticsCovariance | None
    height_nm: float
    camera: StandardsCamera

    def to_toml(self) -> str:
        """Write the end of the section ``[calibration]``, with its tables."""
        lines = [f"height_nm = {toml_value(self.height_nm)}"]
        for name, table in self.to_dict().items():
            if isinstance(table, dict) and table:
                lines += ["", f"[calibration.{name}]"]
                lines += [f"{key} = {toml_value(value)}" for key, value in table.items()]
        return "\n".join([*lines, ""])

    def to_dict(self) -> dict[str, Any]:
        """Give the entries of ``calibration.json``."""
        return {
            "optics": self.optics.model_dump(exclude={*_OF_A_MOVIE}, exclude_none=True),
            "covariance": None if self.covariance is None else self.covariance.model_dump(),
            "height_nm": self.height_nm,
            "camera": self.camera.model_dump(exclude_none=True),
        }


def standards_of(config: Config) -> Standards:
    """Give the record of standards that were analysed with a configuration."""
    camera = config.camera
    gain, offset = camera.gain_e_per_adu, camera.offset_adu
    return Standards(
        optics=config.optics.model_copy(update=_OF_A_MOVIE),
        covariance=None if (errors := config.optics.covariance) is None else errors.at_rest,
        height_nm=config.particle.nominal_height_nm,
        camera=StandardsCamera(
            pixel_size_nm=camera.pixel_size_nm,
            samples_per_pixel=camera.samples_per_pixel,
            fill_factor=camera.fill_factor,
            gain_e_per_adu=gain if isinstance(gain, float) else None,
            offset_adu=offset if isinstance(offset, float) else None,
        ),
    )


def with_standards(config: Config) -> Config:
    """Assume that a gradient without stored optics was measured with the configured optics."""
    line = config.calibration
    if line is None or line.optics is not None:
        return config
    found = standards_of(config)
    update = {
        "optics": found.optics,
        "covariance": found.covariance,
        "height_nm": found.height_nm,
        "optics_assumed": True,
    }
    return config.changed(calibration=update)


def as_given(config: Config) -> Config:
    """Undo `with_standards` if the optics are still those configured."""
    line = config.calibration
    if line is None or not line.optics_assumed or standards_of(config).optics != line.optics:
        return config
    update = dict.fromkeys(("optics", "covariance", "height_nm"), None) | {"optics_assumed": False}
    return config.changed(calibration=update)


def contrast_over(config: Config, standards: Standards) -> tuple[float, str]:
    """Give the contrast per mass over that of standards, and why it cannot be converted."""
    config = config.changed(calibration=None)
    reach_nm = PEAK_SEARCH_RADIUS * config.optics.wavelength_nm / config.optics.na
    rises = (
        forward_model(config, reach_nm).peak_contrast(config.particle.nominal_height_nm, 1e-3) > 0
    )
    line = Calibration(
        gradient_per_kda=1e-5 if rises else -1e-5,
        optics=standards.optics,
        height_nm=standards.height_nm,
    )
    scale = forward_model(config.model_copy(update={"calibration": line}), reach_nm).scale
    return scale.carried, scale.refusal


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


def weighed(
    table: pd.DataFrame, line: Calibration, source: object
) -> tuple[pd.DataFrame, float | None]:
    """Give the events of a table the masses of a line, and how many times its own they are.

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
    return made, None if abs(times - 1) < _SAME else times


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
