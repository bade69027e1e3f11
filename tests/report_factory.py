"""Synthetic analyses for the tests of the report: plausible numbers, no physics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
from walkers import SETUP

from iscat_analysis.config import config_to_toml, parse_config
from iscat_analysis.findings.files import FILE_IMPLIES
from iscat_analysis.records import (
    EVENT_COLUMNS,
    FREE_PARAMETERS,
    Analysis,
    Clip,
    EventView,
    Film,
    PosteriorResult,
    Provenance,
    Status,
    Trace,
)
from iscat_analysis.species import describe_tracks

FRAMES_OF_TRACK = 10
HOSTILE = "/data/<script>alert(1)<img src=x onerror=alert(2)> & 'run' \"7\".tif"
PIXEL_NM = 84.4


OF_A_MOVIE = {Status.UNCALIBRATED_OPTICS, Status.NONLINEAR, Status.PROCESSED}
"""What all rows of a movie are flagged with."""


def spot(side: int, x: float, y: float, width: float) -> np.ndarray:
    rows, columns = np.mgrid[:side, :side]
    r = np.hypot(rows - y, columns - x)
    return np.asarray(np.exp(-((r / width) ** 2) / 2) * np.cos(r / width * 1.9))


def posterior_of(
    names: tuple[str, ...], centre: np.ndarray, sigma: np.ndarray, rng: np.random.Generator,
    *, converged: bool = True, draws: int = 60,
) -> PosteriorResult:  # fmt: skip
    n = len(names)
    mixing = np.eye(n) + 0.4 * np.tri(n, k=-1)
    samples = centre + sigma * (rng.standard_normal((16, draws, n)) @ mixing.T)
    return PosteriorResult(
        names=names,
        samples=samples,
        log_likelihood=-rng.chisquare(n, (16, draws)) / 2,
        tau=np.full(n, 21.0),
        r_hat=np.full(n, 1.004 if converged else 1.31),
        ess_bulk=np.full(n, 900.0),
        ess_tail=np.full(n, 850.0),
        acceptance=0.42,
        converged=converged,
        message="all criteria hold"
        if converged
        else "not converged: split R-hat of z_nm is 1.31 (needs < 1.01); raise posterior.steps",
    )


def make_analysis(
    n: int = 40, mode: str = "mass", *, scheme: str = "iscat", posteriors: int = 0,
    refused: int = 0, seed: int = 3, side: int = 32, field: int = 128,
) -> Analysis:  # fmt: skip
    """Invent an analysis of `n` events (rows in track mode, `FRAMES_OF_TRACK` to a track)."""
    rng = np.random.default_rng(seed)
    free = FREE_PARAMETERS[mode]
    dark = scheme == "darkfield"
    mass = rng.choice([66.0, 146.0, 480.0], n) * rng.normal(1, 0.04, n)
    mass[::9] *= -1
    height = rng.gamma(4, 40, n) if "z_nm" in free else np.full(n, 5.0)
    events = np.arange(n) // FRAMES_OF_TRACK if mode == "track" else np.arange(n)
    if mode == "track":
        mass = rng.choice([66.0, 146.0, 480.0], n)[events] * rng.normal(1, 0.04, n)
    x = rng.uniform(8, field - 8, n)
    y = rng.uniform(8, field - 8, n)
    if mode == "track":
        for event in np.unique(events):
            own = events == event
            steps = np.cumsum(rng.normal(0, 1.2, (own.sum(), 2)), axis=0)
            x[own], y[own] = x[own][0] + steps[:, 0], y[own][0] + steps[:, 1]
    base = {"x_nm": 2.1, "y_nm": 2.3, "z_nm": 9.0, "mass_kda": 4.2}
    table: dict[str, object] = {
        "event": events,
        "frame": np.sort(rng.integers(20, 900, n))
        if mode != "track"
        else 200 + np.arange(n) % FRAMES_OF_TRACK,
        "n_before": np.full(n, 200),
        "n_after": np.full(n, 200),
        "x_px": x,
        "y_px": y,
        "x_nm": x * PIXEL_NM,
        "y_nm": y * PIXEL_NM,
        "z_nm": height,
        "mass_kda": mass if "mass_kda" in free else np.full(n, 480.0),
        "contrast": np.abs(mass) * 12 if dark else -3.1e-5 * mass,
        "n_scattered": np.abs(mass) * 900,
        "snr": np.abs(mass) / 4.2,
        "chi2_reduced": rng.normal(1.0, 0.05, n),
        "p_value": rng.uniform(0, 1, n),
    }
    for name in ("x_nm", "y_nm", "z_nm", "mass_kda"):
        size = base[name] * (480 / np.abs(mass) if name != "mass_kda" else np.ones(n))
        crb = size * rng.lognormal(0, 0.06, n)
        known = name in free
        table[f"crb_{name}"] = crb if known else np.full(n, np.nan)
        table[f"sigma_{name}"] = crb * rng.lognormal(0.02, 0.02, n) if known else np.nan
        table[f"qcrb_{name}"] = crb * rng.normal(0.52, 0.03, n) if known else np.nan
    status = np.array([Status.OK.value] * n, dtype=object)
    flags = np.array([""] * n, dtype=object)
    of_a_row = set(Status) - {Status.OK} - OF_A_MOVIE
    for k, verdict in enumerate([s for s in Status if s in of_a_row]):
        rows = slice((5 + 6 * k) % 37, None, 41) if k < 7 else slice(1 + 6 * k, None, 211)
        status[rows] = verdict.value
        flags[rows] = f"{verdict.value};masked_pixels"
    frame = pd.DataFrame({**table, "status": status, "flags": flags}, columns=list(EVENT_COLUMNS))
    if n > 6:
        frame.loc[frame.index[5], [c for c in frame if c.startswith("sigma_")]] = np.nan
        frame.loc[frame.index[6], ["p_value", "qcrb_x_nm"]] = np.nan

    image = rng.normal(0, 0.0009, (field, field))
    views = []
    for i in range(n):
        peak = float(frame["contrast"].iloc[i])
        row, column = round(y[i]) - side // 2, round(x[i]) - side // 2
        model = peak * spot(side, x[i] - column, y[i] - row, 2.4)
        noise = 0.0009 if not dark else 30.0
        data = model + rng.normal(0, noise, model.shape)
        data[0, 0] = np.nan
        rows = slice(max(0, row), min(field, row + side))
        columns = slice(max(0, column), min(field, column + side))
        image[rows, columns] += model[
            rows.start - row : rows.stop - row, columns.start - column : columns.stop - column
        ]
        sampled = None
        if i < posteriors + refused:
            centre = frame.loc[frame.index[i], list(free)].to_numpy(float)
            sigma = np.array([frame[f"crb_{name}"].iloc[i] for name in free])
            sampled = posterior_of(
                free, centre, sigma, rng, converged=i >= refused, draws=60 + 5 * (i % 3)
            )
        views.append(EventView(int(events[i]), row, column, data, model, (data - model) / noise,
                               sampled))  # fmt: skip
    values = {"fit": {"mode": mode}, "optics": {"scheme": scheme, "attenuation": 0.1}}
    summary = summary_of(frame, mode, scheme)
    tracks, films = None, ()
    if mode == "track":
        _, first = np.unique(events, return_index=True)
        views = [views[k] for k in first]
        tracks = describe_tracks(frame, replace(SETUP, field_nm=(field * PIXEL_NM,) * 2))
        films = tuple(film_of(rng, track) for track in tracks["track"][:2])
        summary |= {"tracks": len(tracks), "motion": motion_of(tracks)}
    return Analysis(
        config_toml=config_to_toml(parse_config(values)),
        mode=mode,
        scheme=scheme,
        pixel_size_nm=PIXEL_NM,
        table=frame,
        views=tuple(views),
        ratio_image=image,
        power=1 + 0.004 * rng.standard_normal(400).cumsum() / 8,
        power_frames=np.arange(400),
        summary=summary,
        tracks=tracks,
        films=films,
        provenance=Provenance(
            command=f"iscat-fit {HOSTILE} --mode {mode} # </script><!--<script>",
            input_path=HOSTILE,
            input_sha256="9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08",
            versions={"iscat-analysis": "0.1.0", "python": "3.11.7", "numpy": "2.1.0"},
            seed=1,
            started="2024-05-06T07:08:09+00:00",
        ),
        findings=(FILE_IMPLIES({"text": "The TIFF says pixel_size_nm = 84.0, not 84.4."}),),
    )


def with_traces(analysis: Analysis) -> Analysis:
    """Give every event what those of landing movies have: a trace and a clip."""
    rng = np.random.default_rng(5)
    views = []
    for view, row in zip(analysis.views, analysis.table.itertuples(), strict=True):
        peak, leaves = -abs(row.contrast), row.mass_kda < 0
        before, after = (peak, 0.0) if leaves else (0.0, peak)
        first, turn = max(row.frame - 160, 0), row.frame
        frame = np.arange(first, turn + 160)
        contrast = np.where(frame < turn, before, after) + 0.001 * rng.standard_normal(frame.size)
        contrast[7] = np.nan
        trace = Trace(first, contrast, 0.001, turn, 2, (turn - 80, turn + 80), before, after)
        share = 1 - np.abs(np.arange(-6, 7)) / 6
        images = share[:, None, None] * (after - before) / peak * view.model[5:26, 5:26]
        images = images + 0.0002 * rng.standard_normal(images.shape)
        frames = tuple(turn + 13 * k for k in range(-6, 7))
        views.append(replace(view, trace=trace, clip=Clip(frames, 80, images.astype(np.float32))))
    return replace(analysis, views=tuple(views))


def film_of(rng: np.random.Generator, track: int) -> Film:
    """Invent six frames of a track."""
    model = np.array([spot(24, 11 + k / 2, 12.0, 2.4) for k in range(6)]) * -0.01
    noise = rng.normal(0, 1, model.shape)
    noise[0, 0, 0] = np.nan
    return Film(track, tuple(range(6)), "because it is <b>long</b>", model + 0.001 * noise, model,
                noise)  # fmt: skip


def motion_of(tracks: pd.DataFrame) -> dict[str, object]:
    """Say of invented tracks what a summary says."""
    return {
        "frame_rate_hz": 331.0, "exposure_ms": 2.5, "medians": {}, "flags": {},
        "status": tracks["status"].value_counts().to_dict(), "sigma_d_over_d_median": None,
        "begin_inside": 0, "end_inside": 0, "cross_border": len(tracks), "crossed": 0,
    }  # fmt: skip


def summary_of(table: pd.DataFrame, mode: str, scheme: str) -> dict[str, object]:
    """Say of an invented analysis what a summary must say."""
    medians = ("sigma", "crb", "qcrb", "sigma_over_crb", "information_fraction")
    return {
        "events": len(table),
        "mode": mode,
        "scheme": scheme,
        "emission": "reciprocal",
        "convention": "exact",
        "mass_scale": "calibration",
        "status": table["status"].value_counts().to_dict(),
        "frames_before": (0, 200),
        "frames_after": (200, 400),
        "power_ratio": np.nan,
        "power_spread": np.float64(0.004),
        "masked_pixels": np.int64(0),
        "detection_threshold_snr": 5.0,
        "medians": {},
        "budget": [
            {
                "name": name,
                "kind": kind,
                "common": common,
                "sigma_mass_kda": size,
                "dof": dof,
                "sigma_rel": None if size is None else size / 480,
                "remedy": "more light",
            }
            for name, kind, common, size, dof in (
                ("photon noise", "measured", False, 6.0, None),
                ("line of the standards", "measured", True, 4.8, 1.0),
                ("wavelength", "assumed", True, 3.6, None),
                ("scale of the model", "assumed", True, None, None),
            )
        ],
        "precision": {"x_nm": {f"{name}_median": 1.5 for name in medians}},
        "seconds": {"fit": np.float64(1.25)},
        "input": {"path": HOSTILE, "sha256": "0" * 64, "shape": [1000, 128, 128]},
        "seed": 1,
        "versions": {"iscat-analysis": "0.1.0", "python": "3.11.7", "numpy": "2.1.0"},
        "findings": [],
        "warnings": [],
        "efficiency": np.nan,
    }


def without_events(analysis: Analysis) -> Analysis:
    """Take every event out of an analysis."""
    tracks = None if analysis.tracks is None else analysis.tracks.iloc[:0]
    return replace(
        analysis, table=analysis.table.iloc[:0], views=(), findings=(), tracks=tracks, films=()
    )
