"""Tables of a batch, made from the results of its movies."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.special import gammaincinv

from iscat_analysis.config import Config, load_config
from iscat_analysis.day.calibrate import Day
from iscat_analysis.day.plan import Movie, Plan
from iscat_analysis.day.quality import judge, noise_of
from iscat_analysis.day.run import Outcome
from iscat_analysis.records import FloatArray, Status
from iscat_analysis.report.answer import answer_in

LABELS = ("movie", "sample", "condition", "concentration_nm", "replicate", "role")
"""What tells a movie in every table."""

MOVIE_COLUMNS = (
    *LABELS, "path", "state", "why", "cautions", "report", "events", "ok", "landings", "leavings",
    "species", "main_mass_kda", "answer", "rate_per_s", "rate_low", "rate_high", "rate_per_um2_s",
    "frames_searched", "seconds_searched", "field_um2", "frames", "drift_px", "focus_shift_nm",
    "noise_over_shot", "noise_frames", "median_p_value", "small_p_values", "repeat_over_crb",
    "standards_seen", "optics", "mass_scale", "outside_standards", "remarks", "sha256",
)  # fmt: skip
"""Columns of ``movies.csv``, before those of the table that have no meaning here."""

SPECIES_COLUMNS = (
    *LABELS, "kind", "mass_kda", "mass_se", "mass_low", "mass_high", "mass_systematic",
    "width_kda", "width_low", "width_high", "count", "count_low", "count_high",
    "fraction", "fraction_low", "fraction_high", "share", "share_low", "share_high",
    "count_corrected", "corrected_low",
    "corrected_high", "landing", "leaving", "efficiency", "rate_per_s", "rate_low", "rate_high",
    "outlier",
)  # fmt: skip
"""Columns of ``species.csv``; `kind` is the same for species of several movies with one mass.  A
`share` is of the particles that came, as `fraction` is, but without outliers: one event far below
the detection limit stands for any number of particles, and would take the others' fractions."""

_Z95 = 1.959964
_MASSES = ("mass_kda", "status", "p_value")


@dataclass(frozen=True, eq=False)
class Found:
    """Results of one movie."""

    movie: Movie
    outcome: Outcome
    folder: Path
    summary: Mapping[str, Any]
    masses_kda: FloatArray
    p_values: FloatArray
    config: Config | None

    @property
    def labels(self) -> dict[str, Any]:
        """The columns `LABELS`."""
        row = self.movie.row
        return {
            "movie": self.movie.name,
            "sample": row.sample,
            "condition": row.condition,
            "concentration_nm": row.concentration_nm,
            "replicate": row.replicate,
            "role": row.role,
        }

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
        rate = self.config.camera.frame_rate_hz if self.config is not None else None
        return self.frames_searched / rate if rate else math.nan

    @property
    def field_um2(self) -> float:
        """Area of the frame [µm²]; NaN where it is not known."""
        shape = (self.outcome.record or {}).get("shape")
        pixel = self.config.camera.pixel_size_nm if self.config is not None else None
        return float(shape[1] * shape[2] * (pixel / 1e3) ** 2) if shape and pixel else math.nan


def read_movie(movie: Movie, outcome: Outcome, folder: Path) -> Found:
    """Read what the tables and figures need of a result."""
    nothing = np.empty(0)
    if outcome.state != "done" or movie.row.role == "flat":
        return Found(movie, outcome, folder, {}, nothing, nothing, None)
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    config = load_config(folder / "config.toml")
    events = pd.read_parquet(folder / "fits.parquet", columns=list(_MASSES))
    kept = events[events["status"].isin([Status.OK, Status.POOR_FIT])]
    if (folder / "tracks.parquet").is_file():
        good = pd.read_parquet(folder / "tracks.parquet", columns=["mass_kda"])
    else:
        good = events[events["status"] == Status.OK]
    good = good if summary["mode"] != "localize" else good[:0]
    mass = good["mass_kda"].to_numpy(float)
    p_values = kept["p_value"].to_numpy(float)
    return Found(
        movie, outcome, folder, summary, mass[np.isfinite(mass)],
        p_values[np.isfinite(p_values)], config,
    )  # fmt: skip


def species_table(found: Sequence[Found]) -> pd.DataFrame:
    """Put the species of all movies into one table."""
    rows = []
    for each in found:
        described = each.summary.get("distribution") or {}
        known = [s for s in described.get("species", ()) if not s.get("background")]
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
        id(s): ((s["count_high"] or math.nan) - (s["count_low"] or 0.0)) / (2 * _Z95 * s["count"])
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
        error = _Z95 * math.hypot(relative[id(each)], math.sqrt(others) / b)
        odds = math.log(a / b)
        low, high = (1 / (1 + math.exp(-odds - sign * error)) for sign in (-1, 1))
        shares.append({"share": a / total, "share_low": low, "share_high": high})
    return shares


def movie_table(plan: Plan, day: Day, found: Sequence[Found], out: Path) -> pd.DataFrame:
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
    further = [key for each in plan.table.rows for key in each.further]
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
    quality = judge(each.movie, each.summary, each.config, each.masses_kda, each.p_values, day)
    species = (summary.get("distribution") or {}).get("species", ())
    counted = [s for s in species if not s["outlier"]]
    main = max(counted, key=lambda s: s["count"], default=None)
    rate, low, high = poisson_rate(landing.get("landings"), each.seconds)
    noise, frames = noise_of(summary)
    return {
        "report": (each.folder / "report.html").relative_to(out).as_posix(),
        "events": summary["events"],
        "ok": summary["status"].get("ok", 0),
        "landings": landing.get("landings"),
        "leavings": landing.get("leavings"),
        "species": len(counted) if summary.get("distribution") else None,
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
        **quality,
    }


def poisson_rate(count: float | None, seconds: float) -> tuple[float, float, float]:
    """Give a rate with its 95 % Poisson interval (Garwood, Biometrika 28, 437, 1936)."""
    if count is None or not (math.isfinite(count) and math.isfinite(seconds)):
        return math.nan, math.nan, math.nan
    low = float(gammaincinv(count, 0.025)) if count > 0 else 0.0
    return count / seconds, low / seconds, float(gammaincinv(count + 1, 0.975)) / seconds


def _typed(column: pd.Series[Any]) -> pd.Series[Any]:
    """Turn a column of text into numbers where all of it is."""
    try:
        return pd.to_numeric(column.replace("", None))
    except (TypeError, ValueError):
        return column.map(lambda v: "" if v is None or v != v else str(v))


def write_events(found: Sequence[Found], further: pd.DataFrame, path: Path) -> int:
    """Write the events of all movies into one file, one movie at a time."""
    done = [k for k, each in enumerate(found) if each.summary]
    names: dict[str, pa.DataType] = {}
    for k in done:
        for name_and_type in pq.read_schema(found[k].folder / "fits.parquet"):
            names.setdefault(name_and_type.name, name_and_type.type)
    count = 0
    schema = None
    writer = None
    try:
        for table in _tables(found, further, done, names):
            schema = table.schema if schema is None else schema
            writer = writer or pq.ParquetWriter(str(path), schema, compression="zstd")
            writer.write_table(table)
            count += table.num_rows
        if writer is None:
            empty = pa.schema([(name, pa.string()) for name in LABELS])
            writer = pq.ParquetWriter(str(path), empty, compression="zstd")
    finally:
        if writer is not None:
            writer.close()
    return count


def _tables(
    found: Sequence[Found],
    further: pd.DataFrame,
    done: Sequence[int],
    names: Mapping[str, pa.DataType],
) -> Iterator[pa.Table]:
    """Give the events of one movie after another, all with the same columns."""
    own = pa.Schema.from_pandas(further, preserve_index=False)
    for k in done:
        events = pq.read_table(found[k].folder / "fits.parquet")
        rows = events.num_rows
        columns: dict[str, Any] = {}
        for name, value in found[k].labels.items():
            kind = pa.float64() if name == "concentration_nm" else pa.string()
            columns[name] = pa.array([value] * rows, kind)
        for name_and_type in own:
            value = further[name_and_type.name].iloc[k]
            columns[name_and_type.name] = pa.array([value] * rows, name_and_type.type)
        for name, kind in names.items():
            known = name in events.column_names
            columns[name] = events[name].cast(kind) if known else pa.nulls(rows, kind)
        yield pa.table(columns)
