"""Tables of a batch, made from the results of its movies.

Quality of each movie of a batch: numbers, and warnings in words.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from iscat_analysis.config import Config, configure, load_config
from iscat_analysis.day.calibrate import Day
from iscat_analysis.day.jobs import Outcome
from iscat_analysis.day.table import Movie
from iscat_analysis.records import FloatArray, Status
from iscat_analysis.report.answer import answer_in
from iscat_analysis.schemas.answers import DayMovie, DaySpecies
from iscat_analysis.species.describe import poisson_interval
from iscat_analysis.species.maximum import TWO_SIDED_95
from iscat_analysis.units import count

LABELS = ("movie", "sample", "condition", "concentration_nm", "replicate", "role")
"""What tells a movie in every table."""

MOVIE_COLUMNS = tuple(dict.fromkeys((*LABELS, "path", *DayMovie.model_fields)))
"""Columns of ``movies.csv``, before those of the table that have no meaning here."""

SPECIES_COLUMNS = tuple(DaySpecies.model_fields)
"""Columns of ``species.csv``; `kind` is the same for species of several movies with one mass.  A
`share` is of the particles that came, as `fraction` is, but without outliers: one event far below
the detection limit stands for any number of particles, and would take the others' fractions."""

_MASSES = ("mass_kda", "status", "p_value")


@dataclass(frozen=True, eq=False)
class Found:
    """Results of one movie."""

    movie: Movie
    outcome: Outcome
    folder: Path
    summary: Mapping[str, Any] = field(default_factory=dict)
    masses_kda: FloatArray = field(default_factory=lambda: np.empty(0))
    p_values: FloatArray = field(default_factory=lambda: np.empty(0))
    config: Config = field(default_factory=configure)

    @property
    def labels(self) -> dict[str, Any]:
        """The columns `LABELS`."""
        row = {name: getattr(self.movie.row, name) for name in LABELS[1:]}
        return {"movie": self.movie.name, **row}

    @property
    def distribution(self) -> Mapping[str, Any]:
        """What the summary says of species; empty where there are none."""
        return self.summary.get("distribution") or {}

    @property
    def background(self) -> Mapping[str, Any]:
        """What the summary says of light and drift."""
        return self.summary.get("landing") or self.summary.get("background") or {}

    @property
    def frames_searched(self) -> float:
        """Frames in which a landing is found; NaN where particles do not land."""
        landing = self.summary.get("landing", {})
        if not landing.get("boundaries_searched"):
            return math.nan
        return float(landing["boundaries_searched"] * landing["stride_frames"])

    @property
    def seconds(self) -> float:
        """The same as a time [s]; NaN where the frame rate is not known."""
        return self.frames_searched / (self.config.camera.frame_rate_hz or math.nan)

    @property
    def field_um2(self) -> float:
        """Area of the frame [µm²]; NaN where it is not known."""
        shape = (self.outcome.record or {}).get("shape")
        pixel = self.config.camera.pixel_size_nm
        return float(shape[1] * shape[2] * (pixel / 1e3) ** 2) if shape and pixel else math.nan

    @property
    def noise(self) -> tuple[float | None, int | None]:
        """Noise over that of photoelectrons at the length of a movie's windows, and that length."""
        noise = self.background
        frames, values = noise.get("noise_frames"), noise.get("noise_variance_over_shot")
        known = [(n, v) for n, v in zip(frames or (), values or (), strict=True) if v is not None]
        window = noise.get("window_frames", math.inf)
        fitting = [(n, v) for n, v in known if n <= window] or known[:1]
        return (float(fitting[-1][1]), int(fitting[-1][0])) if fitting else (None, None)


def read_movie(movie: Movie, outcome: Outcome, folder: Path) -> Found:
    """Read what the tables and figures need of a result."""
    if outcome.state != "done" or movie.row.role == "flat":
        return Found(movie, outcome, folder)
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    events = pd.read_parquet(folder / "fits.parquet", columns=list(_MASSES))
    kept = events[events["status"].isin([Status.OK, Status.POOR_FIT])]
    if (folder / "tracks.parquet").is_file():
        good = pd.read_parquet(folder / "tracks.parquet", columns=["mass_kda"])
    else:
        good = events[events["status"] == Status.OK]
    good = good if summary["mode"] != "localize" else good[:0]
    masses, p_values = good["mass_kda"].dropna(), kept["p_value"].dropna()
    config = load_config(folder / "config.toml")
    return Found(
        movie, outcome, folder, summary, masses.to_numpy(float), p_values.to_numpy(float), config
    )


def species_table(found: Sequence[Found]) -> pd.DataFrame:
    """Put the species of all movies into one table."""
    rows = []
    for each in found:
        known = [s for s in each.distribution.get("species", ()) if not s.get("background")]
        for species, share in zip(known, shares_of(known), strict=True):
            values = {key: species.get(key) for key in SPECIES_COLUMNS if key in species}
            seen = poisson_rate(species["landing"], each.seconds)
            rate, low, high = (value / (species["efficiency"] or math.nan) for value in seen)
            rates = {"rate_per_s": rate, "rate_low": low, "rate_high": high}
            rows.append({**each.labels, **values, **share, **rates})
    table = pd.DataFrame(rows, columns=[name for name in SPECIES_COLUMNS if name != "kind"])
    text = ("movie", "sample", "condition", "replicate", "role")
    numbers = {n: float for n in table if n not in (*text, "outlier")}
    return table.astype({**numbers, "outlier": bool})


def shares_of(species: Sequence[Mapping[str, Any]]) -> list[dict[str, float]]:
    """Give the share of each species among those that are no outliers, with its 95 % interval.

    The errors are those of the counts, as the bootstrap has them, on the scale of log odds.
    """
    real = [s for s in species if not s["outlier"] and s["count_corrected"] is not None]
    came = {id(s): float(s["count_corrected"]) for s in real}
    relative = {
        id(s): ((s["count_high"] or math.nan) - (s["count_low"] or 0.0))
        / (2 * TWO_SIDED_95 * s["count"])
        for s in real
    }
    total, shares = sum(came.values()), []
    for each in species:
        a = came.get(id(each), math.nan)
        b = total - a
        if not (a > 0 and b > 1e-12 * total):
            shares.append({"share": a / total if a > 0 else math.nan})
            continue
        others = sum((came[k] * relative[k]) ** 2 for k in came if k != id(each))
        error = TWO_SIDED_95 * math.hypot(relative[id(each)], math.sqrt(others) / b)
        odds = math.log(a / b)
        low, high = (1 / (1 + math.exp(-odds - sign * error)) for sign in (-1, 1))
        shares.append({"share": a / total, "share_low": low, "share_high": high})
    return shares


def movie_table(day: Day, found: Sequence[Found], out: Path) -> pd.DataFrame:
    """Make the table of movies."""
    rows = []
    for each in found:
        row = {
            **each.labels,
            "path": each.movie.row.given,
            "state": each.outcome.state,
            "why": each.outcome.why,
            **_numbers(each, day, out),
        }
        rows.append({**row, **{k: v for k, v in each.movie.row.further.items() if k not in row}})
    further = [key for each in day.plan.table.rows for key in each.further]
    names = [*MOVIE_COLUMNS, *(n for n in dict.fromkeys(further) if n not in MOVIE_COLUMNS)]
    table = pd.DataFrame(rows, columns=names)
    for name in names[len(MOVIE_COLUMNS) :]:
        table[name] = _typed(table[name])
    return table


def _numbers(each: Found, day: Day, out: Path) -> dict[str, Any]:
    """Read numbers from the summary of a result."""
    if not each.summary:
        return {"cautions": ""}
    summary, landing = each.summary, each.summary.get("landing", {})
    counted = [s for s in each.distribution.get("species", ()) if not s["outlier"]]
    main = max(counted, key=lambda s: s["count"], default=None)
    rate, low, high = poisson_rate(landing.get("landings"), each.seconds)
    noise, frames = each.noise
    return {
        "report": (each.folder / "report.html").relative_to(out).as_posix(),
        "events": summary["events"],
        "ok": summary["status"].get("ok", 0),
        "landings": landing.get("landings"),
        "leavings": landing.get("leavings"),
        "species": len(counted) if each.distribution else None,
        "main_mass_kda": main["mass_kda"] if main else None,
        "answer": answer_in(each.folder),
        "rate_per_s": rate,
        "rate_low": low,
        "rate_high": high,
        "rate_per_um2_s": rate / each.field_um2,
        "frames_searched": each.frames_searched,
        "seconds_searched": each.seconds,
        "field_um2": each.field_um2,
        "frames": (each.outcome.record or {}).get("shape", [None])[0],
        "noise_over_shot": noise,
        "noise_frames": frames,
        "remarks": len(summary["warnings"]),
        "sha256": summary["input"]["sha256"],
        **_quality(each, day),
    }


def poisson_rate(count: float | None, seconds: float) -> tuple[float, float, float]:
    """Give a rate with its 95 % Poisson interval (Garwood, Biometrika 28, 437, 1936)."""
    if count is None or not (math.isfinite(count) and math.isfinite(seconds)):
        return math.nan, math.nan, math.nan
    low, high = poisson_interval(count)
    return count / seconds, float(low) / seconds, float(high) / seconds


def _typed(column: pd.Series[Any]) -> pd.Series[Any]:
    """Turn a column of text into numbers where all of it is."""
    try:
        return pd.to_numeric(column.replace("", None))
    except (TypeError, ValueError):
        return column.map(lambda v: "" if v is None or v != v else str(v))


def write_events(found: Sequence[Found], further: pd.DataFrame, path: Path) -> None:
    """Write the events of all movies into one file, one movie at a time, with the same columns."""
    fits = {k: each.folder / "fits.parquet" for k, each in enumerate(found) if each.summary}
    schemas = [pq.read_schema(file) for file in fits.values()]
    of_fits = {name for schema in schemas for name in schema.names}
    text = dict.fromkeys(set(LABELS) - {"concentration_nm"}, str)
    labels = pd.DataFrame([each.labels for each in found]).astype(text)
    labels = labels.join(further[[name for name in further if name not in of_fits]])
    rows = pa.Table.from_pandas(labels, preserve_index=False).replace_schema_metadata()
    schema = pa.unify_schemas(
        [rows.schema, *(each.remove_metadata() for each in schemas)], promote_options="permissive"
    )
    with pq.ParquetWriter(str(path), schema, compression="zstd") as writer:
        for k, file in fits.items():
            events = pq.read_table(file).replace_schema_metadata()
            joined = rows.take([k] * len(events))
            for name in events.column_names:
                joined = joined.append_column(events.schema.field(name), events[name])
            parts = [schema.empty_table(), joined]
            writer.write_table(pa.concat_tables(parts, promote_options="permissive"))


SMALL_P = 0.01
"""A p-value below which a fit is counted as poor."""


FEW_EVENTS = 10
"""Fewer events tell no species."""


def _quality(each: Found, day: Day) -> dict[str, Any]:
    """Describe the quality of one movie."""
    summary, masses_kda, p_values = each.summary, each.masses_kda, each.p_values
    cautions: list[str] = []
    noise, frames = each.noise
    # noise over that of the photoelectrons, as a variance, that is told
    if noise is not None and noise > 1.5:
        cautions.append(f"noise {noise:.2g} times shot noise at {frames} frames")
    drift = each.background.get("drift_px")
    moved = float(np.hypot(*drift)) if drift and None not in drift else None
    # drift of the fixed pattern that is told [px]
    if moved is not None and moved > 1.0 and not each.background.get("drift_corrected"):
        cautions.append(f"the pattern drifts {moved:.1f} px")
    small = float(np.mean(p_values < SMALL_P)) if p_values.size else None
    # share of small p-values, ten times the expected one, above which the model is doubted
    if small is not None and small > 0.1 and p_values.size >= FEW_EVENTS:
        cautions.append(f"{100 * small:.0f} % of p-values below {SMALL_P:g}")
    if summary.get("repeats", {}).get("understated"):
        cautions.append("σ is smaller than the measured spread")
    if summary["events"] < FEW_EVENTS and each.movie.row.role != "blank":
        cautions.append(f"{count(summary['events'], 'event')}, too few for species")
    optics, focus = _optics(each, day)
    if optics.startswith(("learned from this", "rejected")):
        cautions.append(f"optics {optics}")
    scale = _scale(each, day)
    if "mass" in dict(day.failed) and scale.startswith("as configured"):
        cautions.append("mass scale as configured, because the day's calibration failed")
    if scale.startswith(("none", "another")):
        cautions.append(f"mass scale: {scale}")
    outside = _outside(masses_kda, day)
    # share of the masses beyond the standards that is told
    if outside is not None and outside > 0.1 and masses_kda.size >= FEW_EVENTS:
        low, high = min(day.standards_kda), max(day.standards_kda)
        cautions.append(
            f"{100 * outside:.0f} % of masses are beyond the standards, {low:g} to {high:g} kDa"
        )
    seen = _standards_seen(each, day)
    if seen and seen[0] < seen[1]:
        cautions.append(f"{seen[0]} of {count(seen[1], 'standard')} among the species")
    precision = summary.get("precision", {}).get("mass_kda", {})
    return {
        "cautions": "; ".join(cautions),
        "drift_px": moved,
        "focus_shift_nm": focus,
        "median_p_value": float(np.median(p_values)) if p_values.size else None,
        "small_p_values": small,
        "repeat_over_crb": precision.get("repeat_over_crb"),
        "standards_seen": f"{seen[0]} of {seen[1]}" if seen else "",
        "optics": optics,
        "mass_scale": scale,
        "outside_standards": outside,
    }


def _optics(each: Found, day: Day) -> tuple[str, float | None]:
    """Say where the optics are from, and by how much the focus was moved."""
    optics, reference = each.summary.get("optics"), day.settings.get("optics.focus_nm")
    source = "of the day" if reference is not None else "as configured"
    if each.config.optics.file is not None:
        source = "of a file"
    if not optics:
        return f"{source}, not tested", None
    if optics.get("calibrated"):
        shift = None if reference is None else each.config.optics.focus_nm - float(reference)
        return "learned from this movie", shift
    if "tested" not in optics:
        return f"{source}, too few bright particles to test them", None
    if optics.get("reason"):
        return f"rejected by this movie ({source}), and not learned", None
    return f"{source}, confirmed", None


def _scale(each: Found, day: Day) -> str:
    """Say where the mass scale is from."""
    used, line = each.config.calibration, day.settings.get("calibration")
    if each.summary["mass_scale"] != "calibration" or used is None:
        return "none: the model's own"
    if line is None:
        return "as configured, not of this day"
    same = math.isclose(used.gradient_per_kda, line["gradient_per_kda"])
    return "of the day" if same else "another line than the day's"


def _outside(masses_kda: FloatArray, day: Day) -> float | None:
    if not day.standards_kda or not masses_kda.size:
        return None
    size = np.abs(masses_kda)
    low, high = min(day.standards_kda), max(day.standards_kda)
    # The events of a standard scatter about its mass: up to a tenth beyond counts as inside.
    return float(np.mean((size < 0.9 * low) | (size > 1.1 * high)))


def _standards_seen(each: Found, day: Day) -> tuple[int, int] | None:
    """Count the standards of a calibrant that are among its species."""
    row = each.movie.row
    wanted = [mass for mass, _ in row.standards] or list(day.standards_kda)
    if row.role != "calibrant" or not day.standards_kda or not each.distribution:
        return None
    species = [s for s in each.distribution["species"] if not s["outlier"]]
    seen = sum(
        any(
            # relative distance within which a species is a standard, or 3 standard errors
            abs(s["mass_kda"] - mass) <= max(0.05 * mass, 3 * (s["mass_se"] or 0.0))
            for s in species
        )
        for mass in wanted
    )
    return seen, len(wanted)
