"""How long users wait before anything happens: help, small movies, the first run of all, the page.

    python benchmarks/start.py [--quick] [--seed N]

``iscat --help``, and ``iscat-fit`` on movies of 64 × 64 × 60 to 120 frames with a particle or two
in the modes mass, joint, landing (sliding windows) and track: the first run with an empty folder of
compiled kernels, then the best of three that find them.  Seconds of the clock stand beside seconds
of processors, all processes together, because others may use the machine as well.

The page is the report of a landing movie, its rows and images repeated to 5000 events: its size and
seconds in headless Chromium from the request until the first paint, until it is loaded and drawn;
and how long it takes to show all rows to whoever scrolls to the end of the first 200.

Exit status 1 where a promise is broken; ``--quick`` leaves out the first runs and judges nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.config import load_config
from iscat_analysis.pipeline import fit_stack
from iscat_analysis.report import render_report
from iscat_analysis.study import write_stack

ROOT = Path(__file__).resolve().parent
RESULTS = ROOT / "results"
CONFIGS = ROOT.parent / "sample_configs"
HELP_S, WARM_S, FIRST_S, PAGE_S, PAGE_MB = 0.3, 3.0, 60.0, 2.0, 5.0
EVENTS = 5000
SMALL = ("simulation.shape=[64, 64]", "posterior.enabled=false")
BOUND = (
    "simulation.frames=60",
    "simulation.events=[{frame=30, x_px=31.3, y_px=30.8, mass_kda=2000.0}]",
    "background.frames=[0, 30]",
    "fit.frames=[30, 60]",
)
MOVIES: dict[str, tuple[str, tuple[str, ...]]] = {
    "mass": ("mass", BOUND),
    "joint": ("joint", BOUND),
    "landing": (
        "landing",
        ("simulation.frames=120", "simulation.count=2", "simulation.leavings=0"),
    ),
    "track": (
        "landing",
        (
            "simulation.frames=60", "simulation.count=0", "simulation.leavings=0",
            "simulation.movers=[{count=1, mass_kda=900.0, d_um2_s=0.15}]",
            "camera.frame_rate_hz=331.0", "fit.mode=track", "track.free=mass",
        ),
    ),
}  # fmt: skip
"""Sample configuration and what is changed of it."""

PROGRAM = "import sys; sys.argv[0] = 'iscat'; from iscat_cli import main; sys.exit(main())"

DRAWN = """
const done = arguments[0];
const next = (then) => requestAnimationFrame(() => requestAnimationFrame(then));
next(() => {
  const load = performance.getEntriesByType("navigation")[0];
  const paint = performance.getEntriesByType("paint")[0];
  const drawn = performance.now();
  document.getElementById("row-199").scrollIntoView();
  const whole = () => {
    if (document.getElementById("table").classList.contains("late")) return next(whole);
    next(() => done(
      [paint.startTime, load.loadEventEnd, drawn, performance.now() - drawn].map((t) => t / 1000)
    ));
  };
  next(whole);
});
"""
"""Seconds from the request to the first paint, until all is loaded and drawn, and for all rows."""


def run(*arguments: str, kernels: Path | None = None) -> tuple[float, float]:
    """Seconds of the clock and of processors that a command takes."""
    environment = {**os.environ, **({"NUMBA_CACHE_DIR": str(kernels)} if kernels else {})}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # an installation has its modules compiled
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(
        [sys.executable, "-c", PROGRAM, *arguments],
        check=True, env=environment, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    seconds = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return seconds, sum(after[:2]) - sum(before[:2])


def best(times: list[tuple[float, float]]) -> dict[str, float]:
    """Give the shortest of several runs."""
    seconds, processor = min(times)
    return {"seconds": seconds, "processor_seconds": processor}


def small_movies(folder: Path, *, first: bool, seed: int) -> dict[str, Any]:
    """Analyse each small movie, with an empty folder of kernels and with what is then in it."""
    numbers: dict[str, Any] = {}
    for name, (sample, changes) in MOVIES.items():
        path = CONFIGS / f"{sample}.toml"
        settings = [*SMALL, *changes]
        movie = folder / f"{name}.tif"
        write_stack(load_config(path, settings), movie, seed=seed)
        options = [f"--set={setting}" for setting in settings]
        command = ["fit", str(movie), "--config", str(path), *options, "--quiet", "--overwrite"]
        kernels = folder / f"kernels-{name}" if first else None
        numbers[name] = {"first": best([run(*command, kernels=kernels)])} if first else {}
        run(*command, kernels=kernels)
        numbers[name]["warm"] = best([run(*command, kernels=kernels) for _ in range(3)])
    return numbers


def page(folder: Path, seed: int) -> dict[str, float]:
    """Size of the report of many events, and how long a browser takes for it."""
    movie = folder / "events.tif"
    config = load_config(CONFIGS / "landing.toml", [])
    write_stack(config, movie, seed=seed)
    few = fit_stack(movie, config, out=folder / "events.iscat")
    copies = -(-EVENTS // len(few.table))
    rows = pd.concat([few.table] * copies, ignore_index=True)[:EVENTS]
    many = replace(
        few,
        table=rows.assign(event=np.arange(EVENTS)),
        views=tuple(replace(few.views[i % len(few.views)], event=i) for i in range(1000)),
    )
    written = folder / "report.html"
    written.write_text(render_report(many), encoding="utf-8")
    numbers = {"events": float(EVENTS), "mb": written.stat().st_size / 1e6}
    browser, driver = (
        next((found for name in names if (found := shutil.which(name))), None)
        for names in (("chromium", "chromium-browser", "google-chrome"), ("chromedriver",))
    )
    if browser and driver:
        times = [opened(written, browser, driver, folder / str(k)) for k in range(3)]
        names = ("painted_seconds", "loaded_seconds", "drawn_seconds", "all_rows_seconds")
        numbers |= dict(zip(names, map(min, zip(*times, strict=True)), strict=True))
    return numbers


def opened(written: Path, browser: str, driver: str, profile: Path) -> list[float]:
    """Open the page in a browser that was just started; what `DRAWN` gives."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = browser
    for argument in (
        "--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run",
        "--disable-background-networking", "--disable-dev-shm-usage",
        "--window-size=1400,2000", f"--user-data-dir={profile}",
    ):  # fmt: skip
        options.add_argument(argument)
    window = webdriver.Chrome(options=options, service=Service(driver))
    try:
        window.get(written.as_uri())
        times: list[float] = window.execute_async_script(DRAWN)
    finally:
        window.quit()
    return times


def main() -> int:
    parser = argparse.ArgumentParser(description="Start, first run and page.")
    parser.add_argument("--quick", action="store_true", help="no first runs, no judgement")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    numbers: dict[str, Any] = {"help": best([run("--help") for _ in range(6)])}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        numbers["movies"] = small_movies(folder, first=not options.quick, seed=options.seed)
        numbers["page"] = page(folder, options.seed)
    print(json.dumps(numbers, indent=2))
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "start.json").write_text(json.dumps(numbers, indent=2) + "\n", encoding="utf-8")
    if options.quick:
        return 0
    movies, shown = numbers["movies"], numbers["page"]
    promises = {
        f"help in {HELP_S:g} s": numbers["help"]["seconds"] <= HELP_S,
        f"page of {EVENTS} events at most {PAGE_MB:g} MB": shown["mb"] <= PAGE_MB,
    }
    for name, times in movies.items():
        promises[f"{name}: warm run in {WARM_S:g} s"] = times["warm"]["seconds"] <= WARM_S
        promises[f"{name}: first run in {FIRST_S:g} s"] = times["first"]["seconds"] <= FIRST_S
    if "drawn_seconds" in shown:
        promises[f"page drawn in {PAGE_S:g} s"] = shown["drawn_seconds"] <= PAGE_S
    for text, kept in promises.items():
        print(("ok      " if kept else "BROKEN  ") + text)
    return 0 if all(promises.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
