"""Pages of many movies whose results are made up, so that a test needs no fit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.day.compare import match_species, shifts
from iscat_analysis.day.gather import MOVIE_COLUMNS, SPECIES_COLUMNS
from iscat_analysis.report.batch import BatchContents, Curve, batch_page, summary_line


def make_batch_page(number: int, *, replicates: int = 3) -> str:
    """Make the page of a dimer's concentration series: so many movies, the last of which failed."""
    rng = np.random.default_rng(number)
    movies: list[dict[str, Any]] = []
    species: list[dict[str, Any]] = []
    curves = []
    grid = np.linspace(0, 300, 256)
    for k in range(number):
        sample, done = k // replicates, k < number - 1 or number == 1
        condition = f"pH {6 + sample % 4}"
        labels = {
            "movie": f"day/{condition}/movie_{k}", "sample": f"dimer {sample}",
            "condition": condition, "concentration_nm": 2.0 ** (sample % 8),
            "replicate": str(k % replicates), "role": "sample",
        }  # fmt: skip
        events = int(rng.integers(200, 2000)) if done else 0
        share = 1 / (1 + 2.0 ** (sample % 8) / 10)
        monomers = rng.binomial(events, share)
        masses = np.concatenate(
            [rng.normal(66, 5, monomers), rng.normal(132, 6, events - monomers)]
        )
        density = 0 * grid
        for at, count in ((66.0, monomers), (132.0, events - monomers)):
            density += count / 5 / 2.5066 * np.exp(-(((grid - at) / 5) ** 2) / 2)
            if count:
                part, half = count / events, 2 / np.sqrt(events)
                numbers = {"mass_kda": at + rng.normal(0, 0.3), "mass_se": 0.3, "share": part}
                interval = {"share_low": max(part - half, 0), "share_high": min(part + half, 1)}
                more = {"mass_low": at - 1, "mass_high": at + 1, "width_kda": 1.0, "count": count}
                width = {"width_low": 0.0, "width_high": 2.0, "efficiency": 0.9}
                row = {**labels, **numbers, **interval, **more, **width, "outlier": False}
                species.append(row)
        curves.append(Curve(labels["movie"], labels["sample"], condition, masses, grid, density))
        movies.append(
            {
                **labels, "state": "done" if done else "failed", "events": events, "ok": events,
                "why": "" if done else f"{labels['movie']}.tif: is cut short; copy it again",
                "cautions": "noise 2.1 times shot noise at 100 frames" if k % 5 == 0 else "",
                "report": f"movies/day/{condition}/movie_{k}.iscat/report.html" if done else "",
                "landings": events, "leavings": 3, "rate": events / 60 if done else np.nan,
                "rate_from": events / 70, "rate_to": events / 50, "rate_unit": "second",
                "noise_over_shot": 1.1, "drift_px": 0.2, "small_p_values": 0.011,
                "repeat_over_crb": 1.02, "standards_seen": "", "optics": "of the day, confirmed",
                "mass_scale": "of the day", "outside_standards": 0.02, "group": condition,
            }
        )  # fmt: skip
    table = pd.DataFrame(movies).reindex(columns=[*MOVIE_COLUMNS, *list(movies[0])[-24:]])
    table = table.loc[:, ~table.columns.duplicated()]
    found = pd.DataFrame(species).reindex(columns=[n for n in SPECIES_COLUMNS if n != "kind"])
    found = match_species(found)
    failed = [(row["movie"], row["why"]) for row in movies if row["state"] == "failed"]
    contents = BatchContents(
        curves=curves,
        movies=table,
        species=found.assign(group=found["condition"]),
        shifts=shifts(found, "dimer 0"),
        calibrations=[
            ("camera", "flats: flat_1", "camera.html"),
            ("optics", "confirmed by BSA", ""),
        ],
        failed=failed,
        equilibria=(),
        mass_label="mass [kDa]",
    )
    return batch_page("samples", summary_line(table), contents)
