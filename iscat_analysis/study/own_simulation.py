"""Score tables of somebody's own simulation: ``iscat benchmark --truth --results``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.executors import versions
from iscat_analysis.hashing import sha256_of_files
from iscat_analysis.records import FREE_PARAMETERS
from iscat_analysis.study.challenge_scores import score_tables
from iscat_analysis.study.efficiency import limits_of_many, matched
from iscat_analysis.study.results import read_results, refuse_other_units


def score_own(truth: Path, results: Path, config: Config, *, command: str = "") -> dict[str, Any]:
    """Score one table against another, row by row or by event."""
    pixel = config.camera.pixel_size_nm
    if pixel is None:
        raise ConfigError(
            "camera.pixel_size_nm is needed: give it, as in camera.pixel_size_nm = 84.4"
        )
    mode = config.fit.mode if config.fit.mode != "track" else "joint"
    free = FREE_PARAMETERS[mode]
    known, found = (read_results(path, pixel, rows=True) for path in (truth, results))
    columns, truths = matched(found.table, known.table, config, free)
    placed = found.table if "event" not in known.table or "event" not in found.table else None
    if placed is not None:
        refuse_other_units(found.name, placed, known.table, pixel)
    if not columns:
        raise DataError(f"{results}: has none of the columns {', '.join(free)}")
    limits = limits_of_many(config, free, np.asarray(truths))
    scored = score_tables(columns, truths, limits, found.name, config)
    hashes = {path.name: sha256_of_files([path]) for path in (truth, results)}
    return {
        "title": "Estimates of one's own simulation",
        "challenge": None,
        "results_sha256": hashes,
        "command": command,
        "versions": versions(),
        **scored,
    }
