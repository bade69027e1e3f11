"""Parameters of a particle, and the registry of the columns of ``fits.csv`` and ``tracks.csv``.

A column is named once, in `EVENTS` or `TRACKS`, in the order of the files.  From there it has its
type in tables, its place in the schema, its line in the manual and its heading in the report.

Rows of the tables: how they are made, judged and counted.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import pandas as pd
from scipy.special import bdtrc

from iscat_analysis.config import MODES, PARAMETERS
from iscat_analysis.records.steps import NO_EVENT, SEVERITY, BoolArray, Status, TrackStatus
from iscat_analysis.units import count, sphere_diameter_nm

FREE_PARAMETERS: Mapping[str, tuple[str, ...]] = {name: kind.free for name, kind in MODES.items()}
"""What each mode fits."""


def free_parameters(mode: str, fits: pd.DataFrame) -> tuple[str, ...]:
    """Give the fitted parameters: mode ``track`` fits the height only if ``track.free`` says so."""
    names = FREE_PARAMETERS[mode]
    fitted = tuple(name for name in names if fits[f"sigma_{name}"].notna().any())
    return fitted if MODES[mode].follows_tracks and fitted else names


_Words = Literal["status", "text", "end"]
_Numbers = Literal["count", "natural", "number", "positive", "not_negative", "share", "span"]


@dataclass(frozen=True)
class Column:
    """One column: its values, what they mean, and whether every table has it.

    The unit replaces ``{}`` in `meaning`.  A column without a heading is not in the table of the
    report.
    """

    name: str
    values: _Numbers | _Words
    meaning: str
    heading: str = ""
    unit: str = ""
    optional: bool = False

    @property
    def description(self) -> str:
        """What the column holds, with its unit."""
        return self.meaning.format(self.unit)

    @property
    def dtype(self) -> str:
        """Type in a table."""
        whole = self.values in ("count", "natural", "span")
        return "int64" if whole else "object" if self.is_text else "float64"

    @property
    def is_text(self) -> bool:
        """Whether it holds words."""
        return self.values in get_args(_Words)


def _of_each_parameter(prefix: str, meaning: str, heading: str) -> tuple[Column, ...]:
    """Make a column for each parameter of a particle."""
    return tuple(
        Column(
            f"{prefix}_{name}",
            "number" if prefix in ("systematic", "repeat") else "positive",
            meaning,
            heading,
            "kDa" if name == "mass_kda" else "nm",
        )
        for name in PARAMETERS
    )


DIPOLE, NO_MODEL = "dipole", "none"
"""Values of the column ``model`` beside the spheres of ``fit.spheres``."""

_PIXEL = ", 0-based; an integer is a pixel's centre [px]"

EVENTS: tuple[Column, ...] = (
    Column("event", "count", "Number of the event"),
    Column("frame", "count", "First frame of the new state, or the fitted frame"),
    Column("n_before", "count", "Frames summed before"),
    Column("n_after", "count", "Frames summed after"),
    Column("x_px", "number", f"Column in the full frame{_PIXEL}", "x [px]"),
    Column("y_px", "number", f"Row in the full frame, downwards{_PIXEL}", "y [px]"),
    Column("x_nm", "number", "x_px times the pixel size [nm]"),
    Column("y_nm", "number", "y_px times the pixel size [nm]"),
    Column("z_nm", "number", "Height above the coverslip [nm]", "z", "nm"),
    Column(
        "mass_kda", "number",
        "Mass [kDa]; negative for a particle that leaves; on the absolute scale of the model, "
        "which is not a mass, unless mass_scale is calibration",
        "mass", "kDa",
    ),
    Column(
        "contrast", "number", "Signed peak contrast of the fitted model; null in dark field",
        "contrast [10⁻³]",
    ),
    *_of_each_parameter(
        "sigma",
        "Standard deviation from the observed information [{}]; null where it is not free", "σ",
    ),
    *_of_each_parameter(
        "crb",
        "Joint Cramér–Rao bound at the estimate, for the same frames and noise [{}]; null where "
        "the parameter is not free", "CRB",
    ),
    *_of_each_parameter(
        "qcrb", "Quantum Cramér–Rao bound for the collected photons [{}]", "QCRB"
    ),
    Column("n_scattered", "number", "Scattered photons collected in the frames after"),
    Column("snr", "number", "Matched-filter signal over its noise", "SNR"),
    Column("chi2_reduced", "number", "Reduced χ² of the fitted pixels", "χ²"),
    Column("p_value", "share", "Probability of a worse fit if the model holds", "p"),
    Column("status", "status", "The verdict: the worst of the flags"),
    Column("flags", "text", "All flags, worst first, joined by semicolons"),
)  # fmt: skip
"""The columns of ``fits.csv``, in order; those that follow below are in some files."""

EVENT_COLUMNS = tuple(column.name for column in EVENTS)
"""Names of the columns that every ``fits.csv`` has, in order."""

EVENTS += tuple(replace(column, optional=True) for column in (
    *_of_each_parameter(
        "systematic",
        "Error common to the movie, from calibrations of optics and mass; not part of σ [{}]",
        "systematic",
    ),
    Column(
        "systematic_contrast", "number",
        "Error of the contrast that is common to the movie; if there is no mass calibration",
    ),
    Column(
        "frame_ci95", "span",
        "Half-width of the 95 % interval of frame [frames]; landing movies only",
    ),
    Column("track", "count", "Number of the track that the row belongs to"),
    Column(
        "tick", "count",
        "Intervals of the camera from the movie's first frame to frame; where the file's times "
        "show that frames are missing",
    ),
    *_of_each_parameter(
        "repeat",
        "Standard error from eight disjoint parts of the event's own frames, known to 19 %; in "
        "mode track, from the empty places of its frame [{}]",
        "repeats",
    ),
    Column(
        "model", "text",
        "What describes the image, in mode mass: dipole, a sphere of fit.spheres, or none",
    ),
    Column(
        "diameter_nm", "positive",
        "Diameter of the sphere; in mode size mass_kda is from it, in mode mass it is that of "
        "model, which stands on the coverslip [nm]", "diameter", "nm",
    ),
    Column(
        "sigma_diameter_nm", "positive", "Its standard deviation, as that of the mass [nm]", "σ",
    ),
    Column("crb_diameter_nm", "positive", "Its joint Cramér–Rao bound [nm]", "CRB"),
    Column("qcrb_diameter_nm", "positive", "Its quantum Cramér–Rao bound [nm]", "QCRB"),
    Column(
        "refractive_index", "positive",
        "Refractive index of the sphere, where it is fitted: model is sphere, or fit.index; empty "
        "if the picture does not tell it",
    ),
    Column("sigma_refractive_index", "positive", "Its standard deviation"),
    Column(
        "systematic_diameter_nm", "not_negative",
        "Its error common to the movie, from inputs that were assumed [nm]", "systematic", "nm",
    ),
    Column(
        "other_diameter_nm", "positive",
        "Diameter of the next likely maximum of the likelihood, where there is another [nm]",
    ),
    Column("other_odds", "share", "Likelihood of that diameter over that of diameter_nm"),
    Column(
        "diameter_probability", "share",
        "Posterior probability of diameter_nm among all diameters that were found, all in "
        "fit.diameter_range_nm being as likely before",
    ),
    Column(
        "pair_mass_kda", "number",
        "Mass of the particle if it is two equal halves; with fit.pairs [kDa]", "pair", "kDa",
    ),
    Column(
        "sigma_pair_mass_kda", "positive",
        "Its standard deviation, which is its Cramér–Rao bound [kDa]", "σ",
    ),
    Column("separation_nm", "not_negative", "Distance of the halves [nm]", "separation", "nm"),
    Column(
        "sigma_separation_nm", "positive",
        "Its standard deviation, which is its Cramér–Rao bound [nm]", "σ",
    ),
    Column("angle_deg", "number", "Direction of the halves, from x towards y, 0 to 180 [°]"),
    Column(
        "sigma_angle_deg", "positive",
        "Its standard deviation, which is its Cramér–Rao bound [°]",
    ),
    Column("p_point", "share", "Probability that a point gains as much by a second half"),
    Column("pair_chi2_reduced", "number", "Reduced χ² with two halves"),
    Column("pair_p_value", "share", "Probability of a worse fit if it is two halves"),
))  # fmt: skip

FRAME_COLUMN = "frame_ci95"
"""Column of ``fits.csv`` after `EVENT_COLUMNS`, of landing movies: half-width of the 95 % interval
of ``frame`` [frames]."""

REPEAT_COLUMNS = tuple(f"repeat_{name}" for name in PARAMETERS)
"""Columns of ``fits.csv``: standard errors of an event from disjoint parts of its own frames; of a
single frame, from the empty places of that frame."""

TRACKS: tuple[Column, ...] = (
    Column("track", "count", "Number of the track, as in fits.csv"),
    Column("first_frame", "count", "First frame with the particle"),
    Column("last_frame", "count", "Last frame with it"),
    Column("n_frames", "natural", "Frames in which it was fitted", "frames"),
    Column(
        "mass_kda", "number",
        "Mass common to its frames that are ok [kDa]; on the absolute scale of the model, which "
        "is not a mass, unless mass_scale is calibration", "mass [kDa]",
    ),
    Column("sigma_mass_kda", "positive", "Its standard error [kDa]", "σ [kDa]"),
    Column("crb_mass_kda", "positive", "Its Cramér–Rao bound [kDa]", "CRB [kDa]"),
    Column(
        "d_um2_s", "not_negative",
        "Diffusion coefficient along x and y of highest likelihood, with the error of each frame "
        "and its motion blur [µm²/s]; null without a frame rate or with fewer positions than "
        "track.min_frames", "D [µm²/s]",
    ),
    Column("sigma_d_um2_s", "positive", "Its standard error, from the curvature [µm²/s]",
           "σ [µm²/s]"),
    Column("crb_d_um2_s", "positive", "Its Cramér–Rao bound [µm²/s]", "CRB [µm²/s]"),
    Column(
        "diameter_nm", "positive",
        "Hydrodynamic diameter [nm]; with track.free = \"joint\", if D is above zero within its "
        "error and the sphere fits between the centre of the particle and the coverslip",
        "diameter [nm]",
    ),
    Column("sigma_diameter_nm", "positive", "Its standard error [nm]", "σ [nm]"),
    Column(
        "refractive_index", "positive",
        "Refractive index of a sphere of that diameter that scatters like mass_kda of [particle]; "
        "with particle.model = \"mie\" or \"shell\", of a homogeneous sphere, from images and "
        "diffusion together; null for a material that absorbs", "index",
    ),
    Column(
        "confinement_nm", "positive",
        "Standard deviation of the position in a harmonic well [nm]; if p_confinement is at most "
        "0.005", "well [nm]",
    ),
    Column("status", "status", "The worst flag"),
    Column("flags", "text",
           "All flags, worst first, joined by semicolons; crosses is never a status"),
    Column("d_low_um2_s", "not_negative",
           "Lower end of the 95 % interval of D [µm²/s]; 0: no lower limit"),
    Column("d_high_um2_s", "positive", "Upper end [µm²/s]"),
    Column(
        "d_disagreement", "number",
        "Covariance-based estimate of D minus this one, in standard errors; far from 0 if the "
        "errors of positions or the exposure are wrong, or the motion is not free",
    ),
    Column("p_confinement", "share",
           "Probability that a free track looks as confined; first 300 positions", "p, confined"),
    Column("exponent", "number",
           "Exponent of time in the mean-squared displacement; 1 if free", "exponent"),
    Column("sigma_exponent", "positive", "Its standard error"),
    Column("p_anomalous", "share",
           "Probability that a free track has an exponent as far from 1", "p, anomalous"),
    Column("p_steady", "share",
           "Probability that parts of a track with one D differ as much", "p, one D"),
    Column("sigma_refractive_index", "not_negative", "Standard error of the refractive index",
           "σ of index"),
    Column("contrast", "number",
           "Signed peak contrast of a particle of mass_kda; null in dark field"),
    Column("mass_scatter", "not_negative", "Scatter of the frames' masses over their σ",
           "scatter / σ"),
    Column("p_mass", "share", "Probability of at least that scatter with one mass"),
    Column("n_mass_frames", "count", "Frames that are ok, whose masses were combined"),
    Column("n_d_frames", "count", "Frames whose positions were used for D; 0 if they are too few"),
    Column("x_nm", "number", "Mean position along x [nm]", "x [nm]"),
    Column("y_nm", "number", "Mean position along y [nm]", "y [nm]"),
    Column("z_nm", "number", "Mean height [nm]", "z [nm]"),
    Column("nearest_nm", "positive", "Smallest distance to another track in the same frame [nm]"),
    Column("begins", "end",
           "movie: in the first frame; border: within a step of the field's border; inside: "
           "elsewhere"),
    Column("ends", "end", "The same for the last frame"),
)  # fmt: skip
"""The columns of ``tracks.csv``, in order; those that follow below are in some files."""

TRACK_COLUMNS = tuple(column.name for column in TRACKS)
"""Names of the columns that every ``tracks.csv`` has, in order."""

TRACKS += tuple(replace(column, optional=True) for column in (
    Column("systematic_mass_kda", "number", "Error common to the movie, from calibrations [kDa]",
           "systematic [kDa]"),
    Column(
        "optical_diameter_nm", "positive",
        "Diameter of the sphere that the images of all frames show; of spheres, which have "
        "mass_kda from it [nm]", "optical diameter [nm]",
    ),
    Column("sigma_optical_diameter_nm", "positive", "Its standard error [nm]", "σ [nm]"),
    Column("crb_optical_diameter_nm", "positive", "Its Cramér–Rao bound [nm]", "CRB [nm]"),
    Column(
        "optical_probability", "share",
        "Posterior probability of that diameter among all that the images allow",
    ),
    Column(
        "log_odds_particle", "number",
        "Logarithm of the posterior odds, from images and diffusion, that the track is of "
        "[particle] with any diameter, against a homogeneous sphere of any diameter and any index "
        "up to 1.8", "ln odds",
    ),
))  # fmt: skip


MODEL_SCALE = "absolute model"
"""Scale of masses that neither standards nor a material give, in ``summary.json``."""

BUDGET_COLUMNS = ("name", "kind", "common", "sigma_mass_kda", "sigma_rel", "dof", "remedy")
"""Columns of the error budget of a mass."""


def track_numbers(fits: pd.DataFrame) -> pd.Series[int]:
    """Give the track of every row."""
    return fits["track"] if "track" in fits else fits["event"]


POOR_P = 0.01
"""A p-value that one good fit in 100 has."""


def make_rows(
    lines: pd.DataFrame | Mapping[str, Any] | Iterable[Mapping[str, Any]],
    columns: Mapping[str, Any] = MappingProxyType({}),
) -> pd.DataFrame:
    """Make a table of rows, with the order and the types of the registry of columns.

    Values that a row lacks stay empty, whole numbers included.  The table has an optional column if
    a row has it, and the number of the event once it is given.  `columns` are added to the rows.
    """
    whole = isinstance(lines, (pd.DataFrame, Mapping))
    table = pd.DataFrame(lines if whole else list(lines)).reset_index(drop=True)
    table = table.assign(**dict(columns))
    unknown = set(table) - {column.name for column in EVENTS}
    if unknown:
        raise ValueError(f"no column of fits.csv: {', '.join(sorted(unknown))}; see `EVENTS`")
    kept = [
        column
        for column in EVENTS
        if column.name in table or not (column.optional or column.name == "event")
    ]
    types = {column.name: column.dtype for column in kept}
    table = table.reindex(columns=list(types))
    empty = table.columns[table.isna().any()]
    return table.astype(types | {name: "Int64" for name in empty if types[name] == "int64"})


def with_diameters(table: pd.DataFrame, density_kg_m3: float) -> pd.DataFrame:
    """Add the diameters of spheres, and their errors and bounds, to rows with their masses."""
    mass = table["mass_kda"].to_numpy(dtype=float)
    diameter = sphere_diameter_nm(1.0, density_kg_m3) * np.cbrt(np.abs(mass))
    slope = diameter / (3 * np.abs(mass))
    columns = {"diameter_nm": diameter} | {
        f"{kind}_diameter_nm": slope * table[f"{kind}_mass_kda"]
        for kind in ("sigma", "crb", "qcrb", "systematic")
        if f"{kind}_mass_kda" in table
    }
    return make_rows(table, columns)


def is_event(table: pd.DataFrame) -> BoolArray:
    """Tell which rows are events, and so are counted: not the side lobes of others, nor noise.

    Shapes: result (rows,).
    """
    return np.asarray(~table["status"].isin([*map(str, NO_EVENT)]), dtype=bool)


def counted(table: pd.DataFrame) -> pd.DataFrame:
    """Leave out rows that are no events."""
    return table[is_event(table)]


class Tally(NamedTuple):
    """Numbers of events, or tracks, by status, the commonest first, and of rows that are none."""

    number: int
    status: dict[str, int]
    left_out: dict[str, int]

    @property
    def ok(self) -> int:
        """How many are ok."""
        return self.status.get(Status.OK.value, 0)

    @property
    def flagged(self) -> int:
        """How many are not."""
        return self.number - self.ok

    def text(self, noun: str = "event") -> str:
        """Say all of it."""
        by_status = ", ".join(f"{n} {status}" for status, n in self.status.items())
        text = count(self.number, noun) + (f": {by_status}" if by_status else "")
        if self.left_out:
            rows = ", ".join(f"{n} {status}" for status, n in self.left_out.items())
            text += f"; further rows, which are no {noun}s: {rows}"
        return text


def tally(table: pd.DataFrame) -> Tally:
    """Count the events, or tracks, of a table: every total comes from here."""
    events = is_event(table)
    status = table["status"].astype(str)
    by_status, left_out = (
        {str(name): int(n) for name, n in status[part].value_counts().items()}
        for part in (events, ~events)
    )
    return Tally(int(events.sum()), by_status, left_out)


def is_rejected(table: pd.DataFrame) -> bool:
    """Tell whether more fits are poor than a right model of the image leaves to chance.

    Notes
    -----
    What disturbs a particle that moves, as one outside of the field does, disturbs it in many
    frames, and says nothing of the microscope.  An error of the microscope is in every track: of
    tracks those with the smallest shares of poor fits, which have half of all fits, are judged.
    """
    table = counted(table)
    table = table[np.isfinite(table["p_value"].to_numpy(float))]
    poor = table["p_value"] < POOR_P
    fits, misses = len(table), int(poor.sum())
    if "track" in table:
        tracks = poor.groupby(table["track"], dropna=False).agg(["size", "sum", "mean"])
        tracks = tracks.sort_values("mean")
        before = tracks["size"].cumsum() - tracks["size"]
        fits, misses = (int(n) for n in tracks.loc[before < fits / 2, ["size", "sum"]].sum())
    # The chance that so many fits are poor, below which the model is rejected
    return bool(fits) and float(bdtrc(misses - 1, fits, POOR_P)) <= 1e-4


def species_rows(table: pd.DataFrame) -> tuple[pd.DataFrame, tuple[str, ...]]:
    """Select the rows that species are found among, and say so where they are not the ok ones.

    Where the model is rejected a poor fit is no other kind of row: the bright particles are poor,
    all the same.
    """
    judged = {Status.OK.value}
    if "p_value" in table and is_rejected(table):
        judged.add(Status.POOR_FIT.value)
    used = table[table["status"].isin(judged)]
    if (used["status"] == Status.OK.value).all():
        return used, ()
    return used, ("poor fits are counted too, because the model is rejected",)


def has_only(table: pd.DataFrame, known: frozenset[str]) -> BoolArray:
    """Tell which rows have no status and no flag but these.

    Shapes: result (rows,).
    """
    marks = zip(table["status"], table["flags"].fillna(""), strict=True)
    return np.array(
        [{status, *str(flags).split(";")} - {""} <= known for status, flags in marks], dtype=bool
    )


def has_flag(table: pd.DataFrame, flag: Status | TrackStatus) -> BoolArray:
    """Tell which rows have a flag, whatever others they have.

    Shapes: result (rows,).
    """
    return np.array([flag.value in str(one).split(";") for one in table["flags"]], dtype=bool)


def flagged(
    table: pd.DataFrame, flag: Status | TrackStatus, which: BoolArray | None = None
) -> pd.DataFrame:
    """Add a flag to rows of events or tracks, to all or to some; the status is the worst one.

    Shapes: `which` (rows,).
    """
    order = [*map(str, SEVERITY if isinstance(flag, Status) else TrackStatus)]
    chosen = np.ones(len(table), dtype=bool) if which is None else which
    statuses, flags = table["status"].astype(object), table["flags"].astype(object)
    for row in np.flatnonzero(chosen).tolist():
        known = {str(flag), *filter(None, str(flags.iat[row] or "").split(";"))}
        found = sorted(known, key=lambda name: order.index(name) if name in order else len(order))
        statuses.iat[row], flags.iat[row] = found[0], ";".join(found)
    return table.assign(status=statuses, flags=flags)
