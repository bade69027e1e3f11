"""The files of a batch: tables, events, figures and the page."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from iscat_analysis.day.calibrate import Day
from iscat_analysis.day.compare import (
    Reaction,
    Series,
    find_equilibria,
    kd_name,
    kd_table,
    match_species,
    shifts,
)
from iscat_analysis.day.gather import (
    MOVIE_COLUMNS,
    SPECIES_COLUMNS,
    Found,
    movie_table,
    poisson_rate,
    species_table,
    write_events,
)
from iscat_analysis.day.jobs import write_whole
from iscat_analysis.day.table import Plan
from iscat_analysis.files import whole_file
from iscat_analysis.report.batch import BatchContents, Curve, batch_page, summary_line
from iscat_analysis.report.output import atomic_folder
from iscat_analysis.report.tables import CSV_DIGITS
from iscat_analysis.text import in_table

_FIGURE = re.compile(r"(overlaid|stacked(_\d+)?|species|shares|rates|kd(_\d+)?)\.(png|svg|pdf)")


def publish_day(
    plan: Plan,
    day: Day,
    found: Sequence[Found],
    reaction: Reaction | None,
    failed: Sequence[tuple[str, str]],
    out: Path,
) -> None:
    """Write the tables and the page of all movies; each file is written whole or not at all."""
    movies = movie_table(plan, day, found, out)
    species = match_species(species_table(found))[list(SPECIES_COLUMNS)]
    shifted = shifts(species[species["role"] != "calibrant"], reference_of(found))
    series = [] if reaction is None else find_equilibria(found, reaction)
    tables = {"movies": movies, "species": species, "shifts": shifted}
    if reaction is not None:
        tables["kd"] = kd_table(series, reaction)
    else:
        (out / "kd.csv").unlink(missing_ok=True)
    for name, table in tables.items():
        text = in_table(table).to_csv(
            index=False, float_format=f"%.{CSV_DIGITS}g", lineterminator="\n"
        )
        write_whole(out / f"{name}.csv", text)
    with atomic_folder(out / "figures", True, known=_figure_files(out / "figures")) as folder:
        page = _page(plan, day, found, tables, series, failed, folder)
    write_whole(out / "batch.html", page)
    own = movies[list(movies.columns[len(MOVIE_COLUMNS) :])]
    with whole_file(out / "events.parquet") as partial:
        write_events(found, own, partial)


def _figure_files(folder: Path) -> set[str]:
    """Name what an earlier batch may have left among the figures."""
    held = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    return {name for name in held if _FIGURE.fullmatch(name)}


def _page(
    plan: Plan,
    day: Day,
    found: Sequence[Found],
    tables: Mapping[str, pd.DataFrame],
    series: Sequence[Series],
    failed: Sequence[tuple[str, str]],
    folder: Path,
) -> str:
    """Make the page, and the figures in a folder."""
    groups = {each.movie.name: _group(each) for each in found}
    movies, species = tables["movies"], tables["species"]
    timed = movies["seconds_searched"].notna() | movies["frames_searched"].isna()
    per_second = bool(timed.all())
    exposure = movies["seconds_searched" if per_second else "frames_searched"].to_numpy(float)
    exposure = exposure if per_second else exposure / 1000
    counted = zip(movies["landings"].astype(float), exposure, strict=True)
    rates = [poisson_rate(landings, time) for landings, time in counted]
    shown = movies.assign(
        group=[groups[name] for name in movies["movie"]],
        rate=[rate[0] for rate in rates],
        rate_from=[rate[1] for rate in rates],
        rate_to=[rate[2] for rate in rates],
        rate_unit="second" if per_second else "1000 frames",
    )
    shown.attrs["further"] = list(movies.columns[len(MOVIE_COLUMNS) :])
    scales = {each.summary["mass_scale"] for each in found if each.summary}
    contents = BatchContents(
        curves=[_curve(each, groups[each.movie.name]) for each in found],
        movies=shown,
        species=species.assign(group=[groups[name] for name in species["movie"]]),
        shifts=tables["shifts"],
        equilibria=[
            (each.condition, each.binding.to_dict(), each.remarks)
            for each in series
            if each.binding is not None
        ],
        calibrations=_calibrations(day),
        failed=[*failed, *((kd_name(each.condition), each.why) for each in series if each.why)],
        mass_label="mass [kDa]" if scales <= {"calibration"} else "mass, model scale [kDa]",
    )
    return batch_page(plan.table.title, summary_line(movies), contents, folder)


def _calibrations(day: Day) -> list[tuple[str, str, str]]:
    """Say what was calibrated by what, and where its page is."""
    camera = "calibration/camera/camera.html" if "camera.gain_e_per_adu" in day.settings else ""
    mass = "calibration/mass/calibration.html" if "calibration" in day.settings else ""
    return [
        ("camera", day.camera, camera),
        ("optics", day.optics, ""),
        ("mass scale", day.mass, mass),
    ]


def _group(each: Found) -> str:
    """Give the panel of a movie: its condition, or its role."""
    row = each.movie.row
    return row.condition or (row.role if row.role in ("calibrant", "blank") else "")


def _curve(each: Found, group: str) -> Curve:
    curves = each.distribution.get("curves", {})
    grid, density = (np.array(curves.get(key, ()), dtype=float) for key in ("mass_kda", "density"))
    return Curve(
        each.movie.name, each.movie.row.sample, group, np.abs(each.masses_kda), grid, density
    )


def reference_of(found: Sequence[Found]) -> str:
    """Name the sample that the others are compared with: the first of the table."""
    described = (
        each.movie.row.sample
        for each in found
        if each.movie.row.role == "sample" and each.distribution.get("species")
    )
    return next(described, "")
