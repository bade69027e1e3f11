"""`iscat bounds`: what no estimator can beat."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import typer

from iscat_cli.console import Messages, failures, print_json, print_result
from iscat_cli.options import (
    ConfigOption,
    DebugOption,
    JsonOption,
    ModeOption,
    QuietOption,
    SetOption,
)

if TYPE_CHECKING:
    from rich.table import Table

EXAMPLE = """Example: the bounds for a 1 MDa protein on the coverslip.

    iscat bounds --config setup.toml --mode joint --set particle.mass_kda=1000
"""

KINDS = {
    "crb_single": "CRB single",
    "crb_joint": "CRB joint",
    "qcrb": "QCRB",
    "qcrb_dong2021": "QCRB (Dong 2021)",
}


def bounds(
    context: typer.Context,
    *,
    config: ConfigOption = None,
    mode: ModeOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
    debug: DebugOption = False,
) -> None:
    """Print the classical and quantum Cramér–Rao bounds of one particle.

    Per photon: one scattered photon on the camera (CRB) or collected (QCRB).
    """
    messages = Messages(context.command_path, quiet=quiet)
    with failures(messages, debug=debug):
        from iscat_analysis.config import load_config

        changes = [*(settings or ()), *([f'fit.mode="{mode.value}"'] if mode else ())]
        resolved = load_config(config, changes)

        from iscat_analysis.bounds import bounds_report

        report = bounds_report(resolved)
        if as_json:
            print_json(report)
        else:
            photons = report["n_scattered"]
            print_result(
                f"scattered photons: {_short(photons['camera'])} on the camera, "
                f"{_short(photons['collected'])} collected"
            )
            print_result(bounds_table("per photon", report["per_photon"]))
            print_result("")
            print_result(bounds_table("for these photons", report["actual"]))


def bounds_table(title: str, values: Mapping[str, Mapping[str, Any]]) -> Table:
    """Tabulate bounds: one row per parameter, one column per kind.

    Parameters
    ----------
    title : str
        Heading of the first column.
    values : mapping
        Kind → parameter → bound.

    Returns
    -------
    rich.table.Table
        What a kind does not know is a dash.
    """
    from rich import box
    from rich.console import Console
    from rich.table import Table

    kinds = [kind for kind in KINDS if kind in values]
    table = Table(box=box.SIMPLE_HEAD if Console().is_terminal else None, pad_edge=False)
    table.add_column(title, no_wrap=True)
    for kind in kinds:
        table.add_column(KINDS[kind], justify="right", no_wrap=True)
    for name in dict.fromkeys(name for kind in kinds for name in values[kind]):
        table.add_row(name, *(_short(values[kind].get(name)) for kind in kinds))
    return table


def _short(value: float | None) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{value:.4g}"
