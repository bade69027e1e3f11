"""`iscat bounds`: what no estimator can beat, and what it takes to come near."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from iscat_cli.console import Messages, grouped, short, table
from iscat_cli.options import Count, ModeSetup, Output, Seed, command

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

    from iscat_analysis.config import Config

KINDS = {
    "crb_single": "CRB single",
    "crb_joint": "CRB joint",
    "holevo": "Holevo",
    "qcrb": "QCRB",
    "qcrb_dong2021": "QCRB (Dong 2021)",
}
OPTICS = "optics"
"""What --for takes beside names of parameters."""

Goal = Annotated[
    str | None, typer.Option(autocompletion=lambda: ["x", "y", "z", "mass", "z,mass", OPTICS])
]


@command
def bounds(
    messages: Messages,
    *,
    scan: str | None = None,
    optimize: Literal["focus", "attenuation", "pupil"] | None = None,
    for_: Goal = None,
    events: Count = None,
    free: str | None = None,
    seed: Seed = None,
    target: str | None = None,
    preset: Literal["dong2021"] | None = None,
    setup: ModeSetup,
    output: Output,
) -> None:
    """Print the classical and quantum Cramér–Rao bounds of one particle.

    Per photon: one scattered photon on the camera (CRB) or collected (QCRB).

    Options
    -------
    --scan NAME=A:B:STEP
        Bounds along z, focus, attenuation, na, pixel, fov or photons; B is included. NAME=a,b,c
        lists values.
    --optimize
        Find the best focus, the best attenuation, or the best pupil: focus, phase and attenuation
        of the reference, mask and low Zernike terms together.
    --for NAMES
        Parameters whose bounds --optimize makes small: x, y, z or mass; for the pupil also
        several, as in z,mass; default all free ones. optics: how well particles would determine
        focus, NA, phase, mask and aberrations, instead of the bounds of one particle.
    --events N
        With --for optics: particles of particle.mass_kda; default 60.
    --free NAMES
        With --for optics: parameters to fit, some of focus,na,phase,mask,zernike,polarization;
        with --optimize pupil: what may change, some of focus,phase,attenuation,mask,zernike;
        default all.
    --seed
        With --optimize pupil: seed of the random starts; default 0.
    --target NAME=VALUE
        Frames and photons that a precision needs, as in mass=5kDa or z=2nm, and what limits the
        precision.
    --preset
        Reproduce every table and figure of a paper.
    --out DIR
        Folder for figures.

    Example: the bounds for a 1 MDa protein on the coverslip.

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
    from iscat_analysis.errors import ConfigError

    chosen = [o for o in (scan, optimize, target, preset) if o is not None]
    if len(chosen) > 1:
        raise ConfigError("choose one of --scan, --optimize, --target, --preset")
    if for_ == OPTICS:
        if chosen or setup.mode is not None:
            raise ConfigError(
                "--for optics stands alone: leave --scan, --optimize, --target, --preset and "
                "--mode away"
            )
        _optics(messages, setup.load(), events, free, output)
        return
    pupil = optimize == "pupil"
    if events is not None or (free is not None and not pupil):
        raise ConfigError(
            "--events and --free need --for optics; --free also goes with --optimize pupil"
        )
    if seed is not None and not pupil:
        raise ConfigError("--seed needs --optimize pupil")
    if (optimize is None) != (for_ is None) and not pupil:
        raise ConfigError("--optimize and --for go together, as in --optimize focus --for mass")
    if preset is not None:
        if output.out is None:
            raise ConfigError(f"--preset {preset} needs --out DIR, the folder to write")
        if setup.config or setup.changes:
            raise ConfigError(
                f"--preset {preset} has its own configuration: leave --config, --set and "
                "--mode away"
            )
        _paper(messages, output.out, overwrite=output.overwrite)
        return
    resolved = setup.load()
    if output.out is not None:
        from iscat_analysis.report.bounds import BOUNDS_FILES
        from iscat_analysis.report.output import check_output

        check_output(output.out, output.overwrite, known=BOUNDS_FILES)

    from iscat_analysis.bounds import bounds_report, detection_limit, plan

    report = bounds_report(resolved)
    limit = detection_limit(plan(resolved))
    if limit is not None:
        report["detection"] = asdict(limit)
    messages.note(*(f"warning: {line}" for line in report["warnings"]))
    along: dict[str, Any] = {}
    if scan is not None:
        along = _scan(messages, resolved, scan, report)
    elif pupil:
        along = _search_pupil(messages, resolved, for_, free, seed or 0, report)
    elif optimize is not None and for_ is not None:
        along = _optimize(messages, resolved, optimize, for_, report)
    elif target is not None:
        report["target"] = _target(resolved, target)
    if output.out is not None:
        from iscat_analysis.report.bounds import write_bounds

        write_bounds(report, output.out, overwrite=output.overwrite, **along)
        messages.wrote(output.out)
    messages.show("bounds", report, _lines(report))


def _scan(messages: Messages, config: Config, text: str, report: dict[str, Any]) -> dict[str, Any]:
    """Run a scan, add it to the report, and return what the figure needs."""
    from iscat_analysis.bounds import parse_scan, scan
    from iscat_analysis.findings.setup import LIGHT_HELD

    axis, values = parse_scan(text)
    with messages.progress() as progress:
        found = scan(config, axis, values, progress=progress)
    if axis.name in ("attenuation", "pixel"):
        messages.report(LIGHT_HELD({"axis": axis.name}))
    along = {"label": found.label, "here": found.here}
    report["scan"] = {"name": found.name, **along, "columns": found.table.to_dict("list")}
    return {"table": found.table, **along}


def _optimize(
    messages: Messages, config: Config, axis: str, parameter: str, report: dict[str, Any]
) -> dict[str, Any]:
    """Search, add the optimum to the report, and return what the figure needs."""
    from iscat_analysis.bounds import optimize

    with messages.progress() as progress:
        best = optimize(
            config, "focus" if axis == "focus" else "attenuation", parameter, progress=progress
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


def _search_pupil(
    messages: Messages,
    config: Config,
    parameters: str | None,
    free: str | None,
    seed: int,
    report: dict[str, Any],
) -> dict[str, Any]:
    """Search, add the optimum to the report, and return what the folder needs."""
    from iscat_analysis.bounds import optimize_pupil, parse_names
    from iscat_analysis.findings.setup import OFFSET_LEFT_OUT

    names = None if free is None else [name.strip() for name in free.split(",")]
    with messages.progress() as progress:
        best = optimize_pupil(
            config, parse_names(parameters, config), free=names, seed=seed, progress=progress
        )
    report["pupil"] = best.to_dict()
    if config.calibration is not None and config.calibration.offset:
        messages.report(OFFSET_LEFT_OUT())
    return {"design": best}


def _target(config: Config, text: str) -> dict[str, Any]:
    """Return the price of a precision, and where precision goes now."""
    from iscat_analysis.bounds import budget, effort, parse_target

    goal = parse_target(text, config)
    hidden = (
        "camera.samples_per_pixel = 1 samples pixels at their centres and hides what they cost: "
        "leave it out"
    )
    return {
        "parameter": goal.parameter,
        "value": goal.value,
        "effort": [asdict(entry) for entry in effort(config, goal)],
        "budget": [asdict(line) for line in budget(config, goal.parameter)],
        "note": hidden if config.camera.samples_per_pixel == 1 else "",
    }


def _optics(
    messages: Messages, config: Config, events: int | None, free: str | None, output: Output
) -> None:
    """Print how well particles would tell the microscope."""
    from iscat_analysis.bounds.shared import EVENTS, forecast_optics
    from iscat_analysis.report.bounds import OPTICS_BOUNDS_FILES, write_optics_bounds
    from iscat_analysis.report.output import check_output

    if output.out is not None:
        check_output(output.out, output.overwrite, known=OPTICS_BOUNDS_FILES)
    report = forecast_optics(config, events=events or EVENTS, free=free).to_dict()
    messages.note(*(f"warning: {line}" for line in report["warnings"]))
    if output.out is not None:
        write_optics_bounds(report, output.out, overwrite=output.overwrite)
        messages.wrote(output.out)
    messages.show("optics_bounds", report, _optics_lines(report))


def _optics_lines(report: Mapping[str, Any]) -> Iterator[RenderableType]:
    yield (
        f"{report['events']} particles of {report['at']['mass_kda']:g} kDa, signal-to-noise ratio "
        f"{short(report['snr'])} each"
    )
    yield table(
        "optics, all fitted together",
        "value",
        "±",
        "without images",
        rows=(
            (row["parameter"], f"{row['value']:g}", short(row["sigma"]), f"±{row['usual_error']:g}")
            for row in report["parameters"]
        ),
    )
    names = ("x_nm", "y_nm", "z_nm", "mass_kda")
    yield table(
        "error common to all fits",
        *names,
        rows=(
            (f"mode {mode}", *(short(common.get(name)) for name in names))
            for mode, common in report["common"].items()
        ),
    )
    goals = report["goals"]
    aims = (f"focus ±{goals['focus_nm']:g} nm", f"masses ±{100 * goals['mass_rel']:g} %")
    rows = []
    for row in report["needed"]:
        counts = (row[key] for key in ("focus_nm", "mass_rel"))
        cells = (grouped(count) if count == count else "–" for count in counts)
        rows.append((f"{row['mass_kda']:g} kDa", *cells, short(row["snr"])))
    yield table("particles needed for", *aims, "SNR of one", rows=rows)
    yield from (f"unidentifiable: {line}" for line in report["unidentifiable"])


def _paper(messages: Messages, out: Path, *, overwrite: bool) -> None:
    """Reproduce a paper."""
    from iscat_analysis.bounds.paper import FIELD_NM, reproduce
    from iscat_analysis.report.bounds import PAPER_FILES, write_paper
    from iscat_analysis.report.output import check_output

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
    messages.wrote(out, "comparison.html")
    names = ("printed", "authors", "dong2021", "exact", "reciprocal")
    records = found.table.to_dict("records")
    rows = []
    for row in records:
        unit = " [nm]" if row["unit"] == "nm" else ""
        rows.append((f"{row['quantity']}{unit}", *(short(row[name]) for name in names)))
    quantum = table("quantum bound of one photon", *names, rows=rows)
    messages.show("comparison", {"table_1": records}, [quantum])


def _lines(report: Mapping[str, Any]) -> Iterator[RenderableType]:
    """Print what `iscat bounds` found, which `--json` prints whole."""
    photons = report["n_scattered"]
    yield (
        f"scattered photons: {short(photons['camera'])} on the camera, "
        f"{short(photons['collected'])} collected"
    )
    if "scan" in report:
        yield _scan_table(report["scan"], report["at"]["free"])
    elif "optimum" in report:
        best = report["optimum"]
        rows = (("best", "value", "bound"), ("configured", "configured", "bound_configured"))
        yield table(
            str(best["of"]),
            "value",
            f"CRB {best['for']}",
            rows=((name, short(best[value]), short(best[bound])) for name, value, bound in rows),
        )
        yield best["note"]
    elif "pupil" in report:
        yield from _pupil_lines(report["pupil"])
    elif "target" in report:
        yield from _target_lines(report["target"])
    else:
        yield _bounds_table("per photon", report["per_photon"])
        at_once = {name: report["holevo"][name] for name in report["at"]["free"]}
        yield _bounds_table("for these photons", {**report["actual"], "holevo": at_once})
        yield _information(report)
        if "rod" in report:
            yield _bounds_table("direction of the rod unknown", report["rod"])
        if "detection" in report:
            yield _detection_table(report["detection"])
    for line in (*report["unidentifiable"], *report.get("rod", {}).get("unidentifiable", ())):
        yield f"unidentifiable: {line}"


def _bounds_table(title: str, values: Mapping[str, Mapping[str, Any]]) -> Table:
    """Tabulate bounds: one row per parameter, one column per kind."""
    kinds = [kind for kind in KINDS if kind in values]
    names = dict.fromkeys(name for kind in kinds for name in values[kind])
    rows = ((name, *(short(values[kind].get(name)) for kind in kinds)) for name in names)
    return table(title, *(KINDS[kind] for kind in kinds), rows=rows)


def _information(report: Mapping[str, Any]) -> Table:
    rivals = [pair.split("–") for pair in report["incompatible"]]
    rows = []
    for name, share in report["information_fraction"].items():
        alias = name.replace("_kda", "_rel")
        others = [a if b == alias else b for a, b in rivals if alias in (a, b)]
        shares = (share, report["information_fraction_joint"].get(name))
        known = ", ".join(other.replace("_rel", "_kda") for other in others) or "–"
        rows.append((name, *map(_percent, shares), known))
    return table(
        "information used",
        "of the light's",
        "jointly, of what can be had",
        "no single measurement is best for it and",
        rows=rows,
        left=(0, 3),
    )


def _percent(share: float | None) -> str:
    return "–" if share is None or not math.isfinite(share) else f"{100 * share:.1f} %"


def _detection_table(limit: Mapping[str, Any]) -> Table:
    title = f"detected but for {100 * limit['miss']:g} %, {100 * limit['false_alarm']:g} % false"
    places = {"place known": "known", "field searched": "searched"}
    keys = ("threshold_{}", "snr_{}", "mass_{}_kda")
    rows = ((at, *(short(limit[key.format(name)]) for key in keys)) for at, name in places.items())
    return table(title, "threshold", "SNR", "mass_kda", rows=rows)


def _scan_table(scanned: Mapping[str, Any], free: list[str]) -> Table:
    keys = [key for name in free for key in (f"crb_joint_{name}", f"qcrb_{name}")]
    columns = scanned["columns"]
    rows = (
        (f"{value:g}", *(short(columns[key][i]) for key in keys))
        for i, value in enumerate(columns[scanned["name"]])
    )
    return table(scanned["label"], *(h for n in free for h in (f"CRB {n}", "QCRB")), rows=rows)


def _target_lines(target: Mapping[str, Any]) -> Iterator[RenderableType]:
    """Print what a precision takes, and what limits it now."""
    unit = str(target["parameter"]).split("_")[1].replace("kda", "kDa")
    rows = []
    for entry in target["effort"]:
        price = ("never enough", "–", "–")
        if math.isfinite(entry["n_after"]):
            times = short(entry["seconds"]), short(entry["collected"])
            price = grouped(entry["n_after"]), *times
        rows.append((entry["background"], grouped(entry["n_before"]), *price))
    yield table(
        f"{target['value']:g} {unit} takes, with the background",
        "frames before",
        "frames after",
        "seconds",
        "collected photons",
        rows=rows,
    )
    lines = target["budget"]
    factors = ["", *(f"{line['factor']:.3f}" for line in lines[1:])]
    now = [
        (line["cause"], factor, short(line["bound"]))
        for line, factor in zip(lines, factors, strict=True)
    ]
    product = math.prod(line["factor"] for line in lines)
    now.append(("all", f"{product:.3f}", short(lines[-1]["bound"])))
    yield table("now", "factor", f"σ [{unit}]", rows=now)
    if target["note"]:
        yield target["note"]


def _pupil_lines(found: Mapping[str, Any]) -> Iterator[RenderableType]:
    """Print the settings of a pupil, what they give, and how near that comes to the bound."""
    ends = ("configured", "best")
    settings = {name: row for name, row in found["settings"].items() if any(row.values())}
    yield _named_rows("pupil", settings, dict(zip(ends, ends, strict=True)))
    kinds = {"configured": "configured", "best": "best", "holevo": "Holevo", "qcrb": "QCRB"}
    yield _named_rows("σ, all estimated together", found["sigma"], kinds)
    share = {key: 100 * value for key, value in found["share"].items() if value is not None}
    labels = {end: end for end in ends} | {"quiet": "best, background known and no read noise"}
    rows = ((label, f"{share[k]:.1f}" if k in share else "–") for k, label in labels.items())
    yield table("of what one measurement can take", "%", rows=rows)
    yield (
        f"{short(found['photons_per_pixel'])} e per pixel and frame in the background, "
        f"{short(found['peak_e'])} e in the brightest pixel; "
        f"{found['near']} of {len(found['descents'])} descents end within 1 % of the best"
    )


def _named_rows(
    title: str, rows: Mapping[str, Mapping[str, Any]], columns: Mapping[str, str]
) -> Table:
    """Tabulate numbers: a row for each name, a column for each key."""
    cells = ((name, *(short(row[key]) for key in columns)) for name, row in rows.items())
    return table(title, *columns.values(), rows=cells)
