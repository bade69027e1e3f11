"""Tables of events with known species, for tests of what is made of them."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.species import Efficiency
from iscat_analysis.species.equilibrium import COMPOSITION, LANDING_POWER, Model, at_equilibrium


def draw_table(
    random: np.random.Generator,
    counts: dict[float, int],
    *,
    width: float = 3.0,
    sigma: tuple[float, float] = (6.0, 12.0),
    background: int = 0,
    efficiency: Efficiency | None = None,
    scale: float = 1.0,
) -> pd.DataFrame:
    """Draw so many particles of each mass, and a flat background; keep what the detector sees."""
    true = np.repeat(np.fromiter(counts, float), np.fromiter(counts.values(), int))
    true = np.concatenate([random.normal(scale * true, width), random.uniform(20, 600, background)])
    error = random.uniform(*sigma, true.size)
    mass = random.normal(true, error)
    table = pd.DataFrame({"mass_kda": mass, "sigma_mass_kda": error})
    if efficiency is None:
        return table
    extra = np.sqrt(np.maximum(efficiency.sigma_kda**2 - error**2, 0.0))
    estimate = random.normal(mass, extra)
    table["snr"] = estimate / efficiency.sigma_kda
    return table[estimate > efficiency.threshold_kda].reset_index(drop=True)


def draw_series(
    random: np.random.Generator,
    model: Model,
    totals_nm: NDArray[np.float64],
    kd_nm: float,
    masses: list[float],
    *,
    number: int,
    inactive: float = 0.0,
    efficiency: Efficiency | None = None,
    background: tuple[int, ...] = (0,),
) -> list[pd.DataFrame]:
    """Draw a table of so many particles that land for each concentration, at equilibrium."""
    weights = COMPOSITION[model] @ np.array(masses)
    rates = at_equilibrium(model, totals_nm, kd_nm, inactive) * weights**LANDING_POWER
    tables = []
    for row, rate in enumerate(rates):
        counts = random.multinomial(number, rate / rate.sum()).tolist()
        tables.append(
            draw_table(
                random, dict(zip(weights.tolist(), counts, strict=True)),
                background=background[row % len(background)], efficiency=efficiency,
            )
        )  # fmt: skip
    return tables


def draw_visits(
    random: np.random.Generator,
    *,
    landings: int,
    depletion_per_s: float,
    leaving_per_s: float,
    seconds: float = 60.0,
    frame_rate_hz: float = 100.0,
    window: int = 20,
    field_px: float = 200.0,
    efficiency: Efficiency | None = None,
) -> pd.DataFrame:
    """Draw particles of 150 kDa that land, fewer and fewer, and leave; what the search finds."""
    number = random.poisson(landings)
    x = depletion_per_s * seconds
    share = random.random(number)
    start = seconds * (-np.log1p(share * np.expm1(-x)) / x if x else share)
    stay = random.exponential(1 / leaving_per_s if leaving_per_s else np.inf, number)
    place = random.uniform(0, field_px, (number, 2))
    end = start + stay
    seen = end < seconds
    frame = np.floor(np.concatenate([start, end[seen]]) * frame_rate_hz)
    place = np.concatenate([place, place[seen]])
    place += random.normal(0, 0.2, place.shape)
    sign = np.concatenate([np.ones(number), -np.ones(int(seen.sum()))])
    sigma = random.uniform(6, 12, frame.size)
    table = pd.DataFrame(
        {
            "frame": frame,
            "x_px": place[:, 0],
            "y_px": place[:, 1],
            "mass_kda": sign * random.normal(150, sigma),
            "sigma_mass_kda": sigma,
            "n_after": window,
        }
    )  # fmt: skip
    long = np.concatenate([stay, stay[seen]]) * frame_rate_hz > window
    kept = long.copy()
    if efficiency is not None:
        estimate = random.normal(
            table["mass_kda"].abs(), np.sqrt(efficiency.sigma_kda**2 - sigma**2)
        )
        table["snr"] = estimate / efficiency.sigma_kda
        kept &= estimate > efficiency.threshold_kda
    return table[kept].sort_values("frame").reset_index(drop=True)
