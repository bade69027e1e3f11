"""Kernels as bodies for others and as wholes for Python."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.claims import claimed
from iscat_analysis._kernels.compiler import _Body, _Whole

KERNELS = """
import sys
import numpy as np
from iscat_analysis._kernels import kernel

@kernel()
def doubled(x):
    if x.size == 0:
        raise ValueError("no numbers")
    return 2.0 * x

@kernel()
def total(x):
    return doubled(x).sum()

@kernel()
def more(x):
    return total(x) + 1.0
"""
ASK = """
import json
import sys
import numpy as np
sys.path.insert(0, "")
import kernels

found = {}
for name in sys.argv[1:]:
    one = getattr(kernels, name)
    found[name] = np.asarray(one(np.arange(4.0))).tolist(), sum(one.stats.cache_misses.values())
print(json.dumps(found))
"""


OTHER = """
import numba
numba.__version__ = "0.999.0"
from iscat_analysis import _kernels
assert _kernels._compiler is None
"""


def _asked(folder: Path, *names: str, before: str = "") -> dict[str, tuple[object, int]]:
    """Values of kernels in a process of its own, and how many it compiled of each."""
    written = folder / "kernels.py"
    if not written.exists():  # a Numba that goes by dates would compile them anew
        written.write_text(KERNELS, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-c", before + ASK, *names],
        cwd=folder, env=os.environ | {"NUMBA_CACHE_DIR": str(folder / "kept")},
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    found: dict[str, tuple[object, int]] = json.loads(done.stdout)
    return found


@kernel()
def _halves(x: np.ndarray) -> np.ndarray:
    if x.size == 0:
        raise ValueError("no numbers")
    return x / 2.0


@kernel()
def _sum_of_halves(x: np.ndarray) -> float:
    return float(_halves(x).sum())


for _one in (_halves, _sum_of_halves):
    _one._cache.disable()  # what an earlier run of the tests kept


def test_kernel_that_kernels_call_answers_python_as_well() -> None:
    x = np.arange(5.0)
    assert _sum_of_halves(x) == 5.0
    (compiled,) = _halves.overloads.values()
    assert isinstance(compiled.library, _Body)
    np.testing.assert_array_equal(_halves(x), x / 2)
    (compiled,) = _halves.overloads.values()
    assert isinstance(compiled.library, _Whole)
    for called in (_halves, _sum_of_halves):
        with pytest.raises(ValueError, match="no numbers"):
            called(x[:0])
    assert _sum_of_halves(x) == 5.0


def test_function_that_is_no_kernel_calls_one() -> None:
    @njit  # type: ignore[untyped-decorator]
    def outside(x: np.ndarray) -> float:
        return _sum_of_halves(x) + 1.0

    assert outside(np.arange(5.0)) == 6.0
    with pytest.raises(ValueError, match="no numbers"):
        outside(np.zeros(0))


def test_what_numba_writes_of_numpy_for_a_kernel_serves_other_functions_as_well() -> None:
    def filled(n: int) -> float:
        room, other = np.empty(n, np.float32), np.zeros((n, n))
        for i in range(n):
            room[i] = max(i, 2)
        return float(room.sum() + other[0, 0])

    ours, theirs = kernel()(filled), njit(filled)
    ours._cache.disable()
    assert ours(4) == theirs(4) == 9.0

    @kernel()
    def both(n: int) -> float:
        return theirs(n) + np.empty(n, np.float32).size

    both._cache.disable()
    assert both(4) == 13.0


def test_cycles_are_searched_for_after_compilation() -> None:
    @kernel()
    def plain(x: float) -> float:
        return x + 1.0

    assert gc.isenabled()
    assert plain(1.0) == 2.0
    assert gc.isenabled()


@pytest.mark.parametrize("first", [["more"], ["doubled", "more"], ["total"]])
def test_what_one_process_compiled_serves_another(tmp_path: Path, first: list[str]) -> None:
    values = {"doubled": [0.0, 2.0, 4.0, 6.0], "total": 12.0, "more": 13.0}
    assert {name: value for name, (value, _) in _asked(tmp_path, *first).items()} == {
        name: values[name] for name in first
    }
    again = _asked(tmp_path, *first)
    assert again == {name: [values[name], 0] for name in first}
    # a body of the first process is made a whole here, and kept
    every = _asked(tmp_path, "more", "total", "doubled")
    assert {name: value for name, (value, _) in every.items()} == values
    assert every["doubled"][1] == 0
    last = _asked(tmp_path, "doubled", "more", "total")
    assert last == {name: [values[name], 0] for name in values}


def test_a_whole_is_made_of_a_body_where_nothing_was_compiled_before(tmp_path: Path) -> None:
    """As by the run after one that was stopped between the two."""
    source = (
        "from iscat_analysis._kernels import kernel\n\n"
        "@kernel()\ndef larger(pair):\n    return max(pair[0], pair[1])\n\n"
        "@kernel()\ndef doubled(x):\n    return 2.0 * larger((x, 1.0))\n"
    )
    (tmp_path / "pairs.py").write_text(source, encoding="utf-8")
    for call, value in (("doubled(3.0)", 6.0), ("larger((3.0, 1.0))", 3.0)):
        done = subprocess.run(
            [sys.executable, "-c", f"import pairs; print(pairs.{call})"],
            cwd=tmp_path, env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kept")},
            check=False, capture_output=True, text=True,
        )  # fmt: skip
        assert float(done.stdout or "nan") == value, done.stderr


def test_numba_of_unknown_insides_compiles_everything_as_a_whole(tmp_path: Path) -> None:
    expected = {"more": 13.0, "doubled": [0.0, 2.0, 4.0, 6.0]}
    for compiled in (1, 0):
        found = _asked(tmp_path, "more", "doubled", before=OTHER)
        assert {name: value for name, (value, _) in found.items()} == expected
        assert found["more"][1] == compiled


SUMS = """
import numpy as np
from iscat_analysis._kernels import kernel

@kernel(fastmath=True)
def quickly(x):
    return np.sum(x)

@kernel()
def exactly(x):
    return np.sum(x)

x = np.random.default_rng(1).lognormal(0.0, 5.0, 1000)
for one in ORDER:
    one(x)
total = 0.0
for number in x:
    total += number
print(exactly(x) == total, quickly(x) == total)
"""


@pytest.mark.parametrize("order", ["quickly, exactly", "exactly, quickly"])
def test_what_numpy_does_for_one_kernel_is_not_taken_for_another_of_other_options(
    tmp_path: Path, order: str
) -> None:
    script = tmp_path / "sums.py"
    script.write_text(SUMS.replace("ORDER", f"({order})"), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, str(script)],
        env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kept")},
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    assert done.stdout.split() == ["True", "False"]


def test_two_processes_compile_a_kernel_once(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(KERNELS, encoding="utf-8")
    both = [
        subprocess.Popen(
            [sys.executable, "-c", ASK, "more"],
            cwd=tmp_path, env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kept")},
            stdout=subprocess.PIPE, text=True,
        )
        for _ in range(2)
    ]  # fmt: skip
    found = [json.loads(one.communicate()[0])["more"] for one in both]
    assert [value for value, _ in found] == [13.0, 13.0]
    assert sum(compiled for _, compiled in found) == 1


CLAIM = """
import sys
from iscat_analysis._kernels.claims import claimed
with claimed(*sys.argv[1:]):
    print("mine", flush=True)
    sys.stdin.read()
"""


def test_a_claim_holds_until_it_is_given_back_or_its_process_ends(tmp_path: Path) -> None:
    def claimant(subject: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-c", CLAIM, str(tmp_path), subject],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    with claimant("one") as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "mine\n"
        with claimant("another") as other:
            assert other.communicate()[0] == "mine\n"
        with claimant("one") as second:
            with pytest.raises(subprocess.TimeoutExpired):
                second.wait(timeout=2)
            holder.kill()
            assert second.communicate()[0] == "mine\n"
    with claimed(str(tmp_path), "one"), claimant("one") as third:
        with pytest.raises(subprocess.TimeoutExpired):
            third.wait(timeout=2)
        third.kill()


def test_nothing_is_claimed_where_nothing_can_be_written(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("a file is no folder", encoding="utf-8")
    with claimed(str(blocked / "kernels"), "one"):
        pass
