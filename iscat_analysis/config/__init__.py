"""The configuration: its keys, how files are read, and how single keys are changed.

`instrument`, `analysis` and `synthetic` have the sections and their keys, `values` the allowed
values, and `schema` the whole configuration; `named` has set-ups from publications.  Only
`configure` makes a `Config`: files, mappings, keyword arguments and ``--set`` all go through it, so
that the same keys give the same configuration and a later value always replaces an earlier one.
`files` reads and writes TOML, and `renamed` accepts old names for one release.
"""

from __future__ import annotations

from iscat_analysis.config.analysis import (
    BackgroundConfig,
    Compute,
    Detection,
    Fit,
    PosteriorConfig,
    TrackConfig,
)
from iscat_analysis.config.covariance import ABERRATIONS, MEASURABLE, OpticsCovariance
from iscat_analysis.config.field import FIELD_TERMS, JUMPS, MOVES, MOVING, field_keys
from iscat_analysis.config.files import (
    OpticsFile,
    config_to_toml,
    read_optics_file,
    toml_value,
    with_absolute_paths,
)
from iscat_analysis.config.instrument import (
    ASSUMED,
    AUTO,
    LARGEST_SD_NM,
    CameraConfig,
    Optics,
    Particle,
)
from iscat_analysis.config.kinds import (
    METHODS,
    MODES,
    PARAMETERS,
    SCHEMES,
    MethodKind,
    ModeKind,
    SchemeKind,
    Way,
)
from iscat_analysis.config.named import Instrument, Instruments, instruments
from iscat_analysis.config.overrides import configure, load_config, parse_config
from iscat_analysis.config.scale import Calibration, StandardsCamera, Uncertainty
from iscat_analysis.config.schema import Config, refuse_rod, refuse_sphere
from iscat_analysis.config.synthetic import (
    SIMULATED,
    BoundsConfig,
    SimulatedEvent,
    SimulatedMover,
    Simulation,
)
from iscat_analysis.config.values import (
    ALL,
    PIXEL_NM,
    Method,
    Mode,
    Scheme,
    Section,
    SphereKind,
    plausible_pixel,
)

__all__ = [
    "ABERRATIONS",
    "ALL",
    "ASSUMED",
    "AUTO",
    "FIELD_TERMS",
    "JUMPS",
    "LARGEST_SD_NM",
    "MEASURABLE",
    "METHODS",
    "MODES",
    "MOVES",
    "MOVING",
    "PARAMETERS",
    "PIXEL_NM",
    "SCHEMES",
    "SIMULATED",
    "BackgroundConfig",
    "BoundsConfig",
    "Calibration",
    "CameraConfig",
    "Compute",
    "Config",
    "Detection",
    "Fit",
    "Instrument",
    "Instruments",
    "Method",
    "MethodKind",
    "Mode",
    "ModeKind",
    "Optics",
    "OpticsCovariance",
    "OpticsFile",
    "Particle",
    "PosteriorConfig",
    "Scheme",
    "SchemeKind",
    "Section",
    "SimulatedEvent",
    "SimulatedMover",
    "Simulation",
    "SphereKind",
    "StandardsCamera",
    "TrackConfig",
    "Uncertainty",
    "Way",
    "config_to_toml",
    "configure",
    "field_keys",
    "instruments",
    "load_config",
    "parse_config",
    "plausible_pixel",
    "read_optics_file",
    "refuse_rod",
    "refuse_sphere",
    "toml_value",
    "with_absolute_paths",
]
