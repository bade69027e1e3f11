"""The configuration: its keys, how files are read, and how single keys are changed.

`instrument`, `analysis` and `synthetic` have the sections and their keys, `values` the allowed
values, `kinds` what schemes, modes and methods mean, and `schema` the whole configuration; `named`
has set-ups from publications.  Only `configure` in `files` makes a `Config`: files, mappings,
keyword arguments and ``--set`` all go through it, so that the same keys give the same configuration
and a later value always replaces an earlier one.
"""

from __future__ import annotations

from iscat_analysis.config.analysis import (
    BackgroundConfig,
    Calibration,
    Detection,
    Fit,
    StandardsCamera,
    Uncertainty,
)
from iscat_analysis.config.files import (
    Source,
    config_to_toml,
    configure,
    known_keys,
    load_config,
    parse_config,
    read_optics_file,
    read_toml,
    toml_value,
    with_absolute_paths,
)
from iscat_analysis.config.instrument import (
    ABERRATIONS,
    ASSUMED,
    AUTO,
    FIELD_TERMS,
    JUMPS,
    LARGEST_SD_NM,
    MEASURABLE,
    MOVES,
    MOVING,
    CameraConfig,
    Optics,
    OpticsCovariance,
    Particle,
    field_keys,
)
from iscat_analysis.config.kinds import MODES, PARAMETERS, SCHEMES, ModeKind, SchemeKind, Way
from iscat_analysis.config.named import Instrument, instruments
from iscat_analysis.config.schema import INVISIBLE, Config, refuse_rod, refuse_sphere
from iscat_analysis.config.synthetic import SIMULATED, SimulatedMover
from iscat_analysis.config.values import (
    ALL,
    LARGEST_NM,
    WAVELENGTH_NM,
    Mode,
    Section,
    SphereKind,
    plausible_pixel,
)
