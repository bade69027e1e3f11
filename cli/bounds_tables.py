"""What `iscat bounds` prints: tables of bounds, scans, optima and efforts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from iscat_cli.console import print_result, short, table

if TYPE_CHECKING:
    from rich.table import Table

KINDS = {
    "crb_single": "CRB single",
    "crb_joint": "CRB joint",
    "holevo": "Holevo",
    "qcrb": "QCRB",
    "qcrb_dong2021": "QCRB (Dong 2021)",
}


def print_bounds(report: Mapping[str, Any]) -> None:
    """Print what `iscat bounds` found, which `--json` prints whole."""
    photons = report["n_scattered"]
    print_result(
        f"scattered photons: {short(photons['camera'])} on the camera, "
        f"{short(photons['collected'])} collected"
    )
    if "scan" in report:
        print_result(_scan_table(report["scan"], report["at"]["free"]))
    elif "optimum" in report:
        print_result(_optimum_table(report["optimum"]))
        print_result(report["optimum"]["note"])
    elif "pupil" in report:
        from iscat_cli.pupil import print_pupil

        print_pupil(report["pupil"])
    elif "target" in report:
        print_result(_effort_table(report["target"]))
        print_result(_budget_table(report["target"]))
        if report["target"]["note"]:
            print_result(report["target"]["note"])
    else:
        print_result(_bounds_table("per photon", report["per_photon"]))
        at_once = {name: report["holevo"][name] for name in report["at"]["free"]}
        print_result(_bounds_table("for these photons", {**report["actual"], "holevo": at_once}))
        print_result(_information(report))
        if "rod" in report:
            print_result(_bounds_table("direction of the rod unknown", report["rod"]))
        if "detection" in report:
            print_result(_detection_table(report["detection"]))
    for line in (*report["unidentifiable"], *report.get("rod", {}).get("unidentifiable", ())):
        print_result(f"unidentifiable: {line}")


def _bounds_table(title: str, values: Mapping[str, Mapping[str, Any]]) -> Table:
    """Tabulate bounds: one row per parameter, one column per kind."""
    kinds = [kind for kind in KINDS if kind in values]
    found = table(title, *(KINDS[kind] for kind in kinds))
    for name in dict.fromkeys(name for kind in kinds for name in values[kind]):
        found.add_row(name, *(short(values[kind].get(name)) for kind in kinds))
    return found


def _information(report: Mapping[str, Any]) -> Table:
    found = table("information used", "of the light's", "jointly, of what can be had")
    found.add_column("no single measurement is best for it and", no_wrap=True)
    rivals = [pair.split("–") for pair in report["incompatible"]]
    for name, share in report["information_fraction"].items():
        alias = name.replace("_kda", "_rel")
        others = [a if b == alias else b for a, b in rivals if alias in (a, b)]
        found.add_row(
            name,
            *(_percent(value) for value in (share, report["information_fraction_joint"].get(name))),
            ", ".join(other.replace("_rel", "_kda") for other in others) or "–",
        )
    return found


def _percent(share: float | None) -> str:
    return "–" if share is None or not math.isfinite(share) else f"{100 * share:.1f} %"


def _detection_table(limit: Mapping[str, Any]) -> Table:
    found = table(
        f"detected but for {100 * limit['miss']:g} %, {100 * limit['false_alarm']:g} % false",
        "threshold",
        "SNR",
        "mass_kda",
    )
    for label, name in (("place known", "known"), ("field searched", "searched")):
        found.add_row(
            label,
            short(limit[f"threshold_{name}"]),
            short(limit[f"snr_{name}"]),
            short(limit[f"mass_{name}_kda"]),
        )
    return found


def _scan_table(scanned: Mapping[str, Any], free: list[str]) -> Table:
    kinds = [(f"crb_joint_{name}", f"qcrb_{name}") for name in free]
    found = table(scanned["label"], *(h for name in free for h in (f"CRB {name}", "QCRB")))
    columns = scanned["columns"]
    for i, value in enumerate(columns[scanned["name"]]):
        found.add_row(f"{value:g}", *(short(columns[key][i]) for pair in kinds for key in pair))
    return found


def _optimum_table(best: Mapping[str, Any]) -> Table:
    found = table(str(best["of"]), "value", f"CRB {best['for']}")
    found.add_row("best", short(best["value"]), short(best["bound"]))
    found.add_row("configured", short(best["configured"]), short(best["bound_configured"]))
    return found


def _unit(target: Mapping[str, Any]) -> str:
    return str(target["parameter"]).split("_")[1].replace("kda", "kDa")


def _effort_table(target: Mapping[str, Any]) -> Table:
    title = f"{target['value']:g} {_unit(target)} takes, with the background"
    found = table(title, "frames before", "frames after", "seconds", "collected photons")
    for entry in target["effort"]:
        before = f"{entry['n_before']:,.0f}".replace(",", " ")
        if math.isfinite(entry["n_after"]):
            after = f"{entry['n_after']:,.0f}".replace(",", " ")
            times = short(entry["seconds"]), short(entry["collected"])
        else:
            after, times = "never enough", ("–", "–")
        found.add_row(entry["background"], before, after, *times)
    return found


def _budget_table(target: Mapping[str, Any]) -> Table:
    found = table("now", "factor", f"σ [{_unit(target)}]")
    for number, line in enumerate(target["budget"]):
        found.add_row(
            line["cause"], f"{line['factor']:.3f}" if number else "", short(line["bound"])
        )
    product = math.prod(line["factor"] for line in target["budget"])
    found.add_row("all", f"{product:.3f}", short(target["budget"][-1]["bound"]))
    return found
