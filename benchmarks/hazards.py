"""Movies that break what an analysis takes for granted: the error bar is right, or a flag is set.

    python benchmarks/hazards.py [--quick] [--movies 5] [--seed N] [--only TEXT]

Each row of `ROWS` is one kind of harm at some strengths; a function makes its movies.  Pictures
come from the quadrature of ``tests/instruments.py``, which shares nothing with the package.

Per row and strength, over all movies: the mean of mass over truth with its standard error, the
systematic error that the rows state, the bias over both of them together, the spread of the pulls
(over σ and the stated error of each row), the rows that are ``ok`` beyond `BEYOND` of it, and the
share of rows that carry a flag of the movie.  A row keeps its promise where the bias lies within
`SIGMAS` and no ``ok`` row is beyond, or where all rows are flagged.  Exit status 1 where one does
not.  To add a row, write a function from strength and seed to a `Case`, and name it in `ROWS`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

from instruments import (
    PEAK_PER_KDA,
    Instrument,
    InstrumentMovie,
    Landings,
    Pictures,
    draw_landings,
)

import iscat_analysis as ia

RESULTS = Path(__file__).resolve().parent / "results"
SHAPE, COUNT = (900, 160, 160), 36
PIXEL_NM, GAIN = 84.0, 4.0
NOMINAL = Instrument(emission="reciprocal")
SIGMAS, BEYOND, NEAR_PX, NEAR_FRAMES = 2.0, 5.0, 3.0, 8
SETUP: Mapping[str, Any] = {
    "camera.pixel_size_nm": PIXEL_NM,
    "camera.gain_e_per_adu": GAIN,
    "optics.focus_nm": NOMINAL.focus_nm,
    "background.method": "sliding",
    "particle.mass_kda": 205.0,
}


@dataclass(frozen=True)
class Case:
    """One movie, how it is analysed, and what is in it."""

    counts: np.ndarray[Any, Any]
    truth: Landings
    settings: Mapping[str, Any] = field(default_factory=dict)


def recorded(standards: Instrument = NOMINAL) -> dict[str, Any]:
    """Give a calibration whose standards were measured with a microscope, 1 % well."""
    sign = Pictures(standards).sign
    return {
        "calibration.gradient_per_kda": sign * PEAK_PER_KDA,
        "calibration.gradient_se_per_kda": 0.01 * PEAK_PER_KDA,
        "calibration.height_nm": standards.height_nm,
        "calibration.optics": {
            "focus_nm": standards.focus_nm, "wavelength_nm": standards.wavelength_nm,
            "na": standards.na,
        },
        "calibration.camera": {"pixel_size_nm": PIXEL_NM},
    }  # fmt: skip


def unrecorded() -> dict[str, Any]:
    """Give a gradient from elsewhere: nobody says with what optics it was measured."""
    return {"calibration.gradient_per_kda": Pictures(NOMINAL).sign * PEAK_PER_KDA}


def movie(
    seen: Instrument, seed: int, *, standards: Instrument = NOMINAL, pixel_nm: float = PIXEL_NM
) -> tuple[np.ndarray[Any, Any], Landings]:
    """Make a landing movie whose particles scatter as in the microscope of the standards.

    The field of a dipole over that of the reference goes as the wavelength to the power of -3,
    which pictures of a given peak do not have.
    """
    truth = draw_landings(SHAPE, COUNT, seed=seed, apart_px=14.0)
    strength = Pictures(standards).per_kda / Pictures(seen).per_kda
    strength *= (standards.wavelength_nm / seen.wavelength_nm) ** 3
    scattered = replace(truth, mass_kda=truth.mass_kda * strength)
    made = InstrumentMovie(
        seen, SHAPE, scattered, seed=seed + 1, pixel_nm=pixel_nm, gain_e_per_adu=GAIN
    )
    return made.counts, truth


def other_focus(strength: float, seed: int) -> Case:
    """Record a movie so many nm from the focus at which the standards were."""
    seen = replace(NOMINAL, focus_nm=NOMINAL.focus_nm - strength)
    return Case(*movie(seen, seed), recorded())


def other_focus_unrecorded(strength: float, seed: int) -> Case:
    """Do the same with a gradient that came without its optics."""
    seen = replace(NOMINAL, focus_nm=NOMINAL.focus_nm - strength)
    return Case(*movie(seen, seed), unrecorded())


def other_wavelength(strength: float, seed: int) -> Case:
    """Record at a wavelength that is so many nm above what is configured."""
    seen = replace(NOMINAL, wavelength_nm=NOMINAL.wavelength_nm + strength)
    settings = unrecorded() | {"uncertainty.wavelength_nm": strength}
    return Case(*movie(seen, seed), settings)


def other_magnification(strength: float, seed: int) -> Case:
    """Record with pixels that are larger by a share than what is configured."""
    pixel = PIXEL_NM * (1 + strength)
    settings = unrecorded() | {"uncertainty.magnification": max(strength, 0.0)}
    return Case(*movie(NOMINAL, seed, pixel_nm=pixel), settings)


@dataclass(frozen=True)
class Row:
    """One kind of harm."""

    make: Callable[[float, int], Case]
    strengths: tuple[float, ...]
    unit: str
    flag: str = ""


ROWS: Mapping[str, Row] = {
    "focus of the standards": Row(other_focus, (0.0, 30.0, 60.0, 120.0), "nm",
                                  "uncalibrated_optics"),
    "focus, gradient without record": Row(other_focus_unrecorded, (0.0, 30.0, 60.0), "nm",
                                          "uncalibrated_optics"),
    "wavelength, gradient from elsewhere": Row(other_wavelength, (0.0, 2.0, 5.0), "nm"),
    "magnification, gradient from elsewhere": Row(other_magnification, (0.0, 0.005, 0.01), ""),
}  # fmt: skip


def matched(case: Case, table: pd.DataFrame) -> pd.DataFrame:
    """Give the rows that are of a particle of the movie, with its mass."""
    truth, rows = case.truth, []
    landed = table[table["mass_kda"] > 0]
    for frame, x, y, mass in zip(truth.frame, truth.x_px, truth.y_px, truth.mass_kda, strict=True):
        away = np.hypot(landed["x_px"] - x, landed["y_px"] - y)
        near = away[(away < NEAR_PX) & ((landed["frame"] - frame).abs() < NEAR_FRAMES)]
        if len(near):
            rows.append(landed.loc[near.idxmin()].to_dict() | {"true_kda": mass})
    return pd.DataFrame(rows)


def analyse(row: Row, strength: float, seed: int) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Analyse one movie; its rows with their truth, and what the summary says."""
    case = row.make(strength, seed)
    result = ia.fit_movie(case.counts, settings={**SETUP, **case.settings}, name="movie")
    table = matched(case, result.table)
    if "systematic_mass_kda" not in table:
        table["systematic_mass_kda"] = 0.0
    return table.assign(seed=seed), dict(result.summary)


def judge(name: str, row: Row, strength: float, seeds: range) -> dict[str, Any]:
    """Analyse the movies of one strength and compare with the truth."""
    found = [analyse(row, strength, seed) for seed in seeds]
    table = pd.concat([each for each, _ in found], ignore_index=True)
    flags = table["flags"].fillna("").astype(str)
    flagged = float(flags.str.contains(row.flag).mean()) if row.flag else 0.0
    used = table[(table["status"] == "ok") | (flags == row.flag)] if row.flag else table[
        table["status"] == "ok"
    ]  # fmt: skip
    relative = used["mass_kda"] / used["true_kda"]
    stated = (used["systematic_mass_kda"] / used["mass_kda"]).groupby(used["seed"]).mean()
    means = relative.groupby(used["seed"]).mean()
    # movies whose optics are the configured ones share the whole of the stated error
    se = float(relative.std() / np.sqrt(len(relative)))
    whole = float(np.hypot(se, stated.mean()))
    error = used["mass_kda"] - used["true_kda"]
    pulls = error / np.hypot(used["sigma_mass_kda"], used["systematic_mass_kda"])
    good = used["status"] == "ok"
    beyond = int((pulls[good].abs() > BEYOND).sum())
    bias = float(relative.mean() - 1)
    kept = flagged == 1.0 or (abs(bias) <= SIGMAS * whole and not beyond)
    said = sorted(
        {text for _, summary in found for text in summary["warnings"] if "masses" in text}
    )
    return {
        "row": name, "strength": strength, "movies": len(seeds), "rows": len(table),
        "ok": int((table["status"] == "ok").sum()), "flagged": flagged,
        "bias": bias, "bias_se": se, "stated": float(stated.mean()),
        "bias_over_stated": bias / whole, "movie_means": means.tolist(),
        "pull_std": float(pulls.std()), "beyond": beyond, "kept": bool(kept), "said": said,
    }  # fmt: skip


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one movie of each row, no judgement")
    parser.add_argument("--movies", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    movies = 1 if options.quick else options.movies
    found = []
    for name, row in ROWS.items():
        if options.only not in name:
            continue
        for strength in row.strengths[:1] if options.quick else row.strengths:
            seeds = range(options.seed, options.seed + 10 * movies, 10)
            one = judge(name, row, strength, seeds)
            found.append(one)
            print(
                f"{'ok    ' if one['kept'] else 'BROKEN'} {name} {strength:g} {row.unit}: "
                f"bias {one['bias']:+.2%} ± {one['bias_se']:.2%}, stated {one['stated']:.2%}, "
                f"{one['bias_over_stated']:+.1f} of both; pulls {one['pull_std']:.2f}; beyond "
                f"{BEYOND:g} σ {one['beyond']}; ok {one['ok']} of {one['rows']}, flagged "
                f"{one['flagged']:.0%}",
                *one["said"],
                sep="\n       ", flush=True,
            )  # fmt: skip
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "hazards.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return int(not options.quick and not all(one["kept"] for one in found))


if __name__ == "__main__":
    sys.exit(main())
