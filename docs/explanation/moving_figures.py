"""Draw the figure of moving.md: masses of tracks over two backgrounds.

python benchmarks/tracking.py
python benchmarks/tracking.py --median
python docs/explanation/moving_figures.py
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

HERE = Path(__file__).resolve().parent
RESULTS = HERE.parents[1] / "benchmarks" / "results"

LEAST_FRAMES = 100
KINDS = {
    "tracking-median": ("#D55E00", "median of each pixel"),
    "tracking": ("#0072B2", "background with the tracks"),
}
STYLE = {
    "font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "svg.fonttype": "none",
    "svg.hashsalt": "iscat-analysis", "legend.frameon": False,
}  # fmt: skip


def masses() -> pd.DataFrame:
    """Masses of the longer tracks over each background, beside the truth."""
    tables = [pd.read_csv(RESULTS / f"{name}.csv").assign(method=name) for name in KINDS]
    both = min(int(table["movie"].max()) for table in tables)
    table = pd.concat(tables)
    long = (table["n_frames"] >= LEAST_FRAMES) & (table["status"] == "ok")
    return table[long & (table["movie"] <= both)]


def draw(table: pd.DataFrame) -> Figure:
    """Deviation of every track's mass from the truth."""
    species = sorted(set(zip(table["mass_kda_true"], table["d_um2_s_true"], strict=True)))
    figure = Figure(figsize=(6.4, 3.5), layout="constrained")
    axes = figure.subplots()
    axes.axhline(0, color="#8A8F96", lw=0.8)
    for side, (method, (colour, name)) in zip((-0.17, 0.17), KINDS.items(), strict=True):
        for place, (mass, d) in enumerate(species):
            mine = table[
                (table["method"] == method)
                & (table["mass_kda_true"] == mass) & (table["d_um2_s_true"] == d)
            ]  # fmt: skip
            x = place + side + np.linspace(-0.1, 0.1, len(mine))
            axes.errorbar(
                x, 100 * (mine["mass_kda"] / mass - 1), 100 * mine["sigma_mass_kda"] / mass,
                fmt="o", ms=3, lw=1, color=colour, label=name if place == 0 else None,
            )  # fmt: skip
    names = [f"{mass:g} kDa\n{d:g} µm²/s" for mass, d in species]
    axes.set_xticks(range(len(species)), names)
    axes.set_ylabel("mass of a track over its truth − 1 [%]")
    axes.legend(loc="lower right", fontsize=8)
    return figure


def main() -> None:
    """Write the figure."""
    with mpl.rc_context(STYLE):
        (HERE / "figures").mkdir(exist_ok=True)
        draw(masses()).savefig(HERE / "figures" / "moving.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
