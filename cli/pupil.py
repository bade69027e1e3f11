"""`iscat bounds --optimize pupil`: the search, and its tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from iscat_cli.console import Messages, print_result, short, table

if TYPE_CHECKING:
    from iscat_analysis.config import Config


def search_pupil(
    messages: Messages,
    config: Config,
    wanted: str | None,
    free: str | None,
    seed: int,
    report: dict[str, Any],
) -> dict[str, Any]:
    """Search, add the optimum to the report, and return what the folder needs."""
    from iscat_analysis.bounds import optimize_pupil, parse_names

    with messages.progress() as progress:
        best = optimize_pupil(
            config,
            parse_names(wanted, config),
            free=None if free is None else [name.strip() for name in free.split(",")],
            seed=seed,
            progress=progress,
        )
    report["pupil"] = best.to_dict()
    if config.calibration is not None and config.calibration.offset:
        messages.notify(
            "warning: calibration.offset is left out, because it belongs to the configured optics: "
            "σ of the mass is that of a mass proportional to the field"
        )
    return {"design": best}


def print_pupil(found: Mapping[str, Any]) -> None:
    """Print the settings, what they give, and how near that comes to the bound."""
    settings = table("pupil", "configured", "best")
    for name, values in found["settings"].items():
        if any(values.values()):
            settings.add_row(name, short(values["configured"]), short(values["best"]))
    print_result(settings)
    sigmas = table("σ, all estimated together", "configured", "best", "Holevo", "QCRB")
    for name, row in found["sigma"].items():
        sigmas.add_row(name, *(short(row[k]) for k in ("configured", "best", "holevo", "qcrb")))
    print_result(sigmas)
    share = {key: 100 * value for key, value in found["share"].items() if value is not None}
    reached = table("of what one measurement can take", "%")
    for key, label in (
        ("configured", "configured"),
        ("best", "best"),
        ("quiet", "best, background known and no read noise"),
    ):
        reached.add_row(label, f"{share[key]:.1f}" if key in share else "–")
    print_result(reached)
    print_result(
        f"{short(found['photons_per_pixel'])} e per pixel and frame in the background, "
        f"{short(found['peak_e'])} e in the brightest pixel; "
        f"{found['near']} of {len(found['descents'])} descents end within 1 % of the best"
    )
