"""From the events of a movie to rows, tracks and summary, in the same way for all movies.

A fit knows the error of its own likelihood.  Calibration errors, the spread of an event's own
frames and the ratio of the measured spread to the bound follow from all events together.  With
``fit.sigma = "measured"`` the σ in a row is already the measured one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.calibration import as_given
from iscat_analysis.config import config_to_toml
from iscat_analysis.diagnosis import (
    Prepared,
    fixed_height_warning,
    landing_rate_warning,
    large_warning,
    line_warning,
    nonlinearity_warning,
    residue_warning,
    scale_warning,
    sign_warning,
)
from iscat_analysis.executors import versions
from iscat_analysis.fitting.results import Compared, DetectionResult
from iscat_analysis.fitting.run import Run
from iscat_analysis.inference.empirical_spread import EmpiricalSpread
from iscat_analysis.inference.nuisances import Evidence
from iscat_analysis.pipeline.summary import species_of, summary_of, timeline_of
from iscat_analysis.records import (
    FREE_PARAMETERS,
    Analysis,
    BoolArray,
    Film,
    FloatArray,
    Provenance,
    Status,
    TrackStatus,
    flagged,
    is_rejected,
    make_rows,
    silent,
    with_diameters,
)
from iscat_analysis.text import printable
from iscat_analysis.threads import start_in_thread
from iscat_analysis.trust.budget import SCALE, SPHERES, budget_of, explained_kda, width_warning
from iscat_analysis.trust.changing_light import at_a_shared_place, in_parts, may_rise, rise_message
from iscat_analysis.trust.empirical_spread import (
    measure_spread,
    measured_scale,
    repeat_columns,
    spread_verdict,
)
from iscat_analysis.trust.extension import Extension
from iscat_analysis.trust.fluctuation import Fluctuation
from iscat_analysis.trust.heights import Heights
from iscat_analysis.trust.pairs import told_as_pairs, with_masses_of_pairs
from iscat_analysis.trust.systematic import contributions, misfit_error, total
from iscat_analysis.trust.uneven_reference import reference_warning


@dataclass(frozen=True)
class ReportedRows:
    """The rows of all events of a movie, and what all events together say."""

    table: pd.DataFrame
    achieved: Mapping[str, EmpiricalSpread]
    budget: list[dict[str, Any]]
    heights: Heights | None = None
    extension: Extension | None = None
    fluctuation: Fluctuation | None = None
    changing_light: str = ""


def reported_rows(
    found: DetectionResult,
    *,
    optics: Mapping[str, Any] = MappingProxyType({}),
    camera: Mapping[str, Any] | None = None,
) -> ReportedRows:
    """Make the rows of all events of a movie, `optics` and `camera` as the summary has them."""
    fits, config, mode = found.fits, found.context.config, found.context.mode
    achieved = measure_spread(mode, fits, found.repeats, found.empty) if found.repeats else {}
    evidence, heights, extension = None, None, None
    if found.evidence is not None and len(found.evidence):
        evidence = Evidence(*found.evidence.T)
        heights = Heights.of(config, fits, evidence)
        if heights is None or not heights.are_wrong:  # which would look like widths
            extension = Extension.of(config, fits, evidence, achieved)
    if extension is not None and config.fit.pairs:
        paired = told_as_pairs(fits, extension)
        fits, extension = with_masses_of_pairs(fits, paired), extension.without(paired)
    shifts = {
        name: finding.mass_shift_kda
        for name, finding in (("heights", heights), ("extension", extension))
        if finding is not None
    }
    if extension is not None:
        fits = flagged(fits, Status.EXTENDED, extension.flagged)
    changing_light = ""
    shared_place = np.zeros(len(fits), dtype=bool)
    resolution_nm = config.optics.wavelength_nm / config.optics.na
    if found.heading == "landing":
        shared_place = at_a_shared_place(fits, resolution_nm)
        fits = flagged(fits, Status.CHANGING, shared_place)
        if evidence is not None:
            parts = in_parts(fits, evidence.rise_frames)
            fits = flagged(fits, Status.CHANGING, parts)
            fits, changing_light = _with_changing(fits, evidence, shared_place)
            shared_place |= parts
    scale = measured_scale(achieved) if config.fit.sigma == "measured" else {}
    fluctuation = None
    if not scale:  # which has all that the frames show
        fluctuation = Fluctuation.of(mode, found.fits, found.repeats, achieved, shared_place)
    if fluctuation is not None:
        if found.heading == "landing" and fluctuation.is_seen:
            wide = at_a_shared_place(fits, resolution_nm, fluctuation.relative)
            fits = flagged(fits, Status.CHANGING, wide)
        sigma = np.sqrt(fits["sigma_mass_kda"] ** 2 + fluctuation.variance_kda2)
        fits = fits.assign(sigma_mass_kda=sigma)
    columns: dict[str, pd.Series | FloatArray] = {
        name: fits[name] * factor for name, factor in scale.items()
    }
    if mode == "track":
        from iscat_analysis.tracking.tracked_optics import mass_error

        unfit = mass_error(optics)
    if mode != "track" or not optics:  # the optics were not tested
        unfit = misfit_error(fits, found.context.roi_px**2)
    threshold = 0.0 if mode == "track" else found.context.templates.threshold
    shared = contributions(
        config, fits, unfit, found.context.model.scale, shifts, camera, threshold, optics
    )
    columns |= {f"systematic_{name}": error for name, error in total(shared, len(fits)).items()}
    if found.repeats:
        columns |= repeat_columns(mode, fits, found.repeats)
    table = make_rows(fits, columns)
    if mode == "mass":  # what is no dipole has no mass, and no error of one
        kinds = table.columns.intersection(["repeat_mass_kda", "systematic_mass_kda"])
        table[kinds] = table[kinds].where(table["mass_kda"].notna(), np.nan, axis=0)
    if config.fits_sizes:
        table = with_diameters(table, config.particle.density)
    unknown = SPHERES if config.fits_sizes else SCALE if config.calibration is None else None
    budget = (
        budget_of(table, shared, achieved, unknown=unknown, scaled=config.fit.sigma == "measured")
        if "mass_kda" in FREE_PARAMETERS[mode]
        else []
    )
    return ReportedRows(table, achieved, budget, heights, extension, fluctuation, changing_light)


def _with_changing(
    fits: pd.DataFrame, evidence: Evidence, shared_place: BoolArray
) -> tuple[pd.DataFrame, str]:
    """Flag steps whose light may still be changing, and describe that in a message."""
    unseen, frames = may_rise(fits, evidence, shared_place)
    rising = int((~shared_place & (np.nan_to_num(evidence.rise_frames) > 0)).sum())
    text = rise_message(frames, int(unseen.sum()), rising, len(fits))
    return flagged(fits, Status.CHANGING, unseen), text


def make_analysis(
    ready: Prepared,
    run: Run,
    found: DetectionResult,
    extra: Mapping[str, Any],
    *,
    command: str,
    started: str,
    interrupted: bool,
) -> Analysis:
    """Put everything that is reported of a movie into an `Analysis`."""
    progress = run.progress
    if interrupted:  # what was finished is now gathered and kept, which takes a moment
        progress("report", 0, 1)
        progress = silent  # another stage would end the time that writing is given
    context, compared = found.context, found.compared
    config = context.config
    further = {**ready.summary}
    if found.summary:
        further[found.heading] = found.summary
    if found.optics:
        further["optics"] = found.optics
    further |= extra
    rows = reported_rows(found, optics=further.get("optics", {}), camera=ready.summary["camera"])
    table, achieved, budget = rows.table, rows.achieved, rows.budget
    recorded = ready.whole.metadata.ticks
    ticks = None if recorded is None else np.array(recorded)
    if ticks is not None and table["frame"].notna().all():
        table = make_rows(table, {"tick": ticks[table["frame"].to_numpy(int)]})
    for flag in ready.flags:
        table = flagged(table, flag)
    scale = context.model.scale
    if rows.changing_light:
        run.warn(rows.changing_light)
    for name, finding in (
        ("heights", rows.heights),
        ("extension", rows.extension),
        ("fluctuation", rows.fluctuation),
    ):
        if finding is not None:
            further[name] = finding.summary
            if finding.message:
                run.warn(finding.message)
    sliding = ready.background_mode == "sliding"
    window = found.summary["window_frames"] if sliding and found.summary else None
    run.report(
        scale_warning(scale),
        line_warning(config, table),
        nonlinearity_warning(scale, table),
        sign_warning(config, table),
        large_warning(config, table),
        landing_rate_warning(table) if sliding else None,
        None if window is None else residue_warning(table, window),
    )
    if reference := reference_warning(config, table):
        run.warn(reference)
    scaled = config.fit.sigma == "measured"
    if found.repeats:
        seen = rows.fluctuation is not None and rows.fluctuation.is_seen
        had = ("mass_kda",) if seen else ()  # by σ
        verdict = spread_verdict(
            {name: one for name, one in achieved.items() if name not in had},
            found.summary,
            scaled=scaled,
            rejected=is_rejected(table),
            sliding=ready.background_mode == "sliding",
        )
        further["repeats"] = verdict
        if verdict["message"]:
            run.warn(verdict["message"])
    elif scaled and len(table):
        run.warn(
            'fit.sigma = "measured" has no effect: the spread is not measured where the background '
            "is learnt with the tracks, and σ is that of the likelihood"
        )
    tracks: pd.DataFrame | None = None
    films: tuple[Film, ...] = ()
    if found.followed is not None:
        from iscat_analysis.tracking.common_motion import warnings_of
        from iscat_analysis.tracking.tracks import make_films, tracks_of

        followed = found.followed
        tracks, track_summary = tracks_of(
            context, table, followed.windows,
            masses=followed.masses, ticks=ticks, warn=run.warn, progress=progress,
        )  # fmt: skip
        further |= track_summary
        for text in warnings_of(table, config.camera.frame_rate_hz, ticks):
            run.warn(text)
        run.report(fixed_height_warning(config, table))
        backgrounds = followed.parts or (followed.windows,)
        films = make_films(context, ready.steady, ready.camera, backgrounds, table, tracks)
        run.clock.lap("tracks")
    if scale.refusal:
        table = flagged(table, Status.UNCALIBRATED_OPTICS)
        tracks = None if tracks is None else flagged(tracks, TrackStatus.UNCALIBRATED_OPTICS)
    # frames are read and transformed while the species are found
    timeline_future = start_in_thread(timeline_of, ready, found, table)
    searched = found.summary.get("searched_share") if found.summary else None
    described = species_of(context, table, searched, tracks)
    explained = {"explained_kda": explained_kda(budget)}
    described["across_particles"] = [one | explained for one in described["across_particles"]]
    calibrated = config.calibration is not None or config.fits_sizes
    wide = width_warning(described["across_particles"], calibrated=calibrated)
    if wide:
        run.warn(wide)
    timeline = timeline_future.result()
    summary = summary_of(context, table, compared, run.clock.seconds, achieved)
    provenance = Provenance(
        command=printable(command) or "iscat_analysis.pipeline.analyse",
        input_path=printable(str(ready.whole.path)),
        input_sha256=ready.digest.result(),
        versions=versions(),
        seed=config.compute.seed if config.samples_posterior else None,
        started=started,
    )
    summary |= {
        **further,
        **({"timeline": timeline} if timeline else {}),
        **({"budget": budget} if budget else {}),
        "input": {
            "path": provenance.input_path,
            "sha256": provenance.input_sha256,
            "shape": list(ready.whole.shape),
        },
        "seed": provenance.seed,
        "versions": dict(provenance.versions),
        "interrupted": interrupted,
        "findings": run.findings.summary,
        "warnings": run.findings.warnings,
        **described,
    }
    frames, first = _unique_frames(compared)
    return Analysis(
        config_toml=config_to_toml(as_given(config)),
        mode=context.mode,
        scheme=config.optics.scheme,
        pixel_size_nm=context.pixel_nm,
        table=table,
        views=found.views,
        ratio_image=found.image,
        power=compared.power[first],
        power_frames=frames,
        summary=summary,
        provenance=provenance,
        findings=tuple(run.findings.made),
        tracks=tracks,
        films=films,
        response=ready.response.table if ready.response is not None else None,
    )


def _unique_frames(compared: Compared) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """Sort the frames of both ranges, each once, and give the index of each in the power.

    Where particles move, both ranges are the whole movie, so that every frame is in it twice.
    """
    ranges = compared.frames_before, compared.frames_after
    both = np.concatenate([np.arange(*span, dtype=np.int64) for span in ranges])
    frames, first = np.unique(both, return_index=True)
    return frames, first
