"""Landing movies: speed of the whole job, of the sliding ratio beside PiSCAT's, peak memory.

    python benchmarks/landing.py [--quick] [--peer PYTHON] [--skip-peer] [--seed N]

The whole job is ``iscat fit`` on a TIFF of 256 × 256 × 4 000 frames with 300 landings and 60
leavings, report included, in a process of its own: megabytes of input per second, of the clock and
of processors, and peak memory.  A movie of half as many frames and particles tells the part that
grows with the movie from the part that does not.
The sliding ratio is everything up to the contrast after over before: ours at every boundary of a
quarter of a window, PiSCAT's differential rolling average at every frame, as each needs it to find
particles; both on the same frames in memory, 100 frames before and after, best of several.
PiSCAT lives in an environment of its own under ``benchmarks/results``, made on the first run;
``--peer`` names a Python that has it.  With ``--skip-peer`` the same algorithm is run from this
file: running sums of two batches, a frame in and one out.
Exit status 1 where a promise is broken; ``--quick`` takes a small movie and judges nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from _memory import Memory
from _peer import peer_python

from iscat_analysis._kernels.sliding import contrast_map
from iscat_analysis.camera import Camera
from iscat_analysis.config import load_config
from iscat_analysis.fitting.context import make_context
from iscat_analysis.search.frames import make_chunk, measure_frames
from iscat_analysis.search.sliding import make_filter, sliding_maps
from iscat_analysis.study import write_stack

ROOT = Path(__file__).resolve().parent
RESULTS = ROOT / "results"
CONFIG = ROOT.parent / "sample_configs" / "landing.toml"
JOB_MB_PER_S, GROWTH_MB_PER_S, RATIO, MEMORY_MB = 90.0, 300.0, 5.0, 1000.0
WINDOW = 100
PROGRAM = "import sys; sys.argv[0] = 'iscat'; from iscat_cli import main; sys.exit(main())"
INSTALLED = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
"""The environment of a job: Python keeps the modules that it has compiled, as an installer does."""
PEER_PACKAGES = ("piscat==0.2.5", "PyWavelets")

PEER = """
import sys, time, json, warnings
warnings.simplefilter("ignore")
import numpy as np
from piscat.BackgroundCorrection.DRA import DifferentialRollingAverage
frames, side, window = map(int, sys.argv[1:4])
video = np.random.default_rng(0).poisson(25000, (frames, side, side)).astype(float)
seconds = []
for _ in range(3):
    start = time.perf_counter()
    DifferentialRollingAverage(video=video, batchSize=window).differential_rolling()
    seconds.append(time.perf_counter() - start)
print(json.dumps(seconds))
"""


def whole_job(folder: Path, settings: list[str], seed: int) -> dict[str, float]:
    """Simulate a movie, fit it in another process and time that."""
    movie = folder / "movie.tif"
    config = load_config(CONFIG, settings)
    truth = write_stack(config, movie, seed=seed, overwrite=True)
    command = [sys.executable, "-c", PROGRAM, "fit", str(movie), "--config", str(CONFIG)]
    command += ["--quiet", "--json", "--out", str(folder / "movie.iscat"), "--overwrite"]
    size = movie.stat().st_size / 1e6
    answer = folder / "answer.json"

    def run(*, watched: bool) -> tuple[float, float, float]:
        start = time.perf_counter()
        with answer.open("w", encoding="utf-8") as out:
            job = subprocess.Popen(command, stdout=out, env=INSTALLED)
            watch = Memory(job.pid, movie)
            if watched:
                watch.start()
            _, status, usage = os.wait4(job.pid, 0)
        if status:
            raise SystemExit(f"{' '.join(command)} did not finish")
        return time.perf_counter() - start, usage.ru_utime + usage.ru_stime, watch.peak_mb

    seconds, processor, _ = zip(*(run(watched=False) for _ in range(3)), strict=True)
    memory = run(watched=True)[2]  # to look takes time
    summary: dict[str, Any] = json.loads(answer.read_text(encoding="utf-8"))
    movie.unlink()
    return {
        "input_mb": size,
        "seconds": min(seconds),
        "processor_seconds": min(processor),
        "mb_per_s": size / min(seconds),
        "analysis_mb_per_s": size / summary["seconds"]["landing"],
        "peak_memory_mb": memory,
        "steps": int(len(truth) + truth["leave"].notna().sum()),
        "found": len(summary["events"]),
    }


def growth(whole: dict[str, float], half: dict[str, float]) -> dict[str, float]:
    """Tell what a longer movie adds: megabytes for each further second."""
    added = whole["input_mb"] - half["input_mb"]
    seconds, processor = (whole[name] - half[name] for name in ("seconds", "processor_seconds"))
    per_mb = seconds / added
    return {
        "mb_per_s": added / seconds,
        "mb_per_processor_s": added / processor,
        "seconds_of_10_gb": whole["seconds"] + (1e4 - whole["input_mb"]) * per_mb,
    }


def rolling_average(video: np.ndarray, window: int) -> None:
    """PiSCAT's differential rolling average, as it is documented and written."""
    video = video.astype(np.float64)
    out = np.empty((len(video) - 2 * window, *video.shape[1:]))
    first = np.empty_like(out)
    before, after = video[:window].sum(axis=0), video[window : 2 * window].sum(axis=0)
    out[0], first[0] = after / window - before / window, before / window
    for i in range(1, len(out)):
        before = before - video[i - 1] + video[window + i - 1]
        after = after - video[window + i - 1] + video[2 * window + i - 1]
        one, two = before / window, after / window
        out[i], first[i] = two - one, one


def sliding_ratio(frames: int, side: int, peer: Path | None) -> dict[str, float | str]:
    """Frames per second of both, in turns."""
    config = load_config(CONFIG, [f"simulation.shape=[{side}, {side}]"])
    template = make_context(config, (side, side), sliding=True).templates.images[0]
    counts = np.random.default_rng(0).poisson(25000, (frames, side, side)).astype(np.uint16)
    camera = Camera(gain_e_per_adu=4.0)
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:

        def ours() -> Any:
            light, repeats = measure_frames(counts, camera, mapper=pool.map)
            return make_chunk(
                0, counts, ~repeats, light, camera,
                stride=WINDOW // 4, mapper=pool.map,
            )  # fmt: skip

        def ratio_only() -> None:
            chunk = ours()
            weight = np.ones((side, side), dtype=np.float32)

            def one(k: int) -> None:
                before, after = chunk.blocks_e[max(k - 4, 0) : k], chunk.blocks_e[k : k + 4]
                contrast_map(before, after, weight)

            list(pool.map(one, range(1, len(chunk.blocks_e))))

        def matched() -> None:
            chunk = ours()
            sliding_maps(chunk, make_filter(chunk, template), 4, mapper=pool.map)

        ratio_only()
        matched()
        ratio = [_seconds(ratio_only) for _ in range(3)]
        if peer:
            command = [str(peer), "-c", PEER, str(frames), str(side), str(WINDOW)]
            environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
            done = subprocess.run(
                command, check=True, capture_output=True, text=True, env=environment
            )
            theirs = json.loads(done.stdout.strip().splitlines()[-1])
        else:
            theirs = [_seconds(lambda: rolling_average(counts, WINDOW)) for _ in range(3)]
        ratio += [_seconds(ratio_only) for _ in range(3)]
        search = [_seconds(matched) for _ in range(3)]
    return {
        "baseline": "PiSCAT" if peer else "PiSCAT's algorithm",
        "ours_frames_per_s": frames / min(ratio),
        "ours_with_matched_filter_frames_per_s": frames / min(search),
        "baseline_frames_per_s": frames / min(theirs),
        "times_faster": min(theirs) / min(ratio),
    }


def _seconds(job: Callable[[], Any]) -> float:
    start = time.perf_counter()
    job()
    return time.perf_counter() - start


def main() -> int:
    parser = argparse.ArgumentParser(description="Landing movies: speed and memory.")
    parser.add_argument("--quick", action="store_true", help="a small movie, no judgement")
    parser.add_argument("--peer", type=Path, help="a Python that has PiSCAT")
    parser.add_argument("--skip-peer", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    peer = None if options.skip_peer else options.peer or peer_python("piscat", *PEER_PACKAGES)
    field = "simulation.shape=[256, 256]"
    sizes = [
        [field, f"simulation.frames={n}", f"simulation.count={n * 3 // 40}",
         f"simulation.leavings={n * 3 // 200}"]
        for n in (4000, 2000)
    ]  # fmt: skip
    numbers: dict[str, Any] = {
        "sliding_ratio": sliding_ratio(300 if options.quick else 600, 256, peer)
    }
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if options.quick:
            numbers["whole_job"] = whole_job(folder, [], options.seed)
        else:
            whole, half = (whole_job(folder, settings, options.seed) for settings in sizes)
            numbers |= {"whole_job": whole, "half_job": half, "growth": growth(whole, half)}
    print(json.dumps(numbers, indent=2))
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "landing.json").write_text(json.dumps(numbers, indent=2) + "\n", encoding="utf-8")
    if options.quick:
        return 0
    job, more, ratio = (numbers[name] for name in ("whole_job", "growth", "sliding_ratio"))
    promises = {
        f"whole job at least {JOB_MB_PER_S:g} MB/s": job["mb_per_s"] >= JOB_MB_PER_S,
        f"what grows at least {GROWTH_MB_PER_S:g} MB/s": more["mb_per_s"] >= GROWTH_MB_PER_S,
        f"peak memory at most {MEMORY_MB:g} MB": job["peak_memory_mb"] <= MEMORY_MB,
        f"sliding ratio at least {RATIO:g} times the baseline": ratio["times_faster"] >= RATIO,
    }
    for text, kept in promises.items():
        print(("ok      " if kept else "BROKEN  ") + text)
    return 0 if all(promises.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
