"""A thousand damaged inputs, fifty thousand where large tests are run; see `hardening.fuzz`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from hardening import calls
from hardening.fuzz import KINDS, build, run
from hardening.seeds import READERS, REFUSED_WHOLE, seeds


def test_damaged_inputs_are_read_or_refused(repetitions: Callable[[int, int], int]) -> None:
    inputs = repetitions(1000, 50_000)
    counts, failures = run(inputs=inputs, seed=20_261_121)
    assert failures == []
    assert sum(counts.values()) == inputs
    for kind in READERS:  # neither everything read nor everything refused
        assert counts[kind, "read"] > 0 or kind in REFUSED_WHOLE
        assert counts[kind, "refused"] > 0 or kind == "cache"  # which is made anew
    called = {name for name in calls.names() for word in ("read", "refused") if counts[name, word]}
    assert called == set(calls.names())


def test_every_public_function_is_called() -> None:
    import inspect

    import iscat_analysis as ia

    functions = {name for name in ia.__all__ if inspect.isfunction(getattr(ia, name))}
    assert functions <= set(calls.names())


def test_inputs_repeat(tmp_path: Path) -> None:
    originals = seeds(tmp_path)
    for number in range(2 * len(KINDS)):
        assert build(number, 3, originals) == build(number, 3, originals)
    assert build(0, 3, originals) != build(0, 4, originals)
