"""Feed the readers files that were damaged at random, and say what broke.

    python tests/hardening/fuzz.py --inputs 25000 --seed 1

Each input is a small whole file (`samples`) after one to six mutations, made from the seed and its
number alone, so ``--only N`` repeats input N.  A reader may return or raise `DataError`, with one
line of text.  Anything else is a failure: another exception, a warning, the death of the process,
more than `MEMORY_MB` of address space beyond what Python and its libraries take, or more than
`SECONDS` for one input.  The inputs are tried in a process of their own, which is watched.
"""

from __future__ import annotations

import argparse
import logging
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from hardening.samples import samples

from iscat_analysis.camera.counts import read_map
from iscat_analysis.errors import DataError
from iscat_analysis.movie import open_stack
from iscat_analysis.movie.event_tables import read_events

MEMORY_MB = 512
SECONDS = 60.0  # a guard against hanging; an input takes milliseconds
KINDS = ("tiff", "map", "mp", "h5", "csv")
_INTERESTING = (
    0, 1, 2, 7, 8, 127, 128, 255, 256, 32767, 32768, 65535, 65536, 2**24, 2**31 - 1, 2**31,
    2**32 - 1, 2**32, 2**40, 2**62, 2**63 - 1, 2**63, 2**64 - 1,
)  # fmt: skip
_WORDS = (
    b"<!DOCTYPE a [<!ENTITY b 'c'>]>", b"<a>" * 5000, b"nan", b"-inf", b"1e999", b"\xff\xfe",
    b"\x00", b",", b"\n", b'"', b"#", b"{" * 5000, b"[" * 5000, b"9" * 400, b"ImageJ=1.11\nimages=",
)  # fmt: skip
Generator = np.random.Generator


def mutated(original: bytes, other: bytes, rng: Generator) -> bytes:
    """Damage a file.

    Parameters
    ----------
    original, other : bytes
        The file, and one to take pieces from.
    rng : Generator
        Decides everything.

    Returns
    -------
    bytes
        Never empty.
    """
    data = bytearray(original)
    for _ in range(int(rng.integers(1, 7))):
        _MUTATIONS[int(rng.integers(len(_MUTATIONS)))](data, other, rng)
        if not data:
            data += b"\0"
    return bytes(data)


def _place(data: bytearray, rng: Generator) -> int:
    """Half of the time near the beginning, where headers are."""
    end = len(data) if rng.random() < 0.5 else min(len(data), 512)
    return int(rng.integers(end))


def _flip(data: bytearray, other: bytes, rng: Generator) -> None:
    del other
    data[_place(data, rng)] ^= 1 << int(rng.integers(8))


def _overwrite(data: bytearray, other: bytes, rng: Generator) -> None:
    del other
    width = int(rng.choice([1, 2, 4, 8]))
    value = _INTERESTING[int(rng.integers(len(_INTERESTING)))] % (1 << 8 * width)
    at = _place(data, rng)
    order = "little" if rng.random() < 0.7 else "big"
    data[at : at + width] = value.to_bytes(width, order)  # type: ignore[arg-type]


def _cut(data: bytearray, other: bytes, rng: Generator) -> None:
    del other
    del data[_place(data, rng) :]


def _delete(data: bytearray, other: bytes, rng: Generator) -> None:
    del other
    at = _place(data, rng)
    del data[at : at + int(rng.integers(1, 64))]


def _insert(data: bytearray, other: bytes, rng: Generator) -> None:
    del other
    at = _place(data, rng)
    data[at:at] = _WORDS[int(rng.integers(len(_WORDS)))]


def _replace(data: bytearray, other: bytes, rng: Generator) -> None:
    del other
    at, word = _place(data, rng), _WORDS[int(rng.integers(len(_WORDS)))]
    data[at : at + len(word)] = word


def _copy(data: bytearray, other: bytes, rng: Generator) -> None:
    source = bytes(data) if rng.random() < 0.5 else other
    start, size = int(rng.integers(len(source))), int(rng.integers(1, 256))
    at = _place(data, rng)
    data[at : at + size] = source[start : start + size]


def _erase(data: bytearray, other: bytes, rng: Generator) -> None:
    del other
    at, size = _place(data, rng), int(rng.integers(1, 256))
    data[at : at + size] = bytes(min(size, len(data) - at))


def _noise(data: bytearray, other: bytes, rng: Generator) -> None:
    del other
    at, size = _place(data, rng), int(rng.integers(1, 64))
    data[at : at + size] = rng.bytes(size)


def _append(data: bytearray, other: bytes, rng: Generator) -> None:
    del other
    data += rng.bytes(int(rng.integers(1, 512)))


_MUTATIONS: tuple[Callable[[bytearray, bytes, Generator], None], ...] = (
    _flip, _flip, _flip, _overwrite, _overwrite, _overwrite, _cut, _delete, _insert, _replace,
    _copy, _erase, _noise, _append,
)  # fmt: skip


def build(number: int, seed: int, originals: dict[str, list[bytes]]) -> tuple[str, bytes]:
    """Make one input; the same numbers make the same bytes."""
    rng = np.random.default_rng([seed, number])
    kind = KINDS[number % len(KINDS)]
    files = originals[kind]
    return kind, mutated(
        files[int(rng.integers(len(files)))], files[int(rng.integers(len(files)))], rng
    )


def consume(kind: str, path: Path) -> None:
    """Read all that a file of this kind offers, a little at a time."""
    if kind in ("tiff", "mp"):
        with open_stack(path) as stack:
            repr(stack)
            for _ in stack.chunks(memory_mb=16):
                pass
    elif kind == "map":
        read_map(path, "camera.gain_e_per_adu", (12, 14))
    else:
        read_events(path)


def verdict(kind: str, path: Path) -> str:
    """Try one input: ``"read"``, ``"refused"``, or the traceback of what must not happen."""
    with warnings.catch_warnings(), ThreadPoolExecutor(1) as pool:
        warnings.simplefilter("error")
        error = pool.submit(consume, kind, path).exception()
    if error is None:
        return "read"
    if not isinstance(error, DataError):
        return "".join(traceback.format_exception(error))
    return "refused" if "\n" not in str(error).strip() else f"more than one line: {error}"


def _work(first: int, stop: int, seed: int, folder: Path) -> None:
    """Try inputs and report on stdout; runs in a process of its own."""
    logging.disable()
    originals = samples(folder)
    path = folder / "input"
    for kind, files in originals.items():  # everything is imported and tried before the limit
        for data in files:
            path.write_bytes(data)
            outcome = verdict(kind, path)
            if outcome != "read":
                raise SystemExit(f"the undamaged {kind} sample is not read: {outcome}")
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    limit = taken + MEMORY_MB * 1_000_000
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    for number in range(first, stop):
        kind, data = build(number, seed, originals)
        path.write_bytes(data)
        signal.alarm(int(SECONDS))  # kills: a loop inside a C library sees no exception
        outcome = verdict(kind, path)
        signal.alarm(0)
        print(number, kind, repr(outcome), flush=True)


def run(inputs: int, seed: int, first: int = 0) -> tuple[Counter[tuple[str, str]], list[str]]:
    """Try many inputs.

    Parameters
    ----------
    inputs : int
        How many.
    seed : int
        Of all mutations.
    first : int
        Number of the first.

    Returns
    -------
    Counter
        How often each kind was read, refused, or failed.
    list of str
        One text for each failure.
    """
    counts: Counter[tuple[str, str]] = Counter()
    failures: list[str] = []
    number, stop = first, first + inputs
    while number < stop:
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, __file__, "--work", folder, "--first", str(number)]
            command += ["--inputs", str(stop - number), "--seed", str(seed)]
            with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as worker:
                for line in worker.stdout or ():
                    text, kind, outcome = line.rstrip("\n").split(" ", 2)
                    number = int(text) + 1
                    word = outcome.strip("'\"")
                    if word not in ("read", "refused"):
                        failures.append(f"input {text} ({kind}):\n{eval_text(outcome)}")
                        word = "failed"
                    counts[kind, word] += 1
        if worker.returncode == 0:
            break
        if worker.returncode > 0:
            failures.append(f"input {number}: the process ended with {worker.returncode}")
            break
        kind = KINDS[number % len(KINDS)]
        name = signal.Signals(-worker.returncode).name
        failures.append(f"input {number} ({kind}): the process was ended by {name}")
        counts[kind, "failed"] += 1
        number += 1
    return counts, failures


def eval_text(outcome: str) -> str:
    """Undo `repr` of a text."""
    return outcome.strip("'\"").replace("\\n", "\n")


def main() -> int:
    """Run the command line; 0 where nothing broke."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=25_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--show", type=int, default=20, help="failures to print")
    parser.add_argument("--only", type=int, help="try this input alone, in this process")
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work is not None:
        _work(options.first, options.first + options.inputs, options.seed, options.work)
        return 0
    if options.only is not None:
        with tempfile.TemporaryDirectory() as folder:
            kind, data = build(options.only, options.seed, samples(Path(folder)))
            path = Path(folder) / "input"
            path.write_bytes(data)
            print(kind, verdict(kind, path))
        return 0
    begin = time.perf_counter()
    counts, failures = run(options.inputs, options.seed, options.first)
    for (kind, word), count in sorted(counts.items()):
        print(f"{kind:6} {word:8} {count}")
    for text in failures[: options.show]:
        print(text)
    print(
        f"{sum(counts.values())} inputs, {len(failures)} failures, "
        f"{time.perf_counter() - begin:.0f} s"
    )
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
