"""A few hundred damaged files; ``python tests/hardening/fuzz.py`` tries twenty-five thousand."""

from __future__ import annotations

from pathlib import Path

from hardening.fuzz import KINDS, build, run
from hardening.samples import samples


def test_damaged_files_are_read_or_refused() -> None:
    counts, failures = run(inputs=500, seed=20_261_121)
    assert failures == []
    assert sum(counts.values()) == 500
    for kind in KINDS:  # neither everything read nor everything refused at the first byte
        assert counts[kind, "read"] > 0
        assert counts[kind, "refused"] > 50


def test_inputs_repeat(tmp_path: Path) -> None:
    originals = samples(tmp_path)
    for number in range(20):
        assert build(number, 3, originals) == build(number, 3, originals)
    assert build(0, 3, originals) != build(0, 4, originals)
