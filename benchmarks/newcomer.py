"""Five lines of a new user beside the full configuration, on ten movies of different microscopes.

    python benchmarks/newcomer.py [--quick] [--bright 4,8,16] [NAME…]
    python benchmarks/newcomer.py --focus [--never]

A new user says pixel size, wavelength and NA, and nothing else::

    import iscat_analysis as ia
    known = {"camera.pixel_size_nm": 84.0, "optics.wavelength_nm": 525.0, "optics.na": 1.42}
    result = ia.fit_movie("movie.tif", settings=known)
    print(result.table)
    print(result.summary["distribution"])

The full configuration has what the movie was simulated with: camera, focus, phase, contrast per
kDa.  Movies of 128 × 128 × 700 frames with 36 landings of 160 and 480 kDa on a speckled field
differ in format, counts, scale, noise, focus and polarity.  A landing counts as found where the
table has one within 2 pixels and a quarter window.  Without standards there are no masses: pulls
and species are of contrasts, pulls over rows that are ok and were found.
With ``--bright`` so many of the landings are of 480 kDa, and the others of 66 kDa, too dim to learn
from.  ``--focus`` moves the focus instead, with 1, 2, 4 or 8 such particles, or 5 dim ones alone:
how many of the found landings are ok, how far contrasts are from the truth together, by the errors
of the rows and with the stated common error, and the focus that was learned.  With ``--never`` none
is learned, and rows of movies out of focus must fail.

Status 1 where a new user finds less than 95 % of what the full configuration finds, has a species
that is off by more than 3 %, or pulls that are wider by a fifth.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import tifffile

import iscat_analysis as ia

RESULTS = Path(__file__).resolve().parent / "results"
SIDE, FRAMES, SPECIES = 128, 700, (160.0, 480.0)
BRIGHT, DIM = 480.0, 66.0
OFF_NM, FEW = (0.0, 100.0, -100.0, -60.0, 150.0), (0, 1, 2, 4, 8)
NEAR_PX = 2.0
RECALL, MASS, PULLS = 0.95, 0.03, 1.2

Save = Callable[[Path, np.ndarray], Path]


def tiff(path: Path, counts: np.ndarray) -> Path:
    """Write a plain TIFF stack."""
    path = path.with_suffix(".tif")
    tifffile.imwrite(path, counts, photometric="minisblack", metadata={"axes": "TYX"})
    return path


def ome(path: Path, counts: np.ndarray) -> Path:
    """Write an OME-TIFF with the times of its frames."""
    path = path.with_suffix(".ome.tif")
    said = {"axes": "TYX", "TimeIncrement": 5.0, "TimeIncrementUnit": "ms"}
    tifffile.imwrite(path, counts, photometric="minisblack", ome=True, metadata=said)
    return path


def padded(path: Path, counts: np.ndarray) -> Path:
    """Write twelve bits in the high bits of sixteen."""
    return tiff(path, (counts << 4).astype(np.uint16))


def signed(path: Path, counts: np.ndarray) -> Path:
    """Write signed numbers as ImageJ keeps them: plus 32768, and a line that takes it off."""
    path = path.with_suffix(".tif")
    text = (
        f"ImageJ=1.53t\nimages={len(counts)}\nframes={len(counts)}\nhyperstack=true\n"
        "mode=grayscale\ncf=0\nc0=-32768.0\nc1=1.0\nvunit=gray value\nloop=false\n"
    )
    with tifffile.TiffWriter(path) as writer:
        for number, frame in enumerate(counts + np.uint16(32768)):
            writer.write(
                frame, contiguous=True, photometric="minisblack", metadata=None,
                description=text if number == 0 else None,
            )  # fmt: skip
    return path


def array(path: Path, counts: np.ndarray) -> Path:
    """Write an array as NumPy saves it."""
    np.save(path.with_suffix(".npy"), counts)
    return path.with_suffix(".npy")


def pylablib(path: Path, counts: np.ndarray) -> Path:
    """Write plain numbers with settings beside them."""
    counts.astype("<u2").tofile(path.with_suffix(".bin"))
    rows, columns = counts.shape[1:]
    path.with_name(f"{path.stem}_settings.dat").write_text(
        "cam/frame_timings\t(4.0E-03, 5.0E-03)\nsave/append\tFalse\nsave/format\traw\n"
        f"save/saved\t{len(counts)}\nsave/frame/shape\t({rows}, {columns})\n"
        "save/frame/dtype\t<u2\n"
    )
    return path.with_suffix(".bin")


def stamped(path: Path, counts: np.ndarray) -> Path:
    """Write a TIFF with a counter burnt into a corner."""
    counts = counts.copy()
    digits = np.random.default_rng(0).random((10, 7, 5)) < 0.6
    for frame, image in enumerate(counts):
        for place, digit in enumerate(f"{frame:05d}"):
            image[3:10, 4 + 7 * place : 9 + 7 * place][digits[int(digit)]] = 60000
    return tiff(path, counts)


@dataclass(frozen=True)
class Case:
    """A microscope, and how its movie was saved."""

    name: str
    save: Save = tiff
    photons: float = 1e5
    truth: dict[str, Any] = field(default_factory=dict)


CASES = (
    Case("plain", truth={"camera.gain_e_per_adu": 4.0}),
    Case("ome", ome, truth={"camera.gain_e_per_adu": 2.7}),
    Case("padded", padded, truth={"camera.gain_e_per_adu": 40.0}),
    Case("signed", signed, truth={"camera.gain_e_per_adu": 5.0}),
    Case("array", array, truth={"camera.gain_e_per_adu": 30.0, "camera.offset_adu": 200.0}),
    Case("pylablib", pylablib, truth={"camera.gain_e_per_adu": 3.1}),
    Case("stamped", stamped, truth={"camera.gain_e_per_adu": 4.0}),
    Case(
        "noisy", photons=4e4,
        truth={
            "camera.gain_e_per_adu": 1.0, "camera.offset_adu": 100.0, "camera.read_noise_e": 12.0,
        },
    ),
    Case("focus", truth={"camera.gain_e_per_adu": 4.0, "optics.focus_nm": -420.0}),
    Case(
        "bright",
        truth={
            "camera.gain_e_per_adu": 4.0, "optics.reference_phase_deg": 180.0,
            "calibration.gradient_per_kda": 3.1e-5,
            "optics.wavelength_nm": 445.0, "camera.pixel_size_nm": 66.0,
        },
    ),
)  # fmt: skip
KNOWN = {"camera.pixel_size_nm": 84.0, "optics.wavelength_nm": 525.0, "optics.na": 1.42}


def full(case: Case) -> dict[str, Any]:
    """Give everything that there is to know of a case."""
    camera = {"camera.offset_adu": 0.0, "camera.read_noise_e": 0.0}
    return {
        **KNOWN, **camera, "optics.focus_nm": -300.0, "optics.calibrate": "never",
        "calibration.gradient_per_kda": -3.1e-5, **case.truth,
    }  # fmt: skip


def simulate(
    case: Case, folder: Path, seed: int, bright: int | None = None, number: int = 36
) -> tuple[Path, pd.DataFrame]:
    """Write a movie; give its path and its truth."""
    rng = np.random.default_rng(seed)
    places = [
        (14 + 20 * (k % 6) + rng.uniform(-4, 4), 14 + 20 * (k // 6) + rng.uniform(-4, 4))
        for k in range(36)
    ]
    if bright is not None:
        rng.shuffle(places)
    masses = [
        SPECIES[k % 2] if bright is None else BRIGHT if k < bright else DIM for k in range(number)
    ]
    frames = rng.permutation(np.linspace(60, FRAMES - 60, number).astype(int))
    events = [
        {"frame": int(frame), "x_px": float(x), "y_px": float(y), "mass_kda": mass}
        for frame, (x, y), mass in zip(frames, places[:number], masses, strict=True)
    ]
    simulation = {
        "simulation.shape": [SIDE, SIDE], "simulation.frames": FRAMES,
        "simulation.photons_per_pixel": case.photons, "simulation.background": "speckle",
        "simulation.power_noise": 0.01, "simulation.events": events,
    }  # fmt: skip
    raw = folder / f"{case.name}_raw.tif"
    ia.simulate_movie({**full(case), **simulation}, str(raw), seed=seed)
    path = case.save(folder / case.name, tifffile.imread(raw))
    truth = pd.read_csv(raw.with_suffix(".truth.csv"))
    raw.unlink()
    raw.with_suffix(".truth.csv").unlink()
    return path, truth


def measured(result: Any, truth: pd.DataFrame) -> dict[str, Any]:
    """Set what was found against the truth."""
    table = result.table[result.table["status"] != "sidelobe"]
    pairs = paired(result, truth)
    found = len(pairs)
    pulls = [
        (row["contrast"] - step["contrast"]) / sigma_of(row)
        for row, step in pairs
        if row["status"] == "ok"
    ]
    distribution = result.summary.get("distribution") or {"species": []}
    scale = 1e3 * float(np.median(np.abs(table["contrast"] / table["mass_kda"])))
    species = [scale * one["mass_kda"] for one in distribution["species"] if not one["outlier"]]
    return {
        "recall": found / len(truth),
        "false": len(table) - found,
        "ok": len(pulls),
        "pull_mean": float(np.mean(pulls)) if pulls else None,
        "pull_std": float(np.std(pulls, ddof=1)) if len(pulls) > 1 else None,
        "species": [round(contrast, 3) for contrast in species],
        "gain": result.summary["camera"]["gain_e_per_adu"]["value"],
        "warnings": list(result.warnings),
    }


def paired(result: Any, truth: pd.DataFrame) -> list[tuple[pd.Series, pd.Series]]:
    """Give the row of every landing that was found."""
    table = result.table[result.table["status"] != "sidelobe"]
    window = result.summary["landing"]["window_frames"]
    pairs, used = [], set()
    for _, step in truth.iterrows():
        near = np.hypot(table["x_px"] - step["x_px"], table["y_px"] - step["y_px"]) < NEAR_PX
        near &= (table["frame"] - step["frame"]).abs() <= max(window // 4, 3)
        rows = table[near & ~table.index.isin(used)]
        if len(rows):
            used.add(rows.iloc[0].name)
            pairs.append((rows.iloc[0], step))
    return pairs


def sigma_of(row: pd.Series) -> float:
    """Give the standard error of a contrast."""
    return abs(float(row["contrast"] * row["sigma_mass_kda"] / row["mass_kda"]))


def out_of_focus(seed: int, *, never: bool) -> bool:
    """Print what becomes of few particles out of focus; tell whether all is well."""
    well = True
    print("off [nm]  bright   ok   contrasts       common error   pull   focus [nm]", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for number, (off, bright) in enumerate((o, b) for o in OFF_NM for b in FEW):
            truth = {"camera.gain_e_per_adu": 4.0, "optics.focus_nm": -300.0 + off}
            case = Case("focus", truth=truth)
            landings = max(bright + 6, 5) if bright else 5
            path, steps = simulate(case, Path(folder), seed + number, bright, landings)
            settings = {**KNOWN, "optics.calibrate": "never" if never else "auto"}
            result = ia.fit_movie(path, settings=settings)
            pairs = paired(result, steps)
            share = np.array([row["contrast"] / step["contrast"] - 1 for row, step in pairs])
            error = np.array([sigma_of(r) / abs(step["contrast"]) for r, step in pairs])
            weight = error**-2.0 / np.sum(error**-2.0)
            mean, own = float(weight @ share), float(np.sum(error**-2.0)) ** -0.5
            common = 0.0
            if "systematic_contrast" in result.table:
                stated = [abs(r["systematic_contrast"] / r["contrast"]) for r, _ in pairs]
                common = float(np.median(stated))
            ok = sum(row["status"] == "ok" for row, _ in pairs)
            pull = mean / np.hypot(own, common)
            optics = result.summary.get("optics", {})
            rows = {row["parameter"]: row for row in optics.get("parameters", [])}
            focus = rows.get("focus_nm") if optics.get("calibrated") else None
            learned = "–" if focus is None else f"{focus['value']:.1f} ± {focus['sigma']:.1f}"
            well &= ok >= 0.9 * len(pairs) and abs(pull) < 4
            print(
                f"{off:+8.0f}{bright:8d}{ok:4d}/{len(pairs)} {mean:+8.1%} ± {own:5.1%}"
                f"{common:11.1%}{pull:+11.1f}   {learned}",
                flush=True,
            )
            path.unlink()
    return well


def kept(new: dict[str, Any], whole: dict[str, Any]) -> bool:
    """Tell whether a new user gets what the full configuration gives."""
    near = all(
        any(abs(mass / one - 1) < MASS for mass in new["species"]) for one in whole["species"]
    )
    found = new["recall"] >= RECALL * whole["recall"]
    told = new["pull_std"] is not None and whole["pull_std"] is not None
    return found and near and told and new["pull_std"] < PULLS * whole["pull_std"]


def main() -> int:
    parser = argparse.ArgumentParser(description="A new user beside the full configuration.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(c.name for c in CASES))
    parser.add_argument("--quick", action="store_true", help="two of the movies")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--bright", default="", help="how many are bright, as 4,8,16")
    parser.add_argument("--focus", action="store_true", help="few particles out of focus")
    parser.add_argument("--never", action="store_true", help="the same, and nothing is learned")
    options = parser.parse_args()
    if options.focus:
        return 0 if out_of_focus(options.seed, never=options.never) else 1
    names = options.names or [case.name for case in (CASES[:2] if options.quick else CASES)]
    told, broken = {}, []
    print(
        "movie        found        ok      pulls              species [contrast, 1e-3]", flush=True
    )
    several = [int(text) for text in options.bright.split(",") if text] or [None]
    with tempfile.TemporaryDirectory() as folder:
        for (number, case), bright in product(enumerate(CASES), several):
            if case.name not in names:
                continue
            name = case.name if bright is None else f"{case.name}{bright}"
            path, truth = simulate(case, Path(folder), options.seed + number, bright)
            new = {**KNOWN, **{key: case.truth[key] for key in KNOWN if key in case.truth}}
            both = {}
            for who, settings in (("full", full(case)), ("new", new)):
                if case.name == "padded" and who == "full":
                    settings = {**settings, "camera.gain_e_per_adu": 40.0 / 16}
                if case.name == "signed" and who == "full":
                    settings = {**settings, "camera.offset_adu": 32768.0}
                both[who] = one = measured(ia.fit_movie(path, settings=settings), truth)
                print(
                    f"{name:11}{who:5}{one['recall']:5.0%} +{one['false']:<3}{one['ok']:5d}"
                    f"   {one['pull_mean'] or 0:+.2f} ± {one['pull_std'] or 0:.2f}   "
                    f"{', '.join(f'{mass:g}' for mass in one['species'])}",
                    flush=True,
                )
            told[name] = both
            path.unlink()
            if not kept(both["new"], both["full"]):
                broken.append(name)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"newcomer{'_bright' if options.bright else ''}.json").write_text(
        json.dumps(told, indent=1)
    )
    if broken:
        print(f"a new user gets less: {', '.join(broken)}", file=sys.stderr)
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
