"""`iscat bounds`: what no estimator can beat, and what it takes to come near."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from iscat_cli.console import Messages, grouped, listing, short, table
from iscat_cli.options import Count, ModeSetup, Output, Seed, command

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

    from iscat_analysis.config import Config
    from iscat_analysis.records import Progress

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


@dataclass(frozen=True)
class Question:
    """What is asked, beside the bounds themselves.

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
    """

    scan: str | None = None
    optimize: Literal["focus", "attenuation", "pupil"] | None = None
    for_: Goal = None
    events: Count = None
    free: str | None = None
    seed: Seed = None
    target: str | None = None
    preset: Literal["dong2021"] | None = None

    def refuse(self, setup: ModeSetup, output: Output) -> None:
        """Refuse options that do not go together, for the first reason that holds."""
        from iscat_analysis.errors import ConfigError

        ways = (self.scan, self.optimize, self.target, self.preset)
        chosen = [way for way in ways if way is not None]
        pupil, optics, preset = self.optimize == "pupil", self.for_ == OPTICS, self.preset
        lone_goal = (self.optimize is None) != (self.for_ is None) and not pupil and not optics
        lone_free = self.events is not None or (self.free is not None and not pupil)
        reasons: dict[str, object] = {
            "choose one of --scan, --optimize, --target, --preset": len(chosen) > 1,
            "--for optics stands alone: leave --scan, --optimize, --target, --preset and --mode "
            "away": optics and (chosen or setup.mode),
            "--events and --free need --for optics; --free also goes with --optimize pupil": (
                lone_free and not optics
            ),
            "--seed needs --optimize pupil": self.seed is not None and not pupil,
            "--optimize and --for go together, as in --optimize focus --for mass": lone_goal,
            f"--preset {preset} needs --out DIR, the folder to write": preset and not output.out,
            f"--preset {preset} has its own configuration: leave --config, --set and --mode away": (
                preset and (setup.config or setup.changes)
            ),
        }
        for why, holds in reasons.items():
            if holds:
                raise ConfigError(why)


@command
def bounds(messages: Messages, *, asked: Question, setup: ModeSetup, output: Output) -> None:
    """Print the classical and quantum Cramér–Rao bounds of one particle.

    Per photon: one scattered photon on the camera (CRB) or collected (QCRB).

    Options
    -------
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
    asked.refuse(setup, output)
    if asked.preset is not None:
        _paper(messages, output)
        return
    config = setup.load()
    if asked.for_ == OPTICS:
        _optics(messages, config, asked, output)
        return
    from iscat_analysis.bounds import bounds_report, detection_limit, plan
    from iscat_analysis.report.bounds import BOUNDS_FILES, write_bounds

    output.check(BOUNDS_FILES)
    report = bounds_report(config)
    limit = detection_limit(plan(config))
    if limit is not None:
        report["detection"] = asdict(limit)
    messages.note(*(f"warning: {line}" for line in report["warnings"]))
    with messages.progress() as progress:
        name, found, along = _answer(config, asked, progress)
    if name:
        report[name] = found
    if name == "scan" and found["name"] in ("attenuation", "pixel"):
        from iscat_analysis.findings.setup import LIGHT_HELD

        messages.report(LIGHT_HELD({"axis": found["name"]}))
    if name == "pupil" and config.calibration is not None and config.calibration.offset:
        from iscat_analysis.findings.setup import OFFSET_LEFT_OUT

        messages.report(OFFSET_LEFT_OUT())
    if output.out is not None:
        write_bounds(report, output.out, overwrite=output.overwrite, **along)
        messages.wrote(output.out, "bounds.html")
    messages.show("bounds", report, _lines(report))


def _answer(
    config: Config, asked: Question, progress: Progress
) -> tuple[str, dict[str, Any], dict[str, Any]]:
    """Give the part of the report that was asked for, by its name, and what its figure needs."""
    from iscat_analysis import bounds as of

    if asked.scan is not None:
        axis, values = of.parse_scan(asked.scan)
        scan = of.scan(config, axis, values, progress=progress)
        about = {"label": scan.label, "here": scan.here}
        columns = scan.table.to_dict("list")
        found = {"name": scan.name, **about, "columns": columns}
        return "scan", found, {"table": scan.table, **about}
    if asked.optimize == "pupil":
        names = None if asked.free is None else [name.strip() for name in asked.free.split(",")]
        goal, seed = of.parse_names(asked.for_, config), asked.seed or 0
        pupil = of.optimize_pupil(config, goal, free=names, seed=seed, progress=progress)
        return "pupil", pupil.to_dict(), {"design": pupil}
    if asked.optimize is not None and asked.for_ is not None:
        best = of.optimize(config, asked.optimize, asked.for_, progress=progress)
        found = {
            "of": best.axis,
            "for": best.parameter,
            "value": best.value,
            "bound": best.bound,
            "configured": best.here,
            "bound_configured": best.bound_here,
            "note": best.note,
        }
        curve = {"table": best.scan.table, "label": best.scan.label, "here": best.here}
        return "optimum", found, curve
    if asked.target is not None:
        return "target", _target(config, asked.target), {}
    return "", {}, {}


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


def _optics(messages: Messages, config: Config, asked: Question, output: Output) -> None:
    """Print how well particles would tell the microscope."""
    from iscat_analysis.bounds.shared import EVENTS, forecast_optics
    from iscat_analysis.report.bounds import OPTICS_BOUNDS_FILES, write_optics_bounds

    output.check(OPTICS_BOUNDS_FILES)
    report = forecast_optics(config, events=asked.events or EVENTS, free=asked.free).to_dict()
    messages.note(*(f"warning: {line}" for line in report["warnings"]))
    if output.out is not None:
        write_optics_bounds(report, output.out, overwrite=output.overwrite)
        messages.wrote(output.out, "bounds.html")
    messages.show("optics_bounds", report, _optics_lines(report))


def _optics_lines(report: Mapping[str, Any]) -> Iterator[RenderableType]:
    yield (
        f"{report['events']} particles of {report['at']['mass_kda']:g} kDa, signal-to-noise ratio "
        f"{short(report['snr'])} each"
    )
    yield listing(
        report["parameters"],
        "optics, all fitted together | value | ± | without images",
        "{parameter} | {value:g} | {sigma:.4g} | ±{usual_error:g}",
    )
    modes = {f"mode {mode}": errors for mode, errors in report["common"].items()}
    names = ("x_nm", "y_nm", "z_nm", "mass_kda")
    yield _named_rows("error common to all fits", modes, dict(zip(names, names, strict=True)))
    focus_nm, percent = report["goals"]["focus_nm"], 100 * report["goals"]["mass_rel"]
    yield listing(
        report["needed"],
        f"particles needed for | focus ±{focus_nm:g} nm | masses ±{percent:g} % | SNR of one",
        "{mass_kda:g} kDa | {focus_nm:,.0f} | {mass_rel:,.0f} | {snr:.4g}",
    )
    yield from (f"unidentifiable: {line}" for line in report["unidentifiable"])


def _paper(messages: Messages, output: Output) -> None:
    """Reproduce a paper."""
    from iscat_analysis.bounds.paper import FIELD_NM, reproduce
    from iscat_analysis.report.bounds import PAPER_FILES, write_paper

    output.check(PAPER_FILES)
    with messages.progress() as progress:
        found = reproduce(progress=progress)
    if output.out is not None:
        write_paper(
            found.curves,
            found.images,
            found.table,
            found.quantum,
            output.out,
            field_nm=FIELD_NM,
            overwrite=output.overwrite,
        )
        messages.wrote(output.out, "comparison.html")
    names = ("printed", "authors", "dong2021", "exact", "reciprocal")
    records = found.table.to_dict("records")
    units = {"nm": " [nm]"}
    rows = {f"{row['quantity']}{units.get(row['unit'], '')}": row for row in records}
    quantum = _named_rows("quantum bound of one photon", rows, dict(zip(names, names, strict=True)))
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
        ends = {
            "best": {"value": best["value"], "bound": best["bound"]},
            "configured": {"value": best["configured"], "bound": best["bound_configured"]},
        }
        columns = {"value": "value", "bound": f"CRB {best['for']}"}
        yield _named_rows(str(best["of"]), ends, columns)
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
    kinds = {kind: name for kind, name in KINDS.items() if kind in values}
    names = dict.fromkeys(name for kind in kinds for name in values[kind])
    rows = {name: {kind: values[kind].get(name) for kind in kinds} for name in names}
    return _named_rows(title, rows, kinds)


def _information(report: Mapping[str, Any]) -> Table:
    rivals = [pair.split("–") for pair in report["incompatible"]]
    rows = []
    for name, share in report["information_fraction"].items():
        alias = name.replace("_kda", "_rel")
        others = [a if b == alias else b for a, b in rivals if alias in (a, b)]
        known = ", ".join(other.replace("_rel", "_kda") for other in others) or "–"
        jointly = report["information_fraction_joint"].get(name)
        rows.append({"name": name, "share": share, "jointly": jointly, "others": known})
    return listing(
        rows,
        "information used | of the light's | jointly, of what can be had | no single "
        "measurement is best for it and",
        "{name} | {share:.1f%} | {jointly:.1f%} | {others}",
        left=(0, 3),
    )


def _detection_table(limit: Mapping[str, Any]) -> Table:
    title = f"detected but for {100 * limit['miss']:g} %, {100 * limit['false_alarm']:g} % false"
    columns = {"threshold_{}": "threshold", "snr_{}": "SNR", "mass_{}_kda": "mass_kda"}
    places = {"place known": "known", "field searched": "searched"}
    rows = {at: {key: limit[key.format(name)] for key in columns} for at, name in places.items()}
    return _named_rows(title, rows, columns)


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
    total = {
        "cause": "all",
        "factor": math.prod(line["factor"] for line in lines),
        "bound": lines[-1]["bound"],
    }
    yield listing(
        [{**lines[0], "factor": None}, *lines[1:], total],
        f"now | factor | σ [{unit}]",
        "{cause} | {factor:.3f} | {bound:.4g}",
    )
    if target["note"]:
        yield target["note"]


def _pupil_lines(found: Mapping[str, Any]) -> Iterator[RenderableType]:
    """Print the settings of a pupil, what they give, and how near that comes to the bound."""
    ends = {"configured": "configured", "best": "best"}
    settings = {name: row for name, row in found["settings"].items() if any(row.values())}
    yield _named_rows("pupil", settings, ends)
    kinds = ends | {"holevo": "Holevo", "qcrb": "QCRB"}
    yield _named_rows("σ, all estimated together", found["sigma"], kinds)
    labels = ends | {"quiet": "best, background known and no read noise"}
    yield listing(
        [{"label": label, "share": found["share"].get(key)} for key, label in labels.items()],
        "of what one measurement can take | share",
        "{label} | {share:.1f%}",
    )
    yield (
        f"{short(found['photons_per_pixel'])} e per pixel and frame in the background, "
        f"{short(found['peak_e'])} e in the brightest pixel; "
        f"{found['near']} of {len(found['descents'])} descents end within 1 % of the best"
    )


def _named_rows(
    title: str, rows: Mapping[str, Mapping[str, Any]], columns: Mapping[str, str]
) -> Table:
    """Tabulate numbers: a row for each name, a column for each key."""
    written = ((name, *(short(row.get(key)) for key in columns)) for name, row in rows.items())
    return table(title, *columns.values(), rows=written)
