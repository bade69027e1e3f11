"""Large sensors, long movies, crowded fields: how processor time and memory grow, and what limits.

    python benchmarks/scale.py [--quick] [--full] [--fields 128x128,…] [--frames 500,…]
                               [--particles 10,…] [--memory-mb N] [--keep FOLDER] [--set …]
    python benchmarks/scale.py --sensor 2400,4800 [--particles 200] [--memory-mb N] [--keep FOLDER]
                               [--set optics.focus_curvature_nm=100 …]

Each job is ``iscat fit`` in a process of its own, on plain numbers: a block of frames with
particles that land in its first half and leave in its second one, and links to it, so that a movie
of any length takes the room of a block.  Reported are megabytes of input per second of processor
time, the peak memory of all its processes and the seconds of its parts.  Of three series, in
pixels, frames and particles, the slope of processor time is printed, on logarithmic scales: a job
costs what its start costs, a job of the smallest kind, and what grows; the growing part may have a
slope of 1.05 at most.  From all jobs, and the longest one in a quarter of the memory, follow what a
job costs once, per part (a chunk or a tile of one), per megabyte and per event.  More workers are
extrapolated from that: parts are whole, and the process of the command hashes the movie meanwhile.

``--sensor`` analyses two movies of 1200 × 1920 pixels, of as many frames as it is given, and says
what the longer one has more: speed, memory, and what a recording of 46 GB takes by that.  Each
block of 400 frames has 200 particles, or as many as ``--particles`` says.

``--set`` changes the configuration with which all movies are drawn and analysed, as of optics that
change over the field.

Without options, the default takes less than ten minutes on two idle cores; ``--full`` goes to
1200 × 1920 pixels, 100 000 frames and 10 000 particles.  ``--quick`` judges nothing.
Exit status 1 where a slope or the memory breaks its promise.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from _memory import Memory
from scipy.optimize import nnls

from iscat_analysis.config import load_config
from iscat_analysis.fitting.context import AnalysisContext, make_context
from iscat_analysis.optics.forward import PixelGrid

ROOT = Path(__file__).resolve().parent
RESULTS = ROOT / "results"
CONFIG = ROOT.parent / "sample_configs" / "landing.toml"
PROGRAM = "import sys; sys.argv[0] = 'iscat'; from iscat_cli import main; sys.exit(main())"
LARGEST_SLOPE, MOST_MEMORY_MB = 1.05, 1500.0
SENSOR, SENSOR_PARTICLES, RECORDING_FRAMES, LEAST_MB_PER_S = (1200, 1920), 200, 10_000, 250.0
BLOCK, LIGHT_ADU, HALF_PX = 400, 25_000.0, 40
WORKERS = (1, 2, 4, 8, 16, 32, 64, 128)
PER = ("once", "per part", "per MB", "per event")
LONGER = 100  # times the longest movie, in parts of the same size
MASSES_KDA = (66.0, 146.0, 480.0)


@dataclass(frozen=True)
class Job:
    """What is analysed."""

    rows: int
    columns: int
    frames: int
    particles: int
    workers: int = 2

    @property
    def megabytes(self) -> float:
        """Size of the movie."""
        return self.rows * self.columns * self.frames * 2 / 1e6


@dataclass(frozen=True)
class Cost:
    """What it took."""

    job: Job
    processor_s: float
    seconds: float
    peak_memory_mb: float
    parts_s: dict[str, float]
    events: int
    chunks: int
    tiles: int


def write_movie(job: Job, folder: Path, settings: Sequence[str]) -> Path:
    """Write a block of frames, and links to it."""
    rng = np.random.default_rng(1)
    config = load_config(CONFIG, settings)
    context = make_context(config, (job.rows, job.columns), searches=100, sliding=True)
    length = min(BLOCK, job.frames)
    y, x = np.mgrid[: job.rows, : job.columns]
    light = 1 + 0.05 * np.sin(y / 7.3 + np.sin(x / 31)) * np.cos(x / 9.1 + np.sin(y / 23))
    steps = [_particle(job, context, rng, length) for _ in range(job.particles)]
    first = folder / "movie_0000.bin"
    with first.open("wb") as file:
        for frame in range(length):
            mean = light * LIGHT_ADU * (1 + 0.005 * rng.standard_normal())
            for landing, leaving, here, image in steps:
                if landing <= frame < leaving:
                    mean[here] *= 1 + image
            noise = rng.standard_normal(mean.shape, dtype=np.float32)
            file.write(np.rint(mean + np.sqrt(mean / 4) * noise).astype("<u2").tobytes())
    parts = max(1, job.frames // length)
    for number in range(1, parts):
        folder.joinpath(f"movie_{number:04}.bin").symlink_to(first.name)
    folder.joinpath("movie_settings.dat").write_text(
        f"save/frame/shape\t({job.rows}, {job.columns})\nsave/frame/dtype\t<u2\n"
        f"save/saved\t{parts * length}\n",
        encoding="utf-8",
    )
    return first


def _particle(
    job: Job, context: AnalysisContext, rng: np.random.Generator, length: int
) -> tuple[int, int, tuple[slice, slice], np.ndarray]:
    """Choose when and where a particle is, and draw it."""
    landing = int(rng.integers(length // 8, length // 2 - length // 16))
    leaving = int(rng.integers(length // 2 + length // 16, length - length // 8))
    mass = float(rng.choice(MASSES_KDA))
    places, spans = [], []
    for size in (job.rows, job.columns):
        place = float(rng.uniform(HALF_PX + 2, size - HALF_PX - 3))
        places.append(place)
        spans.append((round(place) - HALF_PX, round(place) + HALF_PX + 1))
    pixel = context.pixel_nm
    grid = PixelGrid.region(spans[0], spans[1], pixel)
    x_nm, y_nm = places[1] * pixel, places[0] * pixel
    image = context.wide_at(x_nm, y_nm).image(grid, x_nm, y_nm, 5.0, mass)
    return landing, leaving, (slice(*spans[0]), slice(*spans[1])), image


def measure(job: Job, folder: Path, memory_mb: int, settings: Sequence[str]) -> Cost:
    """Analyse a movie in a process of its own."""
    with tempfile.TemporaryDirectory(dir=folder) as name:
        movie = write_movie(job, Path(name), settings)
        command = [sys.executable, "-c", PROGRAM, "fit", str(movie), "--config", str(CONFIG)]
        command += ["--quiet", "--json", "--workers", str(job.workers), "--out", f"{name}/out"]
        every = (f"compute.memory_limit_mb={memory_mb}", "optics.calibrate=never", *settings)
        command += [part for setting in every for part in ("--set", setting)]
        answer = Path(name) / "answer.json"
        start = time.perf_counter()
        with answer.open("w", encoding="utf-8") as out:
            process = subprocess.Popen(command, stdout=out)
            watch = Memory(process.pid, movie)
            watch.start()
            _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - start
        if status:
            raise SystemExit(f"{' '.join(command)} did not finish")
        summary: dict[str, Any] = json.loads(answer.read_text(encoding="utf-8"))
    landing = summary["landing"]
    cost = Cost(
        job, usage.ru_utime + usage.ru_stime, seconds, watch.peak_mb,
        summary["seconds"], len(summary["events"]), landing["chunks"], landing["tiles"],
    )  # fmt: skip
    print(
        f"{job.rows:5} × {job.columns:<5} {job.frames:7} frames {job.particles:6} particles "
        f"{job.workers} workers: {job.megabytes / cost.processor_s:7.1f} MB per processor-second, "
        f"{job.megabytes / cost.seconds:7.1f} MB/s of the clock, {cost.peak_memory_mb:6.0f} MB of "
        f"memory, {cost.chunks} × {cost.tiles} parts, {cost.events} events; "
        + ", ".join(f"{part} {s:.1f} s" for part, s in cost.parts_s.items()),
        flush=True,
    )
    return cost


def slope(costs: Sequence[Cost], along: str, start_s: float) -> tuple[float, float]:
    """Slope of the processor time beyond the start on logarithmic scales, and its error.

    Not a number where a job takes no longer than the start: nothing was measured then.
    """
    sizes = {
        "pixels": [c.job.rows * c.job.columns for c in costs],
        "frames": [c.job.frames for c in costs],
        "particles": [c.job.particles for c in costs],
    }[along]
    grown = np.array([c.processor_s - start_s for c in costs])
    if grown.min() <= 0:
        return math.nan, math.nan
    x, y = np.log(sizes) - np.mean(np.log(sizes)), np.log(grown)
    value = float(x @ y / (x @ x))
    rest = y - y.mean() - value * x
    free = len(costs) - 2
    return value, math.sqrt(float(rest @ rest / (x @ x)) / free) if free else math.nan


def amounts(cost: Cost) -> tuple[float, float, float, float]:
    """Count what a job has: itself, its parts, megabytes and events."""
    return 1.0, cost.chunks * cost.tiles, cost.job.megabytes, cost.events


def prices(costs: Sequence[Cost]) -> tuple[np.ndarray, np.ndarray]:
    """Fit what each of these costs, and the standard errors [processor seconds].

    Errors of jobs are taken to be alike relative to what they take.
    """
    weight = 1 / np.array([c.processor_s for c in costs])
    design = np.array([amounts(c) for c in costs]) * weight[:, None]
    found, rest = nnls(design, np.ones(len(costs)))  # none costs less than nothing
    used = found > 0
    free = len(costs) - used.sum()
    errors = np.full(len(found), math.nan)
    if free > 0:
        inverse = np.linalg.inv(design[:, used].T @ design[:, used])
        errors[used] = rest * np.sqrt(np.diag(inverse) / free)
    return found, errors


def efficiency(
    price: np.ndarray, amount: Sequence[float], hash_mb_per_s: float
) -> dict[int, float]:
    """Predict the share of so many workers' time that is spent on work.

    The command does what is done once, by itself.  Workers have whole parts, and the command hashes
    the movie while they work; a single worker is the command itself.
    """
    once, shared = price[0] * amount[0], float(np.dot(price[1:], amount[1:]))
    hashing = amount[2] / hash_mb_per_s
    predicted = {1: 1.0}
    for number in WORKERS[1:]:
        rounds = math.ceil(amount[1] / number) / amount[1]
        elapsed = once + max(rounds * (shared - hashing), hashing)
        predicted[number] = (once + shared) / (number * elapsed)
    return predicted


def sensor(options: argparse.Namespace, folder: Path) -> int:
    """Analyse two movies of a large sensor, and judge what the longer one has more."""
    particles = options.particles[0] if options.particles else SENSOR_PARTICLES
    short, long = (
        measure(Job(*SENSOR, frames, particles), folder, options.memory_mb, options.set)
        for frames in options.sensor
    )
    added = long.job.megabytes - short.job.megabytes
    rate, work = added / (long.seconds - short.seconds), long.processor_s - short.processor_s
    whole = Job(*SENSOR, RECORDING_FRAMES, particles).megabytes
    seconds = long.seconds + (whole - long.job.megabytes) / rate
    print(
        f"what grows: {rate:.0f} MB/s, {added / work:.0f} MB per processor-second, and "
        f"{long.peak_memory_mb - short.peak_memory_mb:+.0f} MB of memory for {added:.0f} MB more; "
        f"{whole / 1e3:.0f} GB take {seconds:.0f} s by that"
    )
    peak = max(short.peak_memory_mb, long.peak_memory_mb)
    return judged(
        {
            f"what grows at least {LEAST_MB_PER_S:g} MB/s": rate >= LEAST_MB_PER_S,
            f"peak memory at most {MOST_MEMORY_MB:g} MB": peak <= MOST_MEMORY_MB,
        }
    )


def judged(promises: dict[str, bool]) -> int:
    """Say which promises are kept, and give the exit status."""
    for text, kept in promises.items():
        print(("ok      " if kept else "BROKEN  ") + text)
    return 0 if all(promises.values()) else 1


def limits(folder: Path) -> dict[str, float]:
    """Measure how fast memory is copied and hashed, and a file read that is in no cache [MB/s]."""
    block = np.zeros(2**27, dtype=np.uint8)
    copy = np.empty_like(block)
    seconds = []
    for _ in range(3):
        start = time.process_time()
        copy[:] = block
        seconds.append(time.process_time() - start)
    start = time.process_time()
    hashlib.sha256(copy).digest()
    hashed = copy.size / 1e6 / (time.process_time() - start)
    path = folder / "disk"
    path.write_bytes(np.random.default_rng(0).bytes(2**28))
    with path.open("rb") as file:
        os.fsync(file.fileno())
        if hasattr(os, "posix_fadvise"):
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        start = time.perf_counter()
        while file.read(2**24):
            pass
        disk = 2**28 / 1e6 / (time.perf_counter() - start)
    path.unlink()
    return {
        "memory_copy_mb_per_s": block.size / 1e6 / min(seconds),
        "disk_mb_per_s": disk,
        "hash_mb_per_s": hashed,
    }


def series(options: argparse.Namespace) -> dict[str, list[Job]]:
    """Choose the jobs: each series changes one thing."""
    fields, frames, particles = options.fields, options.frames, options.particles
    small = fields[0]
    length = 400 if options.quick else 800
    return {
        "pixels": [
            Job(*field, length, max(1, round(10 * field[0] * field[1] / 128**2)))
            for field in fields
        ],
        "frames": [Job(*small, n, 10) for n in frames],
        "particles": [Job(*fields[-1], BLOCK, n) for n in particles],
    }


def _fields(text: str) -> list[tuple[int, int]]:
    sizes = [tuple(int(n) for n in part.split("x")) for part in text.split(",")]
    return [(rows, columns) for rows, columns in sizes]


def _numbers(text: str) -> list[int]:
    return [int(part) for part in text.split(",")]


def main() -> int:
    parser = argparse.ArgumentParser(description="How landing movies scale.")
    parser.add_argument("--quick", action="store_true", help="small movies, no judgement")
    parser.add_argument("--full", action="store_true", help="up to 1200 × 1920 and 100 000 frames")
    parser.add_argument("--fields", type=_fields, help="as 128x128,1200x1920")
    parser.add_argument("--frames", type=_numbers, help="as 500,5000")
    parser.add_argument("--particles", type=_numbers, help="in a block of the largest field")
    parser.add_argument("--sensor", type=_numbers, help="frames of two movies, as 2400,4800")
    parser.add_argument("--memory-mb", type=int, default=1000, help="compute.memory_limit_mb")
    parser.add_argument("--set", action="append", default=[], help="of all movies, as KEY=VALUE")
    parser.add_argument("--keep", type=Path, help="folder for the movies while they are analysed")
    options = parser.parse_args()
    if options.keep is not None:
        options.keep.mkdir(parents=True, exist_ok=True)
    if options.sensor:
        with tempfile.TemporaryDirectory(dir=options.keep) as name:
            return sensor(options, Path(name))
    sizes = {
        "quick": ("128x128,256x256", "400,800", "10,40"),
        "usual": ("128x128,256x256,512x512", "800,3200,12800", "10,100,400"),
        "full": (
            "128x128,256x256,512x512,1024x1024,1200x1920", "400,4000,20000,100000",
            "10,100,1000,10000",
        ),
    }["quick" if options.quick else "full" if options.full else "usual"]  # fmt: skip
    options.fields = options.fields or _fields(sizes[0])
    options.frames = options.frames or _numbers(sizes[1])
    options.particles = options.particles or _numbers(sizes[2])
    with tempfile.TemporaryDirectory(dir=options.keep) as name:
        folder = Path(name)
        bounds = limits(folder)
        small = options.fields[0]
        print("not counted, because it may compile:")
        measure(Job(*small, 2 * BLOCK, 10), folder, options.memory_mb, options.set)
        start = measure(Job(*small, BLOCK, 1), folder, options.memory_mb, options.set)
        found = {
            along: [measure(job, folder, options.memory_mb, options.set) for job in jobs]
            for along, jobs in series(options).items()
        }
        long = found["frames"][-1].job
        single = Job(**{**asdict(long), "workers": 1})
        alone = measure(single, folder, options.memory_mb, options.set)
        divided = measure(long, folder, options.memory_mb // 4, options.set)
    every = [start, *(cost for costs in found.values() for cost in costs), divided]
    slopes = {along: slope(costs, along, start.processor_s) for along, costs in found.items()}
    price, errors = prices(every)
    two = found["frames"][-1]
    of_two = alone.processor_s / two.processor_s
    one, *growing = amounts(divided)
    predicted = {
        times: efficiency(price, (one, *(times * n for n in growing)), bounds["hash_mb_per_s"])
        for times in (1, LONGER)
    }
    rate = max(c.job.megabytes / c.processor_s for c in every)
    for along, (value, error) in slopes.items():
        print(
            f"slope of processor time with {along}: {value:.2f} ± {error:.2f} (at most "
            f"{LARGEST_SLOPE})"
        )
    print(
        "a job costs, in processor seconds: "
        + ", ".join(
            f"{value:.4f} ± {error:.4f} {per}"
            for value, error, per in zip(price, errors, PER, strict=True)
        )
    )
    print(f"two workers take {1 / of_two:.2f} times the processor time of one")
    for times, each in predicted.items():
        print(
            f"efficiency by that for {times * long.megabytes / 1e3:.1f} GB in "
            f"{times * growing[0]:g} parts: "
            + ", ".join(f"{n}: {value:.2f}" for n, value in each.items())
        )
    close = [name for name in ("memory_copy_mb_per_s", "disk_mb_per_s") if rate > bounds[name] / 2]
    print(
        f"limits: memory is copied at {bounds['memory_copy_mb_per_s']:.0f} MB/s, the disk gives "
        f"{bounds['disk_mb_per_s']:.0f} MB/s; the fastest job takes {rate:.0f} MB per "
        f"processor-second, so that what limits is: {', '.join(close) or 'instructions'}"
    )
    memory = max(c.peak_memory_mb for c in every)
    numbers = {
        "limits": bounds, "jobs": [asdict(c) for c in (*every, alone)], "slopes": slopes,
        "prices_s": dict(zip(PER, price.tolist(), strict=True)),
        "efficiency_of_two": of_two, "efficiency_predicted": predicted,
        "peak_memory_mb": memory,
    }  # fmt: skip
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "scale.json").write_text(json.dumps(numbers, indent=2) + "\n", encoding="utf-8")
    if options.quick:
        return 0
    return judged(
        {
            **{
                f"slope with {along} at most {LARGEST_SLOPE}": value <= LARGEST_SLOPE
                for along, (value, _) in slopes.items()
            },
            f"peak memory at most {MOST_MEMORY_MB:g} MB": memory <= MOST_MEMORY_MB,
        }
    )


if __name__ == "__main__":
    sys.exit(main())
