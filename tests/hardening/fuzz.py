"""Feed readers with files damaged at random, and public functions with bad arguments.

    python tests/hardening/fuzz.py --inputs 25000 --seed 1

An input is a small valid seed (`seeds`), one of whose files is missing or has one to six mutations,
or a call of a public function with spoilt arguments (`calls`).  It is made from the seed and its
number alone, so ``--only N`` repeats input N.  A reader or a function may return, or raise an
`IscatError` with one line of text.  Anything else is a failure: another exception, a warning of a
reader, the death of the process, more than `MEMORY_MB` of address space beyond what Python and its
libraries take, or more than `SECONDS` for one input.  The inputs are tried in a process of their
own, which is watched.
"""

from __future__ import annotations

import argparse
import logging
import os
import resource
import shutil
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
from contextlib import suppress
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from hardening import calls
from hardening.seeds import READERS, REFUSED_WHOLE, Seed, seeds

from iscat_analysis.errors import IscatError

MEMORY_MB = 800
SECONDS = 60.0  # a guard against hanging; an input takes milliseconds
KINDS = (*READERS, "call", "call", "call")
_MISSING = 0.05  # of the seeds of several files, those that lack one
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
    """Damage a file, with pieces of another; never to nothing."""
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


def _flip(data: bytearray, _: bytes, rng: Generator) -> None:
    data[_place(data, rng)] ^= 1 << int(rng.integers(8))


def _overwrite(data: bytearray, _: bytes, rng: Generator) -> None:
    width = int(rng.choice([1, 2, 4, 8]))
    value = _INTERESTING[int(rng.integers(len(_INTERESTING)))] % (1 << 8 * width)
    at = _place(data, rng)
    order = "little" if rng.random() < 0.7 else "big"
    data[at : at + width] = value.to_bytes(width, order)  # type: ignore[arg-type]


def _cut(data: bytearray, _: bytes, rng: Generator) -> None:
    del data[_place(data, rng) :]


def _delete(data: bytearray, _: bytes, rng: Generator) -> None:
    at = _place(data, rng)
    del data[at : at + int(rng.integers(1, 64))]


def _insert(data: bytearray, _: bytes, rng: Generator) -> None:
    at = _place(data, rng)
    data[at:at] = _WORDS[int(rng.integers(len(_WORDS)))]


def _replace(data: bytearray, _: bytes, rng: Generator) -> None:
    at, word = _place(data, rng), _WORDS[int(rng.integers(len(_WORDS)))]
    data[at : at + len(word)] = word


def _copy(data: bytearray, other: bytes, rng: Generator) -> None:
    source = bytes(data) if rng.random() < 0.5 else other
    start, size = int(rng.integers(len(source))), int(rng.integers(1, 256))
    at = _place(data, rng)
    data[at : at + size] = source[start : start + size]


def _erase(data: bytearray, _: bytes, rng: Generator) -> None:
    at, size = _place(data, rng), int(rng.integers(1, 256))
    data[at : at + size] = bytes(min(size, len(data) - at))


def _noise(data: bytearray, _: bytes, rng: Generator) -> None:
    at, size = _place(data, rng), int(rng.integers(1, 64))
    data[at : at + size] = rng.bytes(size)


def _append(data: bytearray, _: bytes, rng: Generator) -> None:
    data += rng.bytes(int(rng.integers(1, 512)))


_MUTATIONS: tuple[Callable[[bytearray, bytes, Generator], None], ...] = (
    _flip, _flip, _flip, _overwrite, _overwrite, _overwrite, _cut, _delete, _insert, _replace,
    _copy, _erase, _noise, _append,
)  # fmt: skip


def build(number: int, seed: int, originals: dict[str, list[Seed]]) -> tuple[str, Seed]:
    """Make one input; the same numbers make the same bytes."""
    rng = np.random.default_rng([seed, number])
    kind = KINDS[number % len(KINDS)]
    if kind == "call":
        names = calls.names()
        return names[number // len(KINDS) % len(names)], {}
    kept = originals[kind]
    files = dict(kept[int(rng.integers(len(kept)))])
    name = list(files)[int(rng.integers(len(files)))]
    if len(files) > 1 and rng.random() < _MISSING:
        del files[name]
    else:
        other = list(kept[int(rng.integers(len(kept)))].values())
        files[name] = mutated(files[name], other[int(rng.integers(len(other)))], rng)
    return kind, files


def _put(files: Seed, folder: Path) -> None:
    """Write an input into an empty folder."""
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def attempt(kind: str, first: str, folder: Path, rng: Generator) -> str:
    """Try one input: ``"read"``, ``"refused"``, or the traceback of what must not happen."""

    def work() -> None:
        if kind in READERS:
            READERS[kind](folder / first)
        else:
            calls.call(kind, rng)

    with warnings.catch_warnings(), ThreadPoolExecutor(1) as pool:
        warnings.simplefilter("error" if kind in READERS else "ignore")
        error = pool.submit(work).exception()
    if error is None:
        return "read"
    if not isinstance(error, IscatError):
        return "".join(traceback.format_exception(error))
    return "refused" if len(str(error).strip().splitlines()) == 1 else f"not one line: {error}"


def _try_undamaged(originals: dict[str, list[Seed]], folder: Path) -> None:
    """Import, compile and try everything before memory is limited."""
    for kind, kept in originals.items():
        for number, files in enumerate(kept):
            here = folder / f"{kind}{number}"
            _put(files, here)
            outcome = attempt(kind, next(iter(files)), here, np.random.default_rng(0))
            if outcome != ("refused" if kind in REFUSED_WHOLE else "read"):
                raise SystemExit(f"the undamaged {kind} seed {number} is not read: {outcome}")
    for name in calls.names():
        with suppress(IscatError):  # of what is not there
            calls.sound(name)


def _work(first: int, stop: int, seed: int, folder: Path) -> None:
    """Try inputs and report on stdout; runs in a process of its own."""
    logging.disable()
    report = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # of what is called
    originals = seeds(folder)
    os.chdir(folder)
    _try_undamaged(originals, folder)
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    limit = taken + MEMORY_MB * 1_000_000
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    for number in range(first, stop):
        kind, files = build(number, seed, originals)
        here = folder / "here"
        here.mkdir()
        _put(files, here)
        main = next(iter(originals[kind][0])) if len(originals.get(kind, ())) == 1 else ""
        os.chdir(here)
        signal.alarm(int(SECONDS))  # kills: a loop inside a C library sees no exception
        outcome = attempt(
            kind, main or next(iter(files), ""), here, np.random.default_rng([seed, number, 1])
        )
        signal.alarm(0)
        os.chdir(folder)
        shutil.rmtree(here)
        print(number, kind, repr(outcome), file=report, flush=True)


def run(inputs: int, seed: int, first: int = 0) -> tuple[Counter[tuple[str, str]], list[str]]:
    """Try inputs; give how often each kind was read, refused or failed, and a text per failure."""
    counts: Counter[tuple[str, str]] = Counter()
    failures: list[str] = []
    number, stop = first, first + inputs
    environment = os.environ | {"MALLOC_ARENA_MAX": "2", "OPENBLAS_NUM_THREADS": "1"}
    while number < stop:
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, __file__, "--work", folder, "--first", str(number)]
            command += ["--inputs", str(stop - number), "--seed", str(seed)]
            with subprocess.Popen(
                command, stdout=subprocess.PIPE, text=True, env=environment
            ) as worker:
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
            kind, files = build(options.only, options.seed, seeds(Path(folder)))
            here = Path(folder) / "here"
            here.mkdir()
            _put(files, here)
            os.chdir(here)
            rng = np.random.default_rng([options.seed, options.only, 1])
            print(kind, attempt(kind, next(iter(files), ""), here, rng))
            os.chdir("/")
        return 0
    begin = time.perf_counter()
    counts, failures = run(options.inputs, options.seed, options.first)
    for (kind, word), count in sorted(counts.items()):
        print(f"{kind:21} {word:8} {count}")
    for text in failures[: options.show]:
        print(text)
    print(
        f"{sum(counts.values())} inputs, {len(failures)} failures, "
        f"{time.perf_counter() - begin:.0f} s"
    )
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
