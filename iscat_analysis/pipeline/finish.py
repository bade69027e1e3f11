"""From the events of a movie to rows, tracks and summary, in the same way for all movies.

A fit knows the error of its own likelihood.  Calibration errors, the spread of an event's own
frames and the ratio of the measured spread to the bound follow from all events together.  With
``fit.sigma = "measured"`` the σ in a row is already the measured one.  ``summary.json`` has counts,
medians, precision and species of all events, and a course in time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis import diagnosis, records
from iscat_analysis.bounds import holevo_over_quantum
from iscat_analysis.calibration import as_given
from iscat_analysis.camera import Camera, FieldSample, Pattern, middle_of, pattern_of
from iscat_analysis.config import MODES, MOVES, Config, config_to_toml
from iscat_analysis.diagnosis import Prepared, Stretches
from iscat_analysis.executors import versions
from iscat_analysis.findings import Finding, warnings_in
from iscat_analysis.findings.particles import SPREAD_NOT_MEASURED
from iscat_analysis.findings.tables import SPHERES_MISSED, TRACKS_LEFT_OUT
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.results import Compared, DetectionResult
from iscat_analysis.fitting.run import Run
from iscat_analysis.inference.repeats import EmpiricalSpread
from iscat_analysis.movie import Stack
from iscat_analysis.optics.local import changes_at, terms_of, when
from iscat_analysis.pipeline.kinds import Kind
from iscat_analysis.records import (
    FREE_PARAMETERS,
    Analysis,
    FloatArray,
    Status,
    TrackStatus,
    flagged,
    make_rows,
)
from iscat_analysis.report.numbers import number
from iscat_analysis.search.frames import DARK, measure_frames, well_lit
from iscat_analysis.species import LEAST_EVENTS, describe
from iscat_analysis.species.diameters import Sizes, describe_sizes
from iscat_analysis.species.tables import filter_efficiency, shared_error
from iscat_analysis.text import printable
from iscat_analysis.threads import start_in_thread
from iscat_analysis.trust import systematic
from iscat_analysis.trust.checks import Checked, checked, repeat_columns, spread_verdict
from iscat_analysis.trust.uneven_reference import reference_map
from iscat_analysis.units import are, count

_DROPPED = "dark, cut off, or the same as the frame before: left out"
_HIDDEN = "partly hidden by bright or ill-described particles"


@dataclass(frozen=True)
class Seen:
    """What some frames next to each other show; nothing where they have no light.

    Of a large field, the noise is that of a sample of its pixels, and the image that of its middle.
    """

    light_e: float = math.nan
    noise: float = math.nan
    image: FloatArray | None = None


def timeline_of(ready: Prepared, found: DetectionResult, table: pd.DataFrame) -> dict[str, Any]:
    """Say what was where in a movie, on one axis of frames."""
    first, last = _span(found.compared)
    if first == last:  # it was interrupted before any frame was done
        return {}
    together = min(6, last - first)  # at 48 places
    starts = np.unique(np.linspace(first, last - together, 48).astype(int)).tolist()
    kept = ready.stretches.kept if ready.stretches.breaks else ((first, last),)
    inside = [next((k for k, s in enumerate(kept) if s[0] <= f < s[1]), None) for f in starts]
    seen = [
        Seen() if held is None else look_at(ready.whole, ready.camera, start, start + together)
        for start, held in zip(starts, inside, strict=True)
    ]
    drift_y, drift_x = _drift(seen, inside, additive=found.context.additive)
    return {
        "frames": [start + (together - 1) / 2 for start in starts],
        "light_e": _numbers([one.light_e for one in seen]),
        "noise_over_expected": _numbers([one.noise for one in seen]),
        "focus_nm": _focus(found.context.config, starts),
        "drift_x_px": drift_x,
        "drift_y_px": drift_y,
        "intervals": list(_intervals(ready.stretches, found)),
        "events": _events(table, first, last),
    }


def _span(compared: Compared) -> tuple[int, int]:
    """Give the first frame that was used, and one past the last."""
    spans = [s for s in (compared.frames_before, compared.frames_after) if s[1] > s[0]] or [(0, 0)]
    return min(s[0] for s in spans), max(s[1] for s in spans)


def look_at(movie: Stack, camera: Camera, start: int, stop: int) -> Seen:
    """Measure light and noise of some frames, and the middle of their mean image."""
    counts = movie.read(start, stop)
    light, repeats = measure_frames(counts, camera)
    good = well_lit(light, DARK) & ~repeats
    if good.sum() < 3:
        return Seen()
    few, theirs = counts[good], camera
    sample = FieldSample.of((movie.shape[1], movie.shape[2]))
    if sample is not None:
        few, theirs = sample.taken(few), sample.camera(camera)
    electrons = theirs.to_electrons(few)
    power = electrons.mean(axis=(1, 2), keepdims=True)
    if power.min() <= 0:
        return Seen()
    steady = power.mean() / power
    electrons *= steady
    mean = electrons.mean(axis=0)
    used = (mean > 0.1 * float(np.median(mean))) & ~theirs.saturated(few.max(axis=0))
    expected = mean + theirs.dark_variance_e2(few)
    noise = math.nan
    if used.any():
        steps = np.mean(np.diff(electrons, axis=0) ** 2, axis=0)
        noise = float(steps[used].sum() / (2 * expected[used].sum()))
    # side of the part of a field whose pattern is followed
    middle = middle_of(movie.shape, 256)
    image = camera.part(middle).to_electrons(counts[good][..., *middle]) * steady
    return Seen(float(light[good].mean()), noise, image.mean(axis=0))


def _drift(
    seen: Sequence[Seen], inside: Sequence[int | None], *, additive: bool
) -> tuple[list[float | None], list[float | None]]:
    """Follow the fixed pattern within each stretch, from where the one before ended."""
    moved = np.full((len(seen), 2), np.nan)
    reference: Pattern | None = None
    begun: int | None = None
    origin, latest = np.zeros(2), np.zeros(2)
    for k, (one, held) in enumerate(zip(seen, inside, strict=True)):
        if one.image is None or additive:
            continue
        pattern = pattern_of(one.image)
        if held != begun or reference is None:
            reference, begun, origin = pattern, held, latest
        shift = np.array(pattern.shift_from(reference))
        if np.isfinite(shift).all():
            moved[k] = latest = origin + shift
    return _numbers(moved[:, 0]), _numbers(moved[:, 1])


def _focus(config: Config, starts: Sequence[int]) -> list[float | None]:
    """Give the focus with which each part was fitted."""
    optics = config.optics
    moves = {name: size for name, size in terms_of(optics).items() if name in MOVES}
    rises = [changes_at(moves, when(optics, frame)).get("focus_nm", 0.0) for frame in starts]
    return _numbers([optics.focus_nm + rise for rise in rises])


def _intervals(stretches: Stretches, found: DetectionResult) -> Iterator[dict[str, Any]]:
    """Name the frames that are flagged."""
    for one in stretches.breaks:
        yield {"start": one.start, "stop": one.stop, "what": one.cause}
    for start, stop, _ in (found.summary or {}).get("partly_searched", ()):
        yield {"start": int(start), "stop": int(stop), "what": _HIDDEN}
    compared, begin, number = found.compared, 0, 0
    for first, last in (compared.frames_before, compared.frames_after):
        light = compared.power[begin : begin + last - first]
        begin += last - first
        lost = ~np.isfinite(light)
        for one in stretches.breaks:
            lost[max(one.start - first, 0) : max(one.stop - first, 0)] = False
        edges = np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(np.int8), [0]])))
        for start, stop in edges.reshape(-1, 2).tolist():
            number += 1
            if number <= 200:
                yield {"start": first + start, "stop": first + stop, "what": _DROPPED}


def _events(table: pd.DataFrame, first: int, last: int) -> dict[str, Any]:
    """Count events in equal parts of the movie, those that are ok and others."""
    edges = np.unique(np.linspace(first, last, 40 + 1).astype(int))
    frame = table["frame"].to_numpy(float)
    ok = (table["status"] == Status.OK.value).to_numpy()
    others = ~ok & records.is_event(table)
    return {
        "edges": edges.tolist(),
        "ok": np.histogram(frame[ok], edges)[0].tolist(),
        "flagged": np.histogram(frame[others], edges)[0].tolist(),
    }


def _numbers(values: Sequence[float] | NDArray[np.float64]) -> list[float | None]:
    """Give numbers, and nothing where there is none."""
    return [float(value) if math.isfinite(value) else None for value in values]


_NO_SIZE = {
    TrackStatus.POOR_FITS,
    TrackStatus.AMBIGUOUS_SIZE,
    TrackStatus.OTHER_PARTICLE,
    TrackStatus.MASS_VARIES,
}
"""Flags of tracks of which pictures do not tell the diameter."""


def summary_of(
    context: AnalysisContext,
    table: pd.DataFrame,
    compared: Compared,
    timings: Mapping[str, float],
    achieved: Mapping[str, EmpiricalSpread],
) -> dict[str, Any]:
    """Gather counts, medians and efficiency, for ``summary.json``; `species_of` has the rest."""
    rows = records.tally(table)
    good = table[table["status"] == Status.OK]
    free = records.free_parameters(context.mode, table)
    conflict = {"z_nm", "mass_kda"} <= set(free) and len(good) > 0
    cost = _holevo_over_quantum(context, good["z_nm"].to_numpy(float)) if conflict else {}
    precision = {}
    for name in free:
        sigma, crb, qcrb = (good[f"{kind}_{name}"] for kind in ("sigma", "crb", "qcrb"))
        reachable = qcrb * cost.get(name, 1.0)
        precision[name] = {
            "sigma_median": _median(sigma),
            "crb_median": _median(crb),
            **({"holevo_median": _median(reachable)} if conflict else {}),
            "qcrb_median": _median(qcrb),
            "sigma_over_crb_median": _median(sigma / crb),
            "information_fraction_median": _median((reachable / crb) ** 2),
        }
        if name in achieved:
            precision[name] |= _repeats(achieved[name])
        if f"systematic_{name}" in good:
            precision[name]["systematic_median"] = _median(good[f"systematic_{name}"])
    return {
        "mode": context.mode,
        "scheme": context.model.optics.scheme,
        "emission": context.model.optics.emission,
        "convention": context.model.optics.convention,
        "mass_scale": mass_scale_of(context.config),
        **_scale_transfer(context),
        "events": rows.number,
        "status": dict(sorted(rows.status.items())),
        **({"no_events": rows.left_out} if rows.left_out else {}),
        "frames_before": list(compared.frames_before),
        "frames_after": list(compared.frames_after),
        "power_ratio": compared.power_ratio,
        "power_spread": _spread(compared.power),
        "masked_pixels": compared.masked_pixels,
        "detection_threshold_snr": context.templates.threshold,
        "medians": {
            "mass_kda": _median(good["mass_kda"]),
            "contrast": _median(good["contrast"]),
            "n_scattered": _median(good["n_scattered"]),
        },
        "precision": precision,
        "seconds": {name: round(value, 3) for name, value in timings.items()},
    }


def _scale_transfer(context: AnalysisContext) -> dict[str, Any]:
    """Describe how the mass scale was transferred from the optics of its standards."""
    scale = context.model.scale
    if scale.calibration is None:
        return {}
    return {
        "scale": {
            "carried": scale.carried,
            "optics": "configured" if scale.calibration.optics_assumed else "recorded",
            "refusal": scale.refusal or None,
        }
    }


def species_of(
    context: AnalysisContext,
    table: pd.DataFrame,
    searched: float | None = None,
    tracks: pd.DataFrame | None = None,
) -> dict[str, Any]:
    """Describe the species of all events, or the sizes of all spheres.

    `searched` is the share of field and time that was searched.
    """
    if context.config.fits_sizes:
        seed = context.config.compute.seed
        found = sizes_of_tracks(tracks, seed) if tracks is not None else _sizes(context, table)
        return {
            "distribution": None,
            "across_particles": [],
            "sizes": None if found is None else found.to_dict(),
        }
    used, notes = records.species_rows(table)
    distribution = _distribution(context, used, searched or 1.0)
    if distribution is not None:
        distribution["notes"].extend(notes)
    return {"distribution": distribution, "across_particles": species_width(used, distribution)}


def _sizes(context: AnalysisContext, table: pd.DataFrame) -> Sizes | None:
    """Describe the diameters of spheres that were fitted once each, of rows that are ok."""
    good = table[table["status"] == Status.OK]
    findings = []
    # Standard deviations above the threshold from which hardly any sphere is missed.
    near = good.loc[good["snr"] < context.templates.threshold + 3.0, "diameter_nm"]
    if near.size:
        ends = {"least_nm": number(near.min()), "most_nm": number(near.max())}
        ends |= {"amount": count(near.size, "sphere"), "verb": are(near.size)}
        findings.append(SPHERES_MISSED(ends))
    common = _systematic_share(good, "diameter_nm")
    return _sizes_in(good, "diameter_nm", context.config.compute.seed, common, findings)


def _sizes_in(
    good: pd.DataFrame, column: str, seed: int, common: float, findings: list[Finding]
) -> Sizes | None:
    diameter, sigma = (good[name].to_numpy(float) for name in (column, f"sigma_{column}"))
    return describe_sizes(diameter, sigma, seed=seed, common=common, findings=findings)


def _systematic_share(good: pd.DataFrame, column: str) -> float:
    """Give the median systematic error of a column over its value; 0 where none is known."""
    error = good.get(f"systematic_{column}", math.nan)
    return _median(error / good[column]) or 0.0


def sizes_of_tracks(tracks: pd.DataFrame, seed: int) -> Sizes | None:
    """Describe the diameters that the pictures of tracks show.

    What is wrong with the motion of a track says nothing of its pictures, and leaving out those
    that are near the wall would leave out the large ones.
    """
    if "optical_diameter_nm" not in tracks:
        return None
    flags = tracks["flags"].astype(str).str.split(";")
    good = tracks[[not _NO_SIZE & set(each) for each in flags]]
    findings = []
    if len(good) < len(tracks):
        left_out = count(len(tracks) - len(good), "track")
        findings.append(TRACKS_LEFT_OUT({"amount": left_out, "tracks": len(tracks)}))
    # a third, as the mass goes with the cube of the diameter
    common = _systematic_share(good, "mass_kda") / 3
    return _sizes_in(good, "optical_diameter_nm", seed, common, findings)


def _repeats(found: EmpiricalSpread) -> dict[str, Any]:
    """Summarise a measured spread."""
    return {
        "repeat_over_crb": found.over_crb,
        "repeat_over_crb_ci95": list(found.ci95),
        "repeat_significance": found.significance,
        "repeat_events": found.events,
        "repeat_whole": found.whole,
        "repeat_frames": list(found.frames),
        "repeat_over_crb_by_frames": list(found.by_frames),
        "repeat_over_crb_by_frames_se": list(found.by_frames_se),
        "empty_over_crb": list(found.empty),
    }


def _holevo_over_quantum(context: AnalysisContext, z_nm: FloatArray) -> dict[str, FloatArray]:
    """Cost of fitting height and mass at once, of each particle, by parameter.

    It depends on the height through the evanescent waves alone, and smoothly: it is computed at
    some heights, and linear in between.
    """
    free = FREE_PARAMETERS[context.mode]
    heights = np.linspace(max(z_nm.min(), 0.0), max(z_nm.max(), 1.0), 65)
    costs = [holevo_over_quantum(context.model, float(z), free) for z in heights]
    return {name: np.interp(z_nm, heights, [cost[name] for cost in costs]) for name in free}


def _distribution(
    context: AnalysisContext, good: pd.DataFrame, searched: float
) -> dict[str, Any] | None:
    """Describe the species where masses were fitted, each event once.

    The matched filter's standard deviation is what its snr makes of each mass.
    """
    if "mass_kda" not in FREE_PARAMETERS[context.mode] or MODES[context.mode].follows_tracks:
        return None
    mass, sigma = (good[name].to_numpy(float) for name in ("mass_kda", "sigma_mass_kda"))
    efficiency = None
    if len(good) >= LEAST_EVENTS:  # fewer have no species whose numbers it would correct
        efficiency = filter_efficiency(good, context.templates.threshold, searched)
    found = describe(
        mass,
        sigma,
        efficiency=efficiency,
        seed=context.config.compute.seed,
        scale_error=shared_error(good),
        window_frames=int(good["n_after"].max()) if len(good) else None,
    )
    return found.to_dict()


def species_width(
    used: pd.DataFrame, distribution: Mapping[str, Any] | None
) -> list[dict[str, Any]]:
    """Compare the width of each species with the σ of its events."""
    found = distribution["species"] if distribution is not None else []
    species = [one for one in found if not one.get("background")]
    if not species:
        return []
    means = np.array([one["mass_kda"] for one in species])
    sizes = used["mass_kda"].abs().to_numpy(float)
    nearest = np.argmin(np.abs(sizes[:, None] - means), axis=1)
    across = []
    for k, one in enumerate(species):
        sigma_median = _median(used["sigma_mass_kda"].to_numpy(float)[nearest == k])
        if one["outlier"] or not sigma_median:
            continue
        keys = ("mass_kda", "width_kda", "width_low", "width_high", "count")
        over = np.hypot(1.0, one["width_kda"] / sigma_median)
        across.append({**{key: one[key] for key in keys}, "spread_over_sigma": float(over)})
    return across


def _median(values: pd.Series[float] | FloatArray) -> float | None:
    finite = np.asarray(values, dtype=float)
    finite = finite[np.isfinite(finite)]
    return float(np.median(finite)) if finite.size else None


def _spread(power: FloatArray) -> float:
    """Give the standard deviation of the light of the frames in which it is known."""
    known = power[np.isfinite(power)]
    return float(np.std(known)) if known.size else 0.0


def mass_scale_of(config: Config) -> str:
    """Say where the masses come from: standards, the volume of spheres, or the model alone."""
    if config.fits_sizes:
        return "volume and density"
    return "calibration" if config.calibration else records.MODEL_SCALE


def reported_rows(
    found: DetectionResult, summary: Mapping[str, Any] = MappingProxyType({})
) -> tuple[pd.DataFrame, Checked, list[dict[str, Any]]]:
    """Make the rows of all events of a movie; the summary has sections on optics and camera."""
    config, mode = found.context.config, found.context.mode
    seen = checked(found)
    fits = seen.fits
    columns: dict[str, pd.Series | FloatArray] = {
        name: fits[name] * factor for name, factor in seen.scale.items()
    }
    unfit, threshold = systematic.misfit_error(fits, found.context.roi_px**2), 0.0
    if not MODES[mode].follows_tracks:
        threshold = found.context.templates.threshold
    elif summary.get("optics"):  # which were tested
        from iscat_analysis.tracking.optics import mass_error

        unfit = mass_error(summary["optics"])
    shared = systematic.contributions(
        config, fits, summary,
        mass_share=unfit, scale=found.context.model.scale, held_kda=seen.shifts_kda,
        threshold_snr=threshold,
    )  # fmt: skip
    for name, error in systematic.total(shared, len(fits)).items():
        columns[f"systematic_{name}"] = error
    if found.repeats:
        columns |= repeat_columns(mode, fits, found.repeats)
    table = make_rows(fits, columns)
    if "z_nm" not in FREE_PARAMETERS[mode]:  # what is no dipole has no mass, and no error of one
        kinds = table.columns.intersection(["repeat_mass_kda", "systematic_mass_kda"])
        table[kinds] = table[kinds].where(table["mass_kda"].notna(), np.nan, axis=0)
    if config.fits_sizes:
        table = records.with_diameters(table, config.particle.density)
    budget: list[dict[str, Any]] = []
    if "mass_kda" in FREE_PARAMETERS[mode]:
        unknown = None if config.calibration else systematic.SCALE
        if config.fits_sizes:
            unknown = systematic.SPHERES
        scaled = config.fit.sigma == "measured"
        budget = systematic.budget_of(table, shared, seen.achieved, unknown=unknown, scaled=scaled)
    return table, seen, budget


CHECKS: tuple[Callable[[DetectionResult, pd.DataFrame], Finding | None], ...] = (
    lambda found, _: diagnosis.scale_warning(found.context.model.scale),
    lambda found, table: diagnosis.line_warning(found.context.config, table),
    lambda found, table: diagnosis.nonlinearity_warning(found.context.model.scale, table),
    lambda found, table: diagnosis.sign_warning(found.context.config, table),
    lambda found, table: diagnosis.large_warning(found.context.config, table),
    lambda found, table: diagnosis.landing_rate_warning(table) if _slides(found) else None,
    lambda found, table: (
        diagnosis.residue_warning(table, found.summary["window_frames"]) if _slides(found) else None
    ),
)
"""What the events of a movie and the table of their rows tell together."""


def _slides(found: DetectionResult) -> bool:
    return found.context.config.background.slides


def make_analysis(
    kind: Kind,
    ready: Prepared,
    run: Run,
    found: DetectionResult,
    extra: Mapping[str, Any],
    *,
    command: str,
    started: str,
) -> Analysis:
    """Put everything that is reported of a movie into an `Analysis`."""
    if found.interrupted:  # what was finished is now gathered and kept, which takes a moment
        run.progress("report", 0, 1)
        run = replace(run, progress=records.silent)  # another stage would end the time to write
    context, compared = found.context, found.compared
    config = context.config
    further = {**ready.summary, **({kind.heading: found.summary} if found.summary else {})}
    if found.optics:
        further["optics"] = found.optics
    further |= extra
    table, seen, budget = reported_rows(found, further)
    recorded = ready.whole.metadata.ticks
    ticks = None if recorded is None else np.array(recorded)
    if ticks is not None and table["frame"].notna().all():
        table = make_rows(table, {"tick": ticks[table["frame"].to_numpy(int)]})
    for flag in ready.flags:
        table = flagged(table, flag)
    scale = context.model.scale
    further |= seen.sections
    uneven = reference_map(config, table)
    run.report(*seen.findings, uneven and uneven.finding)
    run.report(*(check(found, table) for check in CHECKS))
    if found.repeats:
        further["repeats"], understated = _judge_spread(found, seen, table)
        run.report(understated)
    elif config.fit.sigma == "measured" and len(table):
        run.report(SPREAD_NOT_MEASURED())
    tracks, films, of_tracks = _tracks(ready, run, found, table, ticks)
    further |= of_tracks
    if scale.refusal:
        table = flagged(table, Status.UNCALIBRATED_OPTICS)
        tracks = None if tracks is None else flagged(tracks, TrackStatus.UNCALIBRATED_OPTICS)
    # frames are read and transformed while the species are found
    timeline_future = start_in_thread(timeline_of, ready, found, table)
    searched = found.summary.get("searched_share") if found.summary else None
    described = species_of(context, table, searched, tracks)
    explained = {"explained_kda": systematic.explained_kda(budget)}
    described["across_particles"] = [one | explained for one in described["across_particles"]]
    calibrated = config.calibration is not None or config.fits_sizes
    run.report(systematic.wide_species(described["across_particles"], calibrated=calibrated))
    timeline = timeline_future.result()
    summary = summary_of(context, table, compared, run.clock.seconds, seen.achieved)
    provenance = records.Provenance(
        command=printable(command) or "iscat_analysis.pipeline.analyse",
        input_path=printable(str(ready.whole.path)),
        input_sha256=ready.movie.hashed().result(),
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
        "interrupted": found.interrupted,
        "findings": run.findings.summary,
        "warnings": warnings_in(run.findings.made),
        **described,
    }
    spans = compared.frames_before, compared.frames_after
    both = np.concatenate([np.arange(*span, dtype=np.int64) for span in spans])
    frames, first = np.unique(both, return_index=True)
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
        response=ready.known.response.table if ready.known.response is not None else None,
    )


def _judge_spread(
    found: DetectionResult, seen: Checked, table: pd.DataFrame
) -> tuple[dict[str, Any], Finding | None]:
    """Compare the spread between parts of the frames with the bound."""
    config = found.context.config
    fluctuates = seen.fluctuation is not None and seen.fluctuation.is_seen
    had = ("mass_kda",) if fluctuates else ()  # by σ
    return spread_verdict(
        {name: one for name, one in seen.achieved.items() if name not in had},
        found.summary,
        scaled=config.fit.sigma == "measured",
        rejected=records.is_rejected(table),
        sliding=config.background.slides,
    )


def _tracks(
    ready: Prepared,
    run: Run,
    found: DetectionResult,
    table: pd.DataFrame,
    ticks: NDArray[Any] | None,
) -> tuple[pd.DataFrame | None, tuple[records.Film, ...], Mapping[str, Any]]:
    """Describe particles that were followed, draw films of some, and summarise them."""
    context, followed = found.context, found.followed
    if followed is None:
        return None, (), {}
    from iscat_analysis.tracking.tracks import common_motion, make_films, tracks_of

    tracks, summary, findings = tracks_of(
        context, table, followed.windows,
        masses=followed.masses, ticks=ticks, progress=run.progress,
    )  # fmt: skip
    run.report(*findings, *common_motion(table, context.config.camera.frame_rate_hz, ticks))
    run.report(diagnosis.fixed_height_warning(context.config, table))
    backgrounds = followed.parts or (followed.windows,)
    films = make_films(context, ready.steady, ready.camera, backgrounds, table, tracks)
    run.clock.lap("tracks")
    return tracks, films, summary
