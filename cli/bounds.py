"""`iscat bounds`: what no estimator can beat, and what it takes to come near."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from iscat_cli.bounds_tables import print_bounds
from iscat_cli.console import Messages, failures, print_json, print_result, short, table
from iscat_cli.options import (
    ConfigOption,
    JsonOption,
    ModeOption,
    OverwriteOption,
    SetOption,
    command,
)

if TYPE_CHECKING:
    from iscat_analysis.config import Config

EXAMPLE = """Example: the bounds for a 1 MDa protein on the coverslip.

    iscat bounds --config setup.toml --mode joint --set particle.mass_kda=1000

Along the focus, with a figure; the best focus for the mass; what 5 kDa takes:

    iscat bounds --config setup.toml --scan focus=-1000:1000:20 --out scan

    iscat bounds --config setup.toml --optimize focus --for mass

    iscat bounds --config setup.toml --target mass=5kDa

Which pupil would tell height and mass best, with optics.toml and a figure:

    iscat bounds --config setup.toml --mode joint --optimize pupil --out best

How well 60 such particles would tell the microscope itself:

    iscat bounds --config setup.toml --for optics --events 60
"""


class Preset(StrEnum):
    """A paper to reproduce."""

    DONG2021 = "dong2021"


class Optimized(StrEnum):
    """A setting to optimise."""

    FOCUS = "focus"
    ATTENUATION = "attenuation"
    PUPIL = "pupil"


OPTICS = "optics"
"""What --for takes beside names of parameters."""


@command
def bounds(
    messages: Messages,
    *,
    config: ConfigOption = None,
    mode: ModeOption = None,
    scan: Annotated[
        str | None,
        typer.Option(
            "--scan",
            metavar="NAME=A:B:STEP",
            help=(
                "Bounds along z, focus, attenuation, na, pixel, fov or photons; B is "
                "included. NAME=a,b,c lists values."
            ),
        ),
    ] = None,
    optimize: Annotated[
        Optimized | None,
        typer.Option(
            "--optimize",
            help="Find the best focus, the best attenuation, or the best pupil: focus, phase and "
            "attenuation of the reference, mask and low Zernike terms together.",
        ),
    ] = None,
    wanted: Annotated[
        str | None,
        typer.Option(
            "--for",
            metavar="NAMES",
            help=(
                "Parameters whose bounds --optimize makes small: x, y, z or mass; for the "
                "pupil also several, as in z,mass; default all free ones. optics: how well "
                "particles would determine focus, NA, phase, mask and aberrations, instead of"
                " the bounds of one particle."
            ),
            autocompletion=lambda: ["x", "y", "z", "mass", "z,mass", OPTICS],
        ),
    ] = None,
    events: Annotated[
        int | None,
        typer.Option(
            "--events",
            metavar="N",
            min=1,
            help="With --for optics: particles of particle.mass_kda; default 60.",
        ),
    ] = None,
    free: Annotated[
        str | None,
        typer.Option(
            "--free",
            metavar="NAMES",
            help=(
                "With --for optics: parameters to fit, some of "
                "focus,na,phase,mask,zernike,polarization; with --optimize pupil: what may "
                "change, some of focus,phase,attenuation,mask,zernike; default all."
            ),
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            "--seed", min=0, help="With --optimize pupil: seed of the random starts; default 0."
        ),
    ] = None,
    target: Annotated[
        str | None,
        typer.Option(
            "--target",
            metavar="NAME=VALUE",
            help=(
                "Frames and photons that a precision needs, as in mass=5kDa or z=2nm, and "
                "what limits the precision."
            ),
        ),
    ] = None,
    preset: Annotated[
        Preset | None, typer.Option("--preset", help="Reproduce every table and figure of a paper.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder for figures.")
    ] = None,
    settings: SetOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Print the classical and quantum Cramér–Rao bounds of one particle.

    Per photon: one scattered photon on the camera (CRB) or collected (QCRB).
    """
    with failures(messages):
        from iscat_analysis.config import load_config
        from iscat_analysis.errors import ConfigError

        chosen = [o for o in (scan, optimize, target, preset) if o is not None]
        if len(chosen) > 1:
            raise ConfigError("choose one of --scan, --optimize, --target, --preset")
        if wanted == OPTICS:
            if chosen or mode is not None:
                raise ConfigError(
                    "--for optics stands alone: leave --scan, --optimize, --target, --preset and "
                    "--mode away"
                )
            _optics(
                messages, load_config(config, settings or ()), events, free, out,
                overwrite=overwrite, as_json=as_json,
            )  # fmt: skip
            return
        pupil = optimize is Optimized.PUPIL
        if events is not None or (free is not None and not pupil):
            raise ConfigError(
                "--events and --free need --for optics; --free also goes with --optimize pupil"
            )
        if seed is not None and not pupil:
            raise ConfigError("--seed needs --optimize pupil")
        if (optimize is None) != (wanted is None) and not pupil:
            raise ConfigError("--optimize and --for go together, as in --optimize focus --for mass")
        if preset is not None:
            if out is None:
                raise ConfigError(f"--preset {preset} needs --out DIR, the folder to write")
            if config or settings or mode is not None:
                raise ConfigError(
                    f"--preset {preset} has its own configuration: leave --config, --set and "
                    "--mode away"
                )
            _paper(messages, out, overwrite=overwrite, as_json=as_json)
            return
        changes = [*(settings or ()), *([f'fit.mode="{mode.value}"'] if mode else ())]
        resolved = load_config(config, changes)
        if out is not None:
            from iscat_analysis.report.bounds import BOUNDS_FILES
            from iscat_analysis.report.output import check_output

            check_output(out, overwrite, known=BOUNDS_FILES)

        from iscat_analysis.bounds import bounds_report, detection_limit, plan

        report = bounds_report(resolved)
        limit = detection_limit(plan(resolved))
        if limit is not None:
            from dataclasses import asdict

            report["detection"] = asdict(limit)
        for line in report["warnings"]:
            messages.notify(f"warning: {line}")
        along: dict[str, Any] = {}
        if scan is not None:
            along = _scan(messages, resolved, scan, report)
        elif pupil:
            from iscat_cli.pupil import search_pupil

            along = search_pupil(messages, resolved, wanted, free, seed or 0, report)
        elif optimize is not None and wanted is not None:
            along = _optimize(messages, resolved, optimize.value, wanted, report)
        elif target is not None:
            report |= _target(resolved, target)
        if out is not None:
            from iscat_analysis.report.bounds import write_bounds

            write_bounds(report, out, overwrite=overwrite, **along)
            messages.notify(f"wrote {out}")
        if as_json:
            print_json("bounds", report)
            return
        print_bounds(report)


def _scan(messages: Messages, config: Config, text: str, report: dict[str, Any]) -> dict[str, Any]:
    """Run a scan, add it to the report, and return what the figure needs."""
    from iscat_analysis.bounds import parse_scan, scan

    axis, values = parse_scan(text)
    with messages.progress() as progress:
        found = scan(config, axis, values, progress=progress)
    if axis.name in ("attenuation", "pixel"):
        messages.notify("the light on the particle is held: photons_per_pixel follows")
    report["scan"] = {
        "name": found.name,
        "label": found.label,
        "here": found.here,
        "columns": found.table.to_dict("list"),
    }
    return {"table": found.table, "label": found.label, "here": found.here}


def _optimize(
    messages: Messages, config: Config, axis: str, wanted: str, report: dict[str, Any]
) -> dict[str, Any]:
    """Search, add the optimum to the report, and return what the figure needs."""
    from iscat_analysis.bounds import optimize

    with messages.progress() as progress:
        best = optimize(
            config, "focus" if axis == "focus" else "attenuation", wanted, progress=progress
        )
    report["optimum"] = {
        "of": best.axis,
        "for": best.parameter,
        "value": best.value,
        "bound": best.bound,
        "configured": best.here,
        "bound_configured": best.bound_here,
        "note": best.note,
    }
    return {"table": best.scan.table, "label": best.scan.label, "here": best.here}


def _target(config: Config, text: str) -> dict[str, Any]:
    """Return the price of a precision, and where precision goes now."""
    from dataclasses import asdict

    from iscat_analysis.bounds import budget, effort, parse_target

    goal = parse_target(text, config)
    return {
        "target": {
            "parameter": goal.parameter,
            "value": goal.value,
            "effort": [asdict(entry) for entry in effort(config, goal)],
            "budget": [asdict(line) for line in budget(config, goal.parameter)],
            "note": ""
            if config.camera.samples_per_pixel != 1
            else "camera.samples_per_pixel = 1 samples pixels at their centres and hides what they "
            "cost: leave it out",
        }
    }


def _optics(
    messages: Messages,
    config: Config,
    events: int | None,
    free: str | None,
    out: Path | None,
    *,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Print how well particles would tell the microscope."""
    from iscat_analysis.bounds.optics_forecast import EVENTS, forecast_optics
    from iscat_analysis.report.bounds import OPTICS_BOUNDS_FILES, write_optics_bounds
    from iscat_analysis.report.output import check_output

    if out is not None:
        check_output(out, overwrite, known=OPTICS_BOUNDS_FILES)
    report = forecast_optics(config, events=events or EVENTS, free=free).to_dict()
    for line in report["warnings"]:
        messages.notify(f"warning: {line}")
    if out is not None:
        write_optics_bounds(report, out, overwrite=overwrite)
        messages.notify(f"wrote {out}")
    if as_json:
        print_json("optics_bounds", report)
        return
    print_result(
        f"{report['events']} particles of {report['at']['mass_kda']:g} kDa, signal-to-noise ratio "
        f"{short(report['snr'])} each"
    )
    found = table("optics, all fitted together", "value", "±", "without images")
    for row in report["parameters"]:
        value, usual = f"{row['value']:g}", f"±{row['usual_error']:g}"
        found.add_row(row["parameter"], value, short(row["sigma"]), usual)
    print_result(found)
    found = table("error common to all fits", *("x_nm", "y_nm", "z_nm", "mass_kda"))
    for name, common in report["common"].items():
        cells = (common.get(key) for key in ("x_nm", "y_nm", "z_nm", "mass_kda"))
        found.add_row(f"mode {name}", *("–" if cell is None else short(cell) for cell in cells))
    print_result(found)
    goals = report["goals"]
    found = table(
        "particles needed for",
        f"focus ±{goals['focus_nm']:g} nm",
        f"masses ±{100 * goals['mass_rel']:g} %",
        "SNR of one",
    )
    for row in report["needed"]:
        counts = (row[key] for key in ("focus_nm", "mass_rel"))
        found.add_row(
            f"{row['mass_kda']:g} kDa",
            *(f"{count:,.0f}".replace(",", " ") if count == count else "–" for count in counts),
            short(row["snr"]),
        )
    print_result(found)
    for line in report["unidentifiable"]:
        print_result(f"unidentifiable: {line}")


def _paper(messages: Messages, out: Path, *, overwrite: bool, as_json: bool) -> None:
    from iscat_analysis.bounds.paper import FIELD_NM, reproduce
    from iscat_analysis.report.output import check_output
    from iscat_analysis.report.paper import PAPER_FILES, write_paper

    check_output(out, overwrite, known=PAPER_FILES)
    with messages.progress() as progress:
        found = reproduce(progress=progress)
    write_paper(
        found.curves,
        found.images,
        found.table,
        found.quantum,
        out,
        field_nm=FIELD_NM,
        overwrite=overwrite,
    )
    messages.notify(f"wrote {out}; open {out / 'comparison.html'}")
    if as_json:
        print_json("comparison", {"table_1": found.table.to_dict("records")})
        return
    names = ("printed", "authors", "dong2021", "exact", "reciprocal")
    quantum = table("quantum bound of one photon", *names)
    for row in found.table.to_dict("records"):
        unit = " [nm]" if row["unit"] == "nm" else ""
        quantum.add_row(f"{row['quantity']}{unit}", *(short(row[name]) for name in names))
    print_result(quantum)
