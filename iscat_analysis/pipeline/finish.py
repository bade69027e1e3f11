"""From what was found to what is reported: errors, tracks, summary; the same for all movies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.config import config_to_toml
from iscat_analysis.inference.achieved import Achieved
from iscat_analysis.movie.stack import printable
from iscat_analysis.pipeline.achieved import (
    measure_spread,
    spread_verdict,
    with_measured_sigma,
    with_repeats,
)
from iscat_analysis.pipeline.prepare import Prepared
from iscat_analysis.pipeline.results import Found
from iscat_analysis.pipeline.run import Run
from iscat_analysis.pipeline.summary import summary_of
from iscat_analysis.pipeline.systematic import with_systematic
from iscat_analysis.pipeline.tracks import make_films, tracks_of
from iscat_analysis.pipeline.ways import way_of
from iscat_analysis.places import versions
from iscat_analysis.records import Analysis, Film, Provenance, silent
from iscat_analysis.report.spread import rejection


def with_errors(found: Found) -> tuple[pd.DataFrame, dict[str, Achieved], dict[str, Any]]:
    """Put what all events share, and what their own frames show, beside the errors of the fits.

    Parameters
    ----------
    found : Found
        Events with the errors of their likelihoods.

    Returns
    -------
    table : pandas.DataFrame
        With the columns ``systematic_*`` and ``repeat_*``, where they are known; with
        ``fit.sigma = "measured"`` σ is scaled by the measured spread.
    achieved : dict of str to Achieved
        The measured spread over the bound, by free parameter.
    verdict : dict
        What ``summary.json`` says of it; empty where nothing could be compared.
    """
    config, mode = found.scene.config, found.scene.mode
    table = with_systematic(config, found.table)
    if not found.repeats:
        return table, {}, {}
    achieved = measure_spread(mode, table, found.repeats, found.empty)
    rejected = bool(rejection(table))
    table = with_repeats(mode, table, found.repeats)
    scaled = config.fit.sigma == "measured"
    if scaled:
        table = with_measured_sigma(table, achieved)
    verdict = spread_verdict(
        achieved, found.summary,
        scaled=scaled, rejected=rejected, sliding=way_of(config) == "sliding",
    )  # fmt: skip
    return table, achieved, verdict


def gather(
    ready: Prepared,
    run: Run,
    found: Found,
    extra: Mapping[str, Any],
    *,
    command: str,
    started: str,
    interrupted: bool,
) -> Analysis:
    """Gather everything that is reported of a movie.

    Parameters
    ----------
    ready : Prepared
        The movie.
    run : Run
        Is told what the user should know.
    found : Found
        What was found in it.
    extra : mapping
        What ``summary.json`` says beside that.
    command : str
        The command line, for the record.
    started : str
        When, as ISO 8601 in UTC.
    interrupted : bool
        Whether the user stopped it.

    Returns
    -------
    Analysis
        What the report is made of.
    """
    progress = run.progress
    if interrupted:  # what was finished is now gathered and kept, which takes a moment
        progress("report", 0, 1)
        progress = silent  # another stage would end the time that writing is given
    scene, compared = found.scene, found.compared
    config = scene.config
    further = {**ready.summary}
    if found.summary:
        further[found.heading] = found.summary
    further |= extra
    table, achieved, verdict = with_errors(found)
    if verdict:
        further["repeats"] = verdict
        if verdict["message"]:
            run.tell(verdict["message"])
    tracks: pd.DataFrame | None = None
    films: tuple[Film, ...] = ()
    if found.followed is not None:
        followed = found.followed
        tracks, said = tracks_of(
            scene, table, followed.windows,
            masses=followed.masses, tell=run.tell, progress=progress,
        )  # fmt: skip
        further |= said
        backgrounds = followed.parts or (followed.windows,)
        films = make_films(scene, ready.steady, ready.camera, backgrounds, table, tracks)
        run.clock.lap("tracks")
    summary = summary_of(scene, table, compared, run.clock.seconds, achieved)
    provenance = Provenance(
        command=printable(command) or "iscat_analysis.pipeline.analyse",
        input_path=printable(str(ready.movie.path)),
        input_sha256=ready.digest.result(),
        versions=versions(),
        seed=config.compute.seed if config.samples_posterior else None,
        started=started,
    )
    summary |= {
        **further,
        "input": {
            "path": provenance.input_path,
            "sha256": provenance.input_sha256,
            "shape": list(ready.movie.shape),
        },
        "seed": provenance.seed,
        "versions": dict(provenance.versions),
        "interrupted": interrupted,
        "warnings": run.warnings,
    }
    return Analysis(
        config_toml=config_to_toml(config),
        mode=scene.mode,
        scheme=config.optics.scheme,
        pixel_size_nm=scene.pixel_nm,
        table=table,
        views=found.views,
        ratio_image=found.image,
        power=compared.power,
        power_frames=np.concatenate(
            [np.arange(*compared.frames_before), np.arange(*compared.frames_after)]
        ),
        summary=summary,
        provenance=provenance,
        warnings=tuple(run.warnings),
        tracks=tracks,
        films=films,
    )
