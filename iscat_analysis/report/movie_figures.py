"""The figures of one analysis as data: what a page, a notebook and the window draw.

Every particle, an event or a track, is one row of the data set ``events``; figures that show
particles share it, so that a selection in one is a selection in all.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import pairwise
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.config import Config, parse_config
from iscat_analysis.optics.scatterers import Sphere, material, scattering_length_nm, sphere_of
from iscat_analysis.records import (
    BUDGET_COLUMNS,
    Analysis,
    FloatArray,
    PosteriorResult,
    Status,
    counted,
    free_parameters,
    track_numbers,
)
from iscat_analysis.report.answer import (
    EVENTS_KIND,
    Precision,
    Quantity,
    RowKind,
    as_contrasts,
    as_diameters,
    caution,
    is_uncalibrated,
    main_quantity,
    precision_of,
    row_kind,
    species_of,
    track_quantity,
    tracks_of,
)
from iscat_analysis.report.numbers import (
    LABELS,
    UNITS,
    decimals_for,
    fixed,
    number,
    parameter,
    percent,
)
from iscat_analysis.report.pictures import data_uri, display_range, grey_png
from iscat_analysis.report.tables import event_table
from iscat_analysis.report.vega import VegaFigure, columns_of, described, figure
from iscat_analysis.schemas import jsonable
from iscat_analysis.units import sphere_mass_kda

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Colours of species, safe for the colour-blind; after the last they begin again."""
BRIGHT = ("#56b4e9", "#ff8a3d", "#2fd6a3", "#f0a5cf", "#ffd166", "#b5e3ff")
"""The same on an image, which is grey."""
UNSORTED, UNSORTED_BRIGHT = "#7d858f", "#f0e442"
"""Colours of particles that belong to no species."""

PICTURE_PX, PICTURE_TALL_PX = 560, 420
"""Width and height of a field on the screen, at most."""
MOST_PATH_POINTS = 20_000
"""Points of paths on a page; of more, some are left out."""
RINGS = ((200, 240), (1000, 90), (math.inf, 20))
"""Sizes of rings around so many particles at most, so that the field is seen between them."""
MOST_ERRORS = 400
"""Tracks whose errors are drawn beside their dots."""
FEWEST_BINS = 9
"""Bins on the axis of a histogram, of which most are empty where particles are few or alike."""
MOST_LINE_POINTS = 1000
"""Points of a line over the movie."""
MOST_DOTS = 300
"""Particles whose errors are drawn against their bounds; of more, some are left out."""
MSD_PART = 4
"""Longest lag of a mean-squared displacement: the track's length over this."""
MSD_TRACKS = 6
"""Tracks whose mean-squared displacements are shown: the longest."""
INDICES = (1.36, 1.40, 1.46, 1.52, 1.60)
"""Refractive indices whose lines are drawn, of spheres that do not absorb."""
CREDIBLE_LEVELS = (0.95, 0.75, 0.5, 0.25)
"""Shades of a posterior's joint densities: the share of the probability inside each."""
CORNER_BINS = 24
MOST_CORNERS = 20
"""Posteriors that are shown."""
THOUSANDTH = "10⁻³"
"""Unit of contrasts in figures."""
FAR = 5.0
"""Standard deviations beyond which a particle belongs to no species."""
_NICE = (1.0, 2.0, 2.5, 5.0, 10.0)
_UM2 = 1e6  # nm²


@dataclass(frozen=True)
class Species:
    """A species, or a population of spheres: a row of `answer.species_of`, in units of a figure."""

    value: float
    sigma: float
    systematic: float
    width: float
    count: float
    count_low: float
    count_high: float
    share: float
    share_low: float
    share_high: float
    landing: float
    leaving: float

    @property
    def name(self) -> str:
        """Its value, with as many digits as its error supports."""
        error = float(np.nansum([self.sigma**2, self.systematic**2])) ** 0.5
        return fixed(self.value, decimals_for([error], 1)) if error else number(self.value)


@dataclass(frozen=True)
class Sample:
    """The particles of an analysis: rows, main quantity and species."""

    analysis: Analysis

    @cached_property
    def fits(self) -> pd.DataFrame:
        """Rows of ``fits.csv``."""
        return event_table(self.analysis)

    @cached_property
    def counted(self) -> pd.DataFrame:
        """Those rows of ``fits.csv`` that count as events, or as positions."""
        return counted(self.fits).reset_index(drop=True)

    @property
    def kind(self) -> RowKind:
        """Whether its rows are events or tracks."""
        return row_kind(self.analysis)

    @cached_property
    def rows(self) -> pd.DataFrame:
        """One row for each event, or each track, numbered in the column ``event``."""
        if self.kind is EVENTS_KIND:
            return self.counted
        return tracks_of(self.analysis).rename(columns={"track": "event"}).reset_index(drop=True)

    @cached_property
    def config(self) -> Config:
        """The resolved configuration."""
        return parse_config(tomllib.loads(self.analysis.config_toml))

    @cached_property
    def quantity(self) -> Quantity:
        """What is answered: a mass, a contrast, a diameter or a height."""
        if self.kind is EVENTS_KIND:
            return _displayed(main_quantity(self.analysis))
        sized = (self.described("sizes") or {}).get("populations")
        optical = Quantity("optical_diameter_nm", "optical diameter", "nm")
        return optical if sized else _displayed(track_quantity(self.analysis))

    @property
    def is_signed(self) -> bool:
        """Whether values below zero are another thing than particles that leave."""
        return self.quantity.column == "z_nm"

    @cached_property
    def values(self) -> tuple[FloatArray, FloatArray]:
        """Main quantity of every row, and its σ; magnitudes, but of heights."""
        values, sigma = self.quantity.values(self.rows)
        values, sigma = self.per_unit * values, self.per_unit * sigma
        return (values if self.is_signed else np.abs(values)), sigma

    @property
    def per_unit(self) -> float:
        """How many units of a figure are one unit of the table: contrasts are shown in 10⁻³."""
        return 1e3 if self.quantity.unit == THOUSANDTH else 1.0

    @cached_property
    def is_ok(self) -> Any:
        """Which rows have no flag in their status."""
        return (self.rows["status"] == Status.OK.value).to_numpy(bool)

    def described(self, name: str) -> dict[str, Any] | None:
        """Give what ``summary.json`` holds of species or sizes, where rows are a fair sample.

        Single frames of a track may be flagged as much as they like.
        """
        tracked = name == "sizes" and self.kind is not EVENTS_KIND
        fair = tracked or caution(self.fits) is None
        found = self.analysis.summary.get(name) if fair else None
        described = jsonable(found) if found else None
        return described if described and described.get("species", True) else None

    @cached_property
    def scale(self) -> float:
        """What a mass [kDa] is multiplied by, to become the main quantity."""
        if not self.quantity.power:
            return 1.0
        rows = self.rows[self.is_ok]
        per = (rows[self.quantity.column] / rows["mass_kda"] ** self.quantity.power).abs()
        return self.per_unit * float(per.median())

    @cached_property
    def species(self) -> list[Species]:
        """All species that are more than a few events; the background is none."""
        found = species_of(self.analysis)
        column, told = str(found.columns[0]), [each.name for each in fields(Species)]
        if column not in (self.quantity.column, self.quantity.column.removeprefix("optical_")):
            return []
        known = found.rename(columns={column: "value", f"sigma_{column}": "sigma"})
        known = known.rename(columns={f"systematic_{column}": "systematic"})
        lengths = ["value", "sigma", "systematic", "width"]
        known[lengths] *= self.per_unit
        return [Species(**row) for row in known[told].to_dict("records")]

    @cached_property
    def members(self) -> Any:
        """Species of each row, shape (rows,); -1 where it belongs to none."""
        values, sigma = self.values
        if not self.species:
            return np.full(values.size, -1)
        centres = np.array([each.value for each in self.species])
        wide = np.hypot(np.nan_to_num(sigma)[:, None], [each.width for each in self.species])
        wide = np.maximum(wide, 1e-9 * centres.max())
        off = np.abs(values[:, None] - centres) / wide
        weight = np.log([max(each.count, 1e-9) for each in self.species])
        best = np.argmax(weight - np.log(wide) - off**2 / 2, axis=1)
        inside = off[np.arange(values.size), best] < FAR
        return np.where(np.isfinite(values) & inside, best, -1)

    @cached_property
    def free(self) -> tuple[str, ...]:
        """Parameters that were fitted."""
        return tuple(free_parameters(self.analysis.mode, self.counted))

    def scaled(self, table: pd.DataFrame) -> pd.DataFrame:
        """Put what the main quantity is in the place of masses: diameters, contrasts [10⁻³]."""
        if self.analysis.mode_kind.fits_sizes:
            return as_diameters(table)
        if not self._lacks_masses or table.empty:
            return table
        names = [name for name in table if name.endswith("mass_kda")]
        scaled = as_contrasts(table)
        return scaled.assign(**{name: 1e3 * scaled[name] for name in names})

    @property
    def _lacks_masses(self) -> bool:
        return is_uncalibrated(self.analysis) and "contrast" in self.fits

    def precision_of(self, name: str) -> Precision:
        """Set σ of one parameter beside its bounds, on the scale of the main quantity."""
        table = self.counted
        found = precision_of(self.analysis, self.scaled(table), name)
        if self.unit(name) == UNITS[name]:
            return found
        whole = precision_of(self.analysis, table, name)  # Holevo's bound is that of the mass
        return replace(found, holevo=whole.holevo * found.crb / whole.crb)

    def unit(self, name: str) -> str:
        """Give the unit of a parameter on the scale of the main quantity."""
        if name != "mass_kda":
            return UNITS[name]
        return (
            "nm"
            if self.analysis.mode_kind.fits_sizes
            else (THOUSANDTH if self._lacks_masses else UNITS[name])
        )

    def label(self, name: str) -> str:
        """Name a parameter on the scale of the main quantity."""
        if name == "mass_kda" and self.unit(name) != UNITS[name]:
            return "contrast" if self._lacks_masses else "diameter"
        return LABELS[name]

    def parameter(self, name: str) -> str:
        """Name a parameter with its unit."""
        return f"{self.label(name)} [{self.unit(name)}]"

    @property
    def words(self) -> dict[str, Any]:
        """Words and colours that figures of particles leave open."""
        many = len(self.species)
        colours = [COLOURS[k % len(COLOURS)] for k in range(many)]
        bright = [BRIGHT[k % len(BRIGHT)] for k in range(many)]
        return {
            "quantity": self.quantity.label,
            "label": self.quantity.axis,
            "axis": self.quantity.axis,
            "noun": self.kind.noun,
            "species": [*range(many), -1],
            "colours": [*colours, UNSORTED if many else COLOURS[0]],
            "bright": [*bright, UNSORTED_BRIGHT],
        }

    @cached_property
    def time(self) -> tuple[FloatArray, str, float]:
        """Time of each row, what it is called, and how many frames are its unit."""
        frames = self.rows[self.kind.begins].to_numpy(float)
        rate = self.config.camera.frame_rate_hz
        return (frames / rate, "time [s]", rate) if rate else (frames, "frame", 1.0)

    @cached_property
    def events(self) -> dict[str, list[Any]]:
        """The data set that figures of particles share, one row for each particle."""
        rows, (values, sigma), places = self.rows, self.values, self.rows
        moving = {"d": "d_um2_s", "sigma_d": "sigma_d_um2_s"}
        if self.kind is EVENTS_KIND:
            moving = {}
        else:  # where each track begins
            first = self.fits.assign(track=track_numbers(self.fits)).sort_values("frame")
            places = first.drop_duplicates("track").set_index("track").reindex(rows["event"])
        found = {
            "event": rows["event"],
            "frame": rows[self.kind.begins],
            "time": self.time[0],
            "x": places["x_px"].to_numpy(),
            "y": places["y_px"].to_numpy(),
            "value": values,
            "sigma": sigma,
            "species": self.members,
            "status": rows["status"].astype(str),
        }
        return columns_of(found | {name: rows[column] for name, column in moving.items()})


def _displayed(quantity: Quantity) -> Quantity:
    return replace(quantity, unit=THOUSANDTH) if quantity.column == "contrast" else quantity


# ---- All figures ---------------------------------------------------------------------------------


def movie_figures(analysis: Analysis) -> dict[str, VegaFigure]:
    """Make the figures of an analysis.

    Parameters
    ----------
    analysis : Analysis
        What was found.

    Returns
    -------
    dict of str to VegaFigure
        Figures by name, in the order of the page; those that would be empty are left out.
    """
    return dict(figures_of(Sample(analysis)))


def figures_of(sample: Sample) -> Iterator[tuple[str, VegaFigure]]:
    """Make the figures of a sample one after the other, in the order of the page."""
    analysis, rows = sample.analysis, len(sample.rows)
    tracked = sample.kind is not EVENTS_KIND
    known = np.isfinite(sample.values[0]).any()
    if known:
        yield "masses", masses(sample)
    if np.asarray(analysis.ratio_image).size:
        yield "field", paths(sample) if tracked and rows else field(sample)
    if known and np.ptp(sample.time[0]) > 0:
        yield "time", time(sample)
    if known and (found := limit(sample)) is not None:
        yield "limit", found
    if tracked and known:
        yield "mobility", mobility(sample)
    for name, make in _DETAILS.items():
        if (drawn := make(sample)) is not None:
            yield name, drawn
    yield from _corners(analysis)


# ---- Masses --------------------------------------------------------------------------------------


def bin_width(values: FloatArray, sigma: FloatArray) -> float:
    """Choose a round width of about two standard deviations, which does not blur species."""
    extent = float(np.ptp(values)) or abs(float(values[0])) or 1.0
    spread = sigma[np.isfinite(sigma) & (sigma > 0)]
    wide = 2 * float(np.median(spread)) if spread.size else extent / 10
    wide = min(max(wide, extent / 90), extent / 6)
    power = 10.0 ** math.floor(math.log10(wide))
    return power * min(_NICE, key=lambda nice: abs(math.log(nice * power / wide)))


def masses(
    sample: Sample,
    wide: float | None = None,
    more: Mapping[str, pd.DataFrame] = MappingProxyType({}),
) -> VegaFigure:
    """Show the histogram of the main quantity, the species, and more rows of its data sets."""
    values, sigma = sample.values
    kept = np.isfinite(values)
    wide = wide or bin_width(values[kept], sigma[kept & sample.is_ok])
    bars = _bars(values[kept], sample.is_ok[kept], wide)
    curves = _curves(sample)
    unit = f" {sample.quantity.unit}".rstrip()
    peaks = []
    for k, each in enumerate(sample.species):
        near = bars[(bars["low"] - wide <= each.value) & (each.value < bars["high"] + wide)]
        curve = float(curves["density"][curves["species"] == k].max())
        peaks.append(
            {
                "value": each.value,
                "species": k,
                "label": f"{each.name}{unit}",
                "share": f"{fixed(each.count, 0)} · {percent(each.share, 0)}",
                "curve": curve,
                "height": np.nanmax([curve * wide, near["top"].max()]),
            }
        )
    words = {
        "title": sample.quantity.label.capitalize(),
        "counted": f"{sample.kind.noun}s",
        "bin": wide,
        "span": _around(bars["low"].min(), bars["high"].max(), wide),
    }
    parts = {"bars": bars, "curves": curves, "peaks": peaks, "gates": ()}
    data = {name: columns_of(part) for name, part in parts.items()}
    for name, rows in more.items():
        for key, column in columns_of(rows).items():
            data[name] = {**data[name], key: [*data[name].get(key, ()), *column]}
    drawn = figure("masses", data, {**sample.words, **words})
    return described(drawn, _sentence(sample))


def _around(low: float, high: float, wide: float) -> list[float]:
    """Choose an axis of a few bins at least, with one to spare at each end."""
    beside = wide * max(1, round((FEWEST_BINS - (high - low) / wide) / 2))
    return [low - beside, high + beside]


def _sentence(sample: Sample) -> str:
    unit = f" {sample.quantity.unit}".rstrip()
    text = f"Histogram of {sample.quantity.label} of {len(sample.rows)} {sample.kind.noun}s"
    names = [f"{each.name}{unit}, {fixed(each.count, 0)}" for each in sample.species]
    return f"{text}; species: {'; '.join(names)}." if names else f"{text}."


def _bars(values: FloatArray, ok: Any, wide: float) -> pd.DataFrame:
    """Count values in bins whose edges are multiples of their width; flagged ones on top."""
    first, last = (math.floor(float(end) / wide) for end in (values.min(), values.max()))
    edges = wide * np.arange(first, last + 2)
    good, bad = (np.histogram(values[part], edges)[0] for part in (ok, ~ok))
    bins = pd.DataFrame({"low": edges[:-1], "high": edges[1:]})
    parts = (
        bins.assign(bottom=0, top=good, count=good, part="ok"),
        bins.assign(bottom=good, top=good + bad, count=bad, part="flagged"),
    )
    return pd.concat(parts).query("count > 0")


def _curves(sample: Sample) -> pd.DataFrame:
    """Split the fitted density of all particles among the species, by what each is there."""
    if not sample.species:
        return pd.DataFrame()
    if sample.quantity.column.endswith("diameter_nm"):
        found = (sample.described("sizes") or {})["curve"]
        grid, model = np.array(found["diameter_nm"]), np.array(found["model"])
    else:
        found = (sample.described("distribution") or {})["curves"]
        power, mass = max(sample.quantity.power, 1), np.array(found["mass_kda"], dtype=float)
        grid = sample.scale * mass**power
        with np.errstate(divide="ignore"):
            model = np.array(found["model"]) / (sample.scale * power * mass ** (power - 1))
    typical = float(np.nanmedian(sample.values[1])) if len(sample.rows) else 0.0
    known = np.array([[each.value, each.count, each.width] for each in sample.species])
    centre, many, width = known.T[..., None]
    spread = np.maximum(np.hypot(width, typical), 1e-9)
    parts = many / spread * np.exp(-(((grid - centre) / spread) ** 2) / 2)
    whole = parts.sum(axis=0)
    density = np.divide(parts, whole, out=np.zeros_like(parts), where=whole > 0) * model
    k, at = np.nonzero(density > 1e-3 * np.nanmax(model))
    return pd.DataFrame({"species": k, "value": grid[at], "density": density[k, at]})


# ---- Where and when ------------------------------------------------------------------------------


def _picture(sample: Sample, bright: float) -> tuple[dict[str, list[Any]], dict[str, Any]]:
    """Give the image of the field, and the sizes and scales of a figure that shows it."""
    image = np.asarray(sample.analysis.ratio_image, float)
    low, high = (bright * end for end in display_range([image], sample.analysis.scheme))
    rows, columns = image.shape
    scale = min(PICTURE_PX / columns, PICTURE_TALL_PX / rows)
    wide, tall = (max(scale * side, PICTURE_PX / 9) for side in (columns, rows))
    picture = {
        "url": data_uri(grey_png((image - low) / (high - low), int(2 * PICTURE_PX))),
        "x": (columns - 1) / 2,
        "y": (rows - 1) / 2,
    }
    words = {
        "width": round(wide),
        "height": round(tall),
        "columns": [-0.5, columns - 0.5],
        "rows": [-0.5, rows - 0.5],
        "ring": next(size for most, size in RINGS if len(sample.rows) <= most),
        "caption": f"A pixel is {number(sample.analysis.pixel_size_nm)} nm.",
    }
    return columns_of([picture]), words


def field(sample: Sample) -> VegaFigure:
    """Show the field of view with a ring around each particle."""
    picture, words = _picture(sample, 1.0)
    if not len(sample.rows):
        words["caption"] = f"Contrast of the whole movie. {words['caption']}"
    return figure("field", {"picture": picture, "events": sample.events}, {**sample.words, **words})


def paths(sample: Sample) -> VegaFigure:
    """Show the field of view with the paths of its particles, coloured by the main quantity."""
    picture, words = _picture(sample, 2.0)
    fits = sample.fits.assign(event=track_numbers(sample.fits))
    fits = fits[fits["event"].isin(sample.rows["event"])].sort_values(["event", "frame"])
    fits = fits.iloc[:: 1 + len(fits) // MOST_PATH_POINTS]
    walked = fits[["event", "frame", "x_px", "y_px"]].rename(columns={"x_px": "x", "y_px": "y"})
    data = {"picture": picture, "paths": columns_of(walked), "events": sample.events}
    return figure("paths", data, {**sample.words, **words})


def time(sample: Sample) -> VegaFigure:
    """Show the main quantity against time, and how many particles come in each part of it."""
    at, name, rate = sample.time
    course = sample.analysis.summary.get("timeline") or {}
    last = max([*(course.get("events") or {}).get("edges", ()), float(at.max() * rate) + 1])
    span = [0.0, last / rate]
    counts, edges = np.histogram(at, bins=40, range=(0.0, last / rate))
    left_out = pd.DataFrame(course.get("intervals", ()), columns=["start", "stop", "what"])
    left_out[["start", "stop"]] /= rate
    per = f"{number(edges[1], 2)} s" if name != "frame" else f"{edges[1]:g} frames"
    words = {
        "time": name,
        "span": span,
        "rate": f"per {per}",
        "width": PICTURE_PX,
        "caption": "Shaded: frames that are left out or partly hidden." if len(left_out) else "",
    }
    rows = {"start": edges[:-1], "stop": edges[1:], "count": counts}
    data = {"events": sample.events, "rate": columns_of(rows), "intervals": columns_of(left_out)}
    return figure("time", data, {**sample.words, **words})


# ---- How near the limit --------------------------------------------------------------------------


def limit(sample: Sample) -> VegaFigure | None:
    """Show the error of each parameter over its bound, beside the quantum limit."""
    rows: list[dict[str, Any]] = []
    for name in sample.free:
        p = sample.precision_of(name)
        if not p.events or not p.crb > 0:
            continue
        label, unit = sample.label(name), sample.unit(name)
        low, high = p.measured_ci95 if p.is_measured else (p.over_crb, p.over_crb)
        sigma = f"{number(p.sigma, 2)} {unit}"
        rows.append(
            {
                "label": f"{label}: ± {sigma}",
                "reached": p.measured if p.is_measured else p.over_crb,
                "low": low,
                "high": high,
                "quantum": p.best[1] / p.crb,
                "sigma": sigma,
                "crb": f"{number(p.crb, 2)} {unit}",
                "qcrb": f"{number(p.best[1], 2)} {unit}",
                "how": "measured" if p.is_measured else "from the likelihood",
                "first": not rows,
            }
        )
    if not rows:
        return None
    ends = [row[key] for row in rows for key in ("low", "high", "reached", "quantum")]
    caption = (
        "Blue: how far the results scatter. At 1 nobody can read more out of these images; the "
        "grey tick is the best that any microscope could do with the same light."
    )
    span = [0, 1.2 * max(1.0, *filter(math.isfinite, ends))]
    words = {"span": span, "caption": caption, "height": 20 + 34 * len(rows)}
    drawn = figure("limit", {"limits": columns_of(rows)}, words)
    texts = [f"{row['label']}, {number(row['reached'])} times the bound" for row in rows]
    return described(drawn, f"Errors over their bounds: {'; '.join(texts)}.")


def precision(sample: Sample) -> VegaFigure | None:
    """Show σ and QCRB of each particle against its CRB, for every free parameter."""
    table, parts = sample.scaled(sample.counted), []
    for name in sample.free:
        kept = table[table[f"crb_{name}"] > 0]
        kept = kept.iloc[:: 1 + len(kept) // MOST_DOTS]
        bound, ok = kept[f"crb_{name}"], kept["status"] == Status.OK.value
        ends = [bound.min(), bound.max()]
        own = pd.DataFrame({"event": kept["event"], "crb": bound})
        parts += [
            part.assign(parameter=sample.parameter(name))
            for part in (
                pd.DataFrame({"event": -1, "crb": ends, "value": ends, "kind": "CRB"}),
                own.assign(value=kept[f"sigma_{name}"], kind=np.where(ok, "σ", "σ, flagged")),
                own.assign(value=kept[f"qcrb_{name}"], kind="QCRB"),
            )
        ]
    rows = pd.concat(parts).query("value > 0")
    return figure("precision", {"precision": columns_of(rows)}) if len(rows) else None


def spread(sample: Sample) -> VegaFigure | None:
    """Show the measured spread over the bound against the frames averaged.

    In mode ``track``, where none are, against the frames since the background.
    """
    analysis, parts = sample.analysis, []
    tracked = analysis.mode_kind.follows_tracks
    own, whole = (
        ("no particle", "all frames, 95 %") if tracked else ("own frames", "estimates, 95 %")
    )
    for name, part in analysis.summary.get("precision", {}).items():
        if (reached := part.get("repeat_over_crb")) is None:
            continue
        curve = {"frames": part["repeat_frames"], "value": part["repeat_over_crb_by_frames"]}
        curve |= {"error": part["repeat_over_crb_by_frames_se"], "kind": own}
        measured = pd.DataFrame(curve).astype({"value": float, "error": float})
        measured = measured.query("frames > 0").fillna({"error": 0.0})
        measured = measured.assign(
            low=measured["value"] - measured["error"], high=measured["value"] + measured["error"]
        )
        last = measured["frames"].max() if tracked else sample.counted["n_after"].median()
        low, high = part["repeat_over_crb_ci95"]
        end = {"frames": last, "value": reached, "low": low, "high": high, "kind": whole}
        found = [measured, pd.DataFrame([end])]
        if not tracked and (empty := part["empty_over_crb"][1:]):
            lengths = last * np.array([1 / 8, 1 / 4, 1 / 2, 1])[: len(empty)]
            kept = {"frames": lengths, "value": empty, "low": empty, "high": empty}
            found.append(pd.DataFrame(kept | {"kind": "no particle"}))
        parts += [one.assign(parameter=sample.label(name)) for one in found]
    rows = pd.concat(parts).dropna(subset=["value"]) if parts else pd.DataFrame()
    if rows.empty:
        return None
    words = {
        "across": "frames since the background" if tracked else "frames averaged",
        "caption": (
            "Of single frames, where there is no particle, against their distance from the "
            "background."
            if tracked
            else "Differences between parts of the particles' own frames; the same where there is "
            "no particle, up to whole windows; and the estimates themselves."
        )
        + " At 1 the noise is as the bound has it.",
    }
    return figure("spread", {"spread": columns_of(rows.drop(columns="error"))}, words)


def budget(sample: Sample) -> VegaFigure | None:
    """Show a bar for each source of the error of a mass, the largest first."""
    known = pd.DataFrame(sample.analysis.summary.get("budget", ()), columns=list(BUDGET_COLUMNS))
    known = known.assign(percent=100 * known["sigma_rel"].astype(float))
    known = known[known["percent"] > 1e-3 * known["percent"].max()]
    known = known.sort_values("percent", ascending=False, kind="stable")
    rows = known[["name", "kind", "common", "remedy", "percent"]]
    words = {"height": 24 * len(rows)}
    return figure("budget", {"budget": columns_of(rows)}, words) if len(rows) else None


# ---- Diagnostics ---------------------------------------------------------------------------------


def efficiency(sample: Sample) -> VegaFigure | None:
    """Show the chance to detect a particle, where it is not 1 for all masses."""
    found = sample.described("distribution")
    if found is None or sample.quantity.power or not sample.species:
        return None
    chance = found["curves"]["efficiency"]
    if min(value for value in chance if value is not None) >= 1:
        return None
    curve = {"value": found["curves"]["mass_kda"], "chance": chance}
    dots = [
        {"value": s["mass_kda"], "chance": s["efficiency"], "label": number(s["mass_kda"])}
        for s in found["species"]
        if not s.get("background")
    ]
    data = {"efficiency": columns_of(curve), "found": columns_of(dots)}
    return figure("efficiency", data, sample.words)


def _histogram(sample: Sample, column: str, words: Mapping[str, str]) -> VegaFigure | None:
    """Show how a number of each fit is distributed, and what is expected of it."""
    values = sample.fits[column].dropna().to_numpy(float)
    if values.size < 2:
        return None
    edges = np.linspace(0, 1, 21)
    expected = {"x": [0.0, 1.0], "y": values.size / 20}
    if column == "chi2_reduced":
        edges = np.histogram_bin_edges(values, bins=int(np.clip(np.sqrt(values.size), 8, 40)))
        expected = {"x": 1.0, "y": [0.0, float(np.histogram(values, edges)[0].max())]}
    counts = np.histogram(values, edges)[0]
    bars = {"low": edges[:-1], "high": edges[1:], "count": counts}
    data = {"bars": columns_of(bars), "expected": columns_of(expected)}
    return figure("histogram", data, {**words, "counted": "fits"})


def chi2(sample: Sample) -> VegaFigure | None:
    """Show the histogram of the reduced χ²."""
    caption = "Where model and noise describe the data it is near 1 (dashed)."
    words = {"title": "Misfit", "quantity": "reduced χ²", "caption": caption}
    return _histogram(sample, "chi2_reduced", words)


def p_values(sample: Sample) -> VegaFigure | None:
    """Show the histogram of the p-values."""
    caption = "Where model and noise describe the data it is flat (dashed)."
    words = {"title": "Probability of the misfit", "quantity": "p-value", "caption": caption}
    return _histogram(sample, "p_value", words)


def noise(sample: Sample) -> VegaFigure | None:
    """Show the variance over that of shot noise against the frames averaged."""
    summary = sample.analysis.summary
    found = summary.get("landing") or summary.get("background") or {}
    frames = found.get("noise_frames", ())
    if len(frames) < 2:
        return None
    rows = {"frames": frames, "ratio": found["noise_variance_over_shot"]}
    return figure("noise", {"noise": columns_of(rows)})


def course(sample: Sample) -> VegaFigure | None:
    """Show light, noise, focus, drift and particles of a movie on one axis of frames."""
    analysis = sample.analysis
    found = analysis.summary.get("timeline")
    if not found:
        return None
    edges, noun, frames = found["events"]["edges"], sample.kind.noun, found["frames"]
    middles = [(low + high) / 2 for low, high in pairwise(edges)]
    series: list[tuple[str, str, Any, Any]] = [
        ("light, relative", "", analysis.power_frames, analysis.power),
        ("noise, variance over expected", "", frames, found["noise_over_expected"]),
        ("focus [nm]", "", frames, found["focus_nm"]),
        ("drift [px]", "x", frames, found["drift_x_px"]),
        ("drift [px]", "y", frames, found["drift_y_px"]),
        (f"{noun}s, ok", "", middles, found["events"]["ok"]),
        (f"{noun}s, flagged", "", middles, found["events"]["flagged"]),
    ]
    if not analysis.scheme_kind.interferes:
        series = [one for one in series if one[0] != "focus [nm]"]
    parts = []
    for name, line, at, values in series:
        rows = pd.DataFrame({"series": name, "line": line, "frame": at, "value": values})
        rows["value"] = rows["value"].astype(float)
        if rows["value"].fillna(0.0).any():
            parts.append(rows.iloc[:: 1 + len(rows) // MOST_LINE_POINTS])
    gaps = pd.DataFrame(found["intervals"], columns=["start", "stop"])
    if not parts:
        return None
    data = {"course": columns_of(pd.concat(parts)), "gaps": columns_of(gaps)}
    return figure("course", data, {"width": PICTURE_PX})


# ---- Tracks --------------------------------------------------------------------------------------


def mobility(sample: Sample) -> VegaFigure:
    """Show D of each track against its mass; errors only where they would not hide the dots."""
    few = "true" if len(sample.rows) <= MOST_ERRORS else "false"
    return figure("mobility", {"events": sample.events}, {**sample.words, "few": few})


def msd(sample: Sample) -> VegaFigure | None:
    """Show mean-squared displacements of the longest tracks beside what their D says."""
    tracks, motion = tracks_of(sample.analysis), sample.analysis.summary.get("motion", {})
    rate, exposure = motion.get("frame_rate_hz"), motion.get("exposure_ms")
    if rate is None or tracks.empty:
        return None
    usable = tracks[tracks["d_um2_s"].notna() & (tracks["n_d_frames"] >= 2 * MSD_PART)]
    exposure_s = 1 / rate if exposure is None else exposure / 1e3
    bad = (usable["status"] != Status.OK.value).to_numpy(bool)
    ranked = usable.iloc[np.lexsort([-usable["n_d_frames"], bad])].head(MSD_TRACKS)
    numbers, parts = track_numbers(sample.fits), []
    for track in ranked.to_dict("records"):
        path = sample.fits[numbers == track["track"]].drop_duplicates("frame").sort_values("frame")
        lags, measured, error = mean_squared_displacement(path)
        seconds = lags / rate
        predicted = 4 * track["d_um2_s"] * (seconds - exposure_s / 3) + error / _UM2
        found = {"lag": 1e3 * seconds, "measured": measured / _UM2, "predicted": predicted}
        parts.append(pd.DataFrame(found | {"track": track["track"]}))
    return figure("msd", {"msd": columns_of(pd.concat(parts))}) if parts else None


def mean_squared_displacement(path: pd.DataFrame) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Lags [frames], mean-squared displacement, and what the errors of places add to it [nm²]."""
    frames = path["frame"].to_numpy(int)
    places = path[["x_nm", "y_nm"]].to_numpy(float)
    noise = (path[["sigma_x_nm", "sigma_y_nm"]] ** 2).sum(axis=1).to_numpy(float)
    most = max((frames[-1] - frames[0]) // MSD_PART, 1)
    lags = np.unique(np.geomspace(1, most, 16).round().astype(int))
    found = []
    for lag in lags:
        _, first, second = np.intersect1d(frames + lag, frames, return_indices=True)
        if first.size:
            squares = ((places[second] - places[first]) ** 2).sum(axis=1)
            found.append((lag, squares.mean(), np.mean(noise[first] + noise[second])))
    at, square, error = np.array(found, dtype=float).reshape(-1, 3).T
    return at, square, error


def size_plane(sample: Sample) -> VegaFigure | None:
    """Show hydrodynamic diameters, and what the light says, with lines of constant index.

    Spheres of one material lie on a line of constant refractive index, a straight one while they
    are small beside the wavelength.
    """
    tracks, config = tracks_of(sample.analysis), sample.config
    if "optical_diameter_nm" not in tracks:
        return None
    tracks = tracks[tracks[["diameter_nm", "optical_diameter_nm"]].notna().all(axis=1)]
    matter = material(config.particle, config.optics.wavelength_nm)
    sphere = sphere_of(config.particle, matter.permittivity, matter.mass_kda)
    if sphere is None or tracks.empty:
        return None

    def lengths(diameters_nm: FloatArray, one: Sphere) -> FloatArray:
        """Scattering lengths of spheres of one material."""
        masses = [sphere_mass_kda(d, one.density_kg_m3) for d in diameters_nm.tolist()]
        return np.array([scattering_length_nm(one.of_mass(m), config.optics) for m in masses])

    step = 1e-3  # of a diameter, for the slope along which its error is carried
    moved, optical = (tracks[f"{kind}diameter_nm"].to_numpy(float) for kind in ("", "optical_"))
    error, sigma = (tracks[f"sigma_{kind}diameter_nm"].to_numpy(float) for kind in ("", "optical_"))
    length = lengths(optical, sphere)
    up = np.abs((lengths(optical * (1 + step), sphere) - length) / (step * optical) * sigma)
    diameters = np.linspace(
        0.7 * min(moved.min(), optical.min()), 1.3 * max(moved.max(), optical.max()), 40
    )
    own = "shell" if sphere.shell_nm else f"{sphere.index.real:.2f}"
    kinds = [(f"{n:.2f}", replace(sphere, index=complex(n), shell_nm=0.0)) for n in INDICES]
    absorbs = abs(sphere.index.imag) >= step
    lines = [
        pd.DataFrame(
            {"diameter": diameters, "length": lengths(diameters, one), "index": label}
        ).assign(own=one is sphere, last=diameters == diameters[-1])
        for label, one in ([] if absorbs else [*kinds, (own, sphere)])
    ]
    dots = {
        "event": tracks["track"],
        "diameter": moved,
        "low": moved - error,
        "high": moved + error,
        "length": length,
        "length_low": length - up,
        "length_high": length + up,
        "judged": np.where(tracks["status"] == Status.OK.value, "ok", "flagged"),
    }
    materials = columns_of(pd.concat(lines)) if lines else {}
    return figure("sizes", {"materials": materials, "spheres": columns_of(dots)})


_DETAILS: Mapping[str, Any] = {
    "sizes": size_plane,
    "msd": msd,
    "budget": budget,
    "precision": precision,
    "spread": spread,
    "efficiency": efficiency,
    "chi2": chi2,
    "p_values": p_values,
    "noise": noise,
    "course": course,
}
"""Figures that a reader unfolds, by name."""


# ---- Single particles ----------------------------------------------------------------------------


def _corners(analysis: Analysis) -> Iterator[tuple[str, VegaFigure]]:
    """Show the first posteriors that converged."""
    sampled = [
        (view.event, view.posterior)
        for view in analysis.views
        if view.posterior is not None and view.posterior.converged
    ]
    for event, posterior in sampled[:MOST_CORNERS]:
        yield f"corner_{event:04d}", corner(posterior, event)


def corner(posterior: PosteriorResult, event: int) -> VegaFigure:
    """Show a posterior: each parameter, and each pair."""
    names = [parameter(name) for name in posterior.names]
    flat = posterior.samples.reshape(-1, len(names))
    parts = []
    for i, j in np.ndindex(len(names), len(names)):
        if j < i:
            counts, x, y = np.histogram2d(flat[:, j], flat[:, i], bins=CORNER_BINS)
            shades = credible_shades(counts)
            a, b = np.nonzero(shades)
            cells = {"bottom": y[b], "top": y[b + 1], "shade": shades[a, b]}
        elif j == i:
            heights, x = np.histogram(flat[:, i], bins=CORNER_BINS, density=True)
            a = np.arange(CORNER_BINS)
            cells = {"bottom": 0.0, "top": heights, "shade": 2}
        else:
            continue
        own = {"row": names[i], "column": names[j], "left": x[a], "right": x[a + 1]}
        parts.append(pd.DataFrame(own | cells))
    rows = columns_of(pd.concat(parts))
    return figure("corner", {"corner": rows}, {"title": f"Posterior of event {event}"})


def credible_shades(counts: FloatArray) -> Any:
    """Tell for each cell of a histogram which of the `CREDIBLE_LEVELS` contain it."""
    flat = counts.ravel()
    order = np.argsort(-flat, kind="stable")
    ranked = flat[order]
    shares = (np.cumsum(ranked) - ranked) / max(float(flat.sum()), 1.0)
    shades = np.zeros(flat.size, dtype=np.int64)
    shades[order] = np.less.outer(shares, CREDIBLE_LEVELS).sum(axis=1) * (ranked > 0)
    return shades.reshape(counts.shape)
