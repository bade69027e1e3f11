"""The main job, file in and folder out, in every scheme and with every kind of background."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import tifffile
from scenes import make_config

from iscat_analysis.config import Config, load_config
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.pipeline import fit_stack
from iscat_analysis.records import (
    EVENT_COLUMNS,
    FREE_PARAMETERS,
    PARAMETERS,
    REPEAT_COLUMNS,
    Analysis,
)
from iscat_analysis.study import write_stack

SIGMAS = 4.0
# Smaller tests look at some 60 pulls together: one beyond 5 is a chance of 3e-5.
FAR = 5.0
BOUND_REACHED = 0.05
HEAVY = ("systematic_mass_kda",)
"""The light that does not interfere, of 1.7 MDa, is more than half an error of the mass."""

SMALL = {
    "background": {"frames": [0, 30]},
    "fit": {"frames": [30, 60]},
    "simulation": {
        "shape": [72, 68],
        "frames": 60,
        "background": "speckle",
        "power_noise": 0.01,
        "photons_per_pixel": 4e4,
        "events": [
            {"frame": 30, "x_px": 19.3, "y_px": 20.8},
            {"frame": 30, "x_px": 48.1, "y_px": 48.6, "mass_kda": 1700.0},
        ],
    },
}

AS_CONFIGURED = {"optics": {"calibrate": "never"}, "fit": {"frames": [30, 60], "spheres": []}}
"""Where nothing judged needs optics learned or spheres tried, which take most of the time."""


def _small(**sections: dict[str, Any]) -> Config:
    merged = {name: {**SMALL.get(name, {}), **sections.get(name, {})}
              for name in {*SMALL, *sections}}  # fmt: skip
    calibrated = merged.pop("calibrated", {"yes": True})
    return make_config(calibrated=bool(calibrated), **merged)


def _run(config: Config, folder: Path, **options: Any) -> tuple[Analysis, pd.DataFrame]:
    movie = folder / "movie.tif"
    truth = write_stack(config, movie)
    return fit_stack(movie, config, **options), truth


def _run_with(folder: Path, *places: tuple[Any, int, int], count: int) -> tuple[Analysis, Any]:
    """Analyse a movie some of whose counts are replaced."""
    movie = folder / "movie.tif"
    config = _small(**AS_CONFIGURED)
    truth = write_stack(config, movie)
    counts = tifffile.imread(movie)
    for place in places:
        counts[place] = count
    tifffile.imwrite(movie, counts, photometric="minisblack")
    return fit_stack(movie, config), truth


def _match(table: pd.DataFrame, truth: pd.DataFrame) -> pd.DataFrame:
    """Estimates in the order of the truth; every particle once, and nothing else."""
    apart = np.hypot(
        table["x_px"].to_numpy()[:, None] - truth["x_px"].to_numpy(),
        table["y_px"].to_numpy()[:, None] - truth["y_px"].to_numpy(),
    )
    assert len(table) == len(truth)
    partner = apart.argmin(axis=0)
    assert sorted(partner) == list(range(len(truth)))
    assert apart.min(axis=0).max() < 1
    return table.iloc[partner].reset_index(drop=True)


def _assert_true(table: pd.DataFrame, truth: pd.DataFrame, mode: str) -> None:
    fits = _match(table, truth)
    assert set(fits["status"]) == {"ok"}, fits[["status", "p_value", "chi2_reduced"]]
    for name in FREE_PARAMETERS[mode]:
        pulls = (fits[name] - truth[name]) / fits[f"sigma_{name}"]
        assert pulls.abs().max() < FAR, (name, pulls)
        assert (fits[f"sigma_{name}"] / fits[f"crb_{name}"] - 1).abs().max() < BOUND_REACHED, name
        assert (fits[f"qcrb_{name}"] < fits[f"crb_{name}"]).all()


# ---- folder ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sampled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Analysis, pd.DataFrame]:
    """Run once, in mode joint, with the posterior."""
    folder = tmp_path_factory.mktemp("sampled")
    config = _small(
        optics={"focus_nm": -500.0},
        fit={"mode": "joint", "z_range_nm": [0.0, 300.0]},
        posterior={"enabled": True, "walkers": 16, "steps": 700},
    )
    analysis, truth = _run(config, folder, out=folder / "out")
    return folder, analysis, truth


def test_columns_are_the_promised_ones(sampled) -> None:
    folder, analysis, truth = sampled
    table = pd.read_csv(folder / "out" / "fits.csv")
    assert tuple(table.columns) == (*EVENT_COLUMNS, *HEAVY, *REPEAT_COLUMNS)
    assert tuple(analysis.table.columns) == (*EVENT_COLUMNS, *HEAVY, *REPEAT_COLUMNS)
    for name in PARAMETERS:  # of eight parts before and after: 14 degrees of freedom
        assert ((table[f"repeat_{name}"] / table[f"crb_{name}"]).between(0.3, 2.0)).all()
    _assert_true(table, truth, "joint")
    assert (table["frame"] == 30).all()
    np.testing.assert_allclose(table["x_nm"], table["x_px"] * 84.4, rtol=1e-6)
    np.testing.assert_allclose(table["y_nm"], table["y_px"] * 84.4, rtol=1e-6)


def test_parquet_holds_what_csv_holds(sampled) -> None:
    folder, analysis, _ = sampled
    parquet = pd.read_parquet(folder / "out" / "fits.parquet")
    assert tuple(parquet.columns) == (*EVENT_COLUMNS, *HEAVY, *REPEAT_COLUMNS)
    csv = pd.read_csv(folder / "out" / "fits.csv", dtype={"flags": str}, keep_default_na=False,
                      na_values={name: [""] for name in EVENT_COLUMNS[:-2]})  # fmt: skip
    for name in EVENT_COLUMNS:
        if name in ("status", "flags"):
            assert parquet[name].tolist() == csv[name].tolist()
        else:
            np.testing.assert_allclose(parquet[name], csv[name], rtol=1e-8)
            np.testing.assert_allclose(parquet[name], analysis.table[name], rtol=1e-15)


def test_posterior_reads_back(sampled) -> None:
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about arviz's own next version
        import arviz

    folder, analysis, _ = sampled
    data = arviz.from_netcdf(folder / "out" / "posterior.nc")
    views = {view.event: view.posterior for view in analysis.views}
    assert all(p is not None and p.converged for p in views.values())
    text = str(data.posterior)
    for name in ("x_nm", "y_nm", "z_nm", "mass_kda"):
        assert name in text
    table = analysis.table
    for view in analysis.views:
        row = table[table["event"] == view.event].iloc[0]
        for k, name in enumerate(view.posterior.names):
            draws = view.posterior.samples[..., k]
            error = row[f"sigma_{name}"] / np.sqrt(view.posterior.ess_bulk[k])
            assert abs(draws.mean() - row[name]) < 6 * error + 0.1 * row[f"sigma_{name}"]


def test_the_written_configuration_gives_the_same_table(sampled, tmp_path: Path) -> None:
    folder, analysis, _ = sampled
    again = load_config(folder / "out" / "config.toml", ["posterior.enabled=false"])
    second = fit_stack(folder / "movie.tif", again, out=tmp_path / "again")
    pd.testing.assert_frame_equal(analysis.table, second.table)
    original, rerun = (
        pd.read_csv(f / "fits.csv") for f in (folder / "out", tmp_path / "again")
    )  # fmt: skip
    pd.testing.assert_frame_equal(original, rerun)


def test_the_summary_counts_and_names(sampled) -> None:
    folder, analysis, _ = sampled
    summary = json.loads((folder / "out" / "summary.json").read_text())
    assert summary["events"] == 2
    assert summary["status"] == {"ok": 2}
    assert summary["frames_before"] == [0, 30]
    assert len(summary["input"]["sha256"]) == 64
    assert summary["precision"]["mass_kda"]["sigma_over_crb_median"] == pytest.approx(1, abs=0.05)
    assert "iscat-analysis" in summary["versions"]
    assert analysis.provenance.input_sha256 == summary["input"]["sha256"]


def test_workers_do_not_change_results(tmp_path: Path) -> None:
    config = _small(**AS_CONFIGURED, posterior={"enabled": True, "walkers": 10, "steps": 200})
    path = tmp_path / "movie.tif"
    write_stack(config, path)
    runs = []
    for workers in (1, 2):
        resolved = config.model_copy(
            update={"compute": config.compute.model_copy(update={"workers": workers})}
        )
        runs.append(fit_stack(path, resolved, out=tmp_path / f"out{workers}"))
    pd.testing.assert_frame_equal(runs[0].table, runs[1].table, check_exact=True)
    for one, two in zip(runs[0].views, runs[1].views, strict=True):
        np.testing.assert_array_equal(one.posterior.samples, two.posterior.samples)


# ---- other schemes -------------------------------------------------------------------------------

GOLD = {"kind": "gold", "mass_kda": None, "diameter_nm": 30.0}
GOLD_EVENTS = [
    {"frame": 30, "x_px": 19.3, "y_px": 20.8},
    {"frame": 30, "x_px": 48.1, "y_px": 48.6, "mass_kda": 2.5e5},
]


GOLD_IN_ISCAT = {
    "calibrated": {},
    "particle": GOLD | {"height_nm": 60.0},
    # of seed 1 the contrast fluctuates with a probability of 0.11, which is in the error
    "simulation": {"events": [GOLD_EVENTS[0]], "photons_per_pixel": 1e4, "seed": 2},
}
WAYS = {
    "cobri": {
        "calibrated": {},
        "optics": {"scheme": "cobri", "attenuation": 0.06, "na": 1.3, "focus_nm": 0.0},
        "particle": GOLD,
        "simulation": {"events": GOLD_EVENTS, "photons_per_pixel": 1e4},
    },
    "gold, mass": GOLD_IN_ISCAT | {"fit": {"mode": "mass", "z_range_nm": [0.0, 150.0]}},
    "gold, localize": GOLD_IN_ISCAT | {"fit": {"mode": "localize", "z_range_nm": [0.0, 150.0]}},
    "median": {"background": {"method": "median"}},
    "known": {
        "background": {"method": "known", "level_e": 4e4}, "simulation": {"background": "flat"},
    },
    "same power": {
        "background": {"power_normalization": False},
        "simulation": {"background": "flat", "power_noise": 0.0},
    },
    "poisson": {"fit": {"likelihood": "poisson"}},
}  # fmt: skip


@pytest.mark.parametrize("sections", WAYS.values(), ids=WAYS.keys())
def test_every_scheme_and_background_gives_the_truth(sections: dict, tmp_path: Path) -> None:
    analysis, truth = _run(_small(**sections), tmp_path)
    _assert_true(analysis.table, truth, analysis.mode)


DARK_FIELD = {
    "calibrated": {},
    "optics": {"scheme": "darkfield", "focus_nm": -400.0},
    "particle": GOLD,
}


@pytest.mark.parametrize(
    ("level_e", "camera"),
    [(20.0, {}), (None, {"offset_adu": 100.0, "read_noise_e": 2.0}), (0.05, {})],
)
def test_dark_field(level_e: float | None, camera: dict, tmp_path: Path) -> None:
    """Photons on a weak background, on read noise alone, and on next to nothing.

    At 0.1 false alarms per movie some noise holds one; that of this seed holds none.
    """
    config = _small(
        **DARK_FIELD,
        camera={"gain_e_per_adu": 1.0, **camera},  # which little light does not tell
        background={"level_e": level_e},
        simulation={
            "events": [GOLD_EVENTS[0]], "photons_per_pixel": 800.0, "background": "flat",
            "seed": 12,
        },
    )  # fmt: skip
    analysis, truth = _run(config, tmp_path)
    assert analysis.summary["masked_pixels"] == 0
    assert not analysis.warnings  # nothing is said of a gain that no light shows
    _assert_true(analysis.table, truth, "mass")
    assert analysis.table["contrast"].isna().all()


@pytest.mark.parametrize(
    ("fit", "particle", "said"),
    [
        ({"likelihood": "conditional"}, {}, "conditional"),
        ({}, {"photons_per_frame": None}, r"particle\.photons_per_frame is needed in dark field"),
    ],
)
def test_dark_field_refuses_what_needs_a_reference(
    fit: dict, particle: dict, said: str, tmp_path: Path
) -> None:
    """It takes no scale from the simulation either."""
    config = _small(**DARK_FIELD, background={"level_e": 20.0}, fit=fit)
    movie = tmp_path / "movie.tif"
    write_stack(config, movie)
    changed = config.particle.model_copy(update=particle)
    with pytest.raises(ConfigError, match=said):
        fit_stack(movie, config.model_copy(update={"particle": changed}))
    assert not movie.with_suffix(".iscat").exists()


# ---- other backgrounds, cameras and metadata -----------------------------------------------------


@pytest.mark.parametrize("told", [True, False])
def test_gain_offset_and_read_noise(told: bool, tmp_path: Path) -> None:
    camera = {"gain_e_per_adu": 2.3, "offset_adu": 120.0, "read_noise_e": 60.0}
    config = _small(camera=camera, optics={"calibrate": "never"})
    movie = tmp_path / "movie.tif"
    truth = write_stack(config, movie)
    if told:
        analysis = fit_stack(movie, config)
        _assert_true(analysis.table, truth, "mass")
        assert not analysis.warnings
    else:
        analysis = fit_stack(movie, _small(camera={"gain_e_per_adu": 1.0, "offset_adu": 120.0}))
        assert any("gain_e_per_adu" in text for text in analysis.warnings)


def test_maps_of_gain_and_offset(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    maps = {
        "gain_e_per_adu": rng.uniform(1.5, 2.5, (72, 68)),
        "offset_adu": rng.uniform(90, 110, (72, 68)),
        "read_noise_e": rng.uniform(1, 60, (72, 68)),
    }
    camera = {}
    for key, values in maps.items():
        camera[key] = str(tmp_path / f"{key}.tif")
        tifffile.imwrite(camera[key], values.astype("f4"), photometric="minisblack")
    analysis, truth = _run(_small(**AS_CONFIGURED, camera=camera), tmp_path)
    _assert_true(analysis.table, truth, "mass")


def test_a_dead_pixel_beside_a_particle_does_no_harm(tmp_path: Path) -> None:
    always = slice(None)
    analysis, truth = _run_with(tmp_path, (always, 21, 20), (always, 48, 49), count=0)
    assert analysis.summary["masked_pixels"] == 2
    _assert_true(analysis.table, truth, "mass")


def test_the_pixel_size_comes_from_the_movie(tmp_path: Path) -> None:
    config = _small(**AS_CONFIGURED)
    movie = tmp_path / "movie.tif"
    truth = write_stack(config, movie)
    silent = config.camera.model_copy(update={"pixel_size_nm": None})
    analysis = fit_stack(movie, config.model_copy(update={"camera": silent}))
    assert analysis.pixel_size_nm == pytest.approx(84.4)
    _assert_true(analysis.table, truth, "mass")
    other = config.camera.model_copy(update={"pixel_size_nm": 90.0})
    disagreeing = fit_stack(
        movie, config.model_copy(update={"camera": other}), out=tmp_path / "other"
    )
    assert any("84.4" in text and "90" in text for text in disagreeing.warnings)


# ---- orientation, leaving, neighbours, saturation ------------------------------------------------


def test_right_and_down_are_larger(tmp_path: Path) -> None:
    """The counts themselves say where the particles are: no simulator decides this."""
    config = _small(**AS_CONFIGURED, simulation={"power_noise": 0.0})
    movie = tmp_path / "movie.tif"
    write_stack(config, movie)
    counts = tifffile.imread(movie).astype(float)
    change = counts[30:].sum(axis=0) / counts[:30].sum(axis=0) - 1
    change[:, :34] = 0  # leaves the one on the right
    row, column = np.unravel_index(np.argmin(change), change.shape)
    table = fit_stack(movie, config).table.sort_values("x_px")
    left, right = table.iloc[0], table.iloc[1]
    assert right["x_px"] == pytest.approx(column, abs=0.7)
    assert right["y_px"] == pytest.approx(row, abs=0.7)
    assert right["x_px"] > left["x_px"]
    assert right["y_px"] > left["y_px"]


def test_a_particle_that_leaves_has_negative_mass(tmp_path: Path) -> None:
    events = [{"frame": 0, "leave": 30, "x_px": 30.0, "y_px": 40.0, "mass_kda": 1500.0}]
    analysis, truth = _run(_small(**AS_CONFIGURED, simulation={"events": events}), tmp_path)
    (row,) = analysis.table.to_dict("records")
    assert row["status"] == "ok"
    assert row["mass_kda"] == pytest.approx(-truth["mass_kda"][0], abs=FAR * row["sigma_mass_kda"])


def test_neighbours_are_told_apart_and_flagged(tmp_path: Path) -> None:
    events = [
        {"frame": 30, "x_px": 30.0, "y_px": 40.0, "mass_kda": 1500.0},
        {"frame": 30, "x_px": 34.6, "y_px": 40.0, "mass_kda": 2000.0},
    ]
    analysis, truth = _run(_small(**AS_CONFIGURED, simulation={"events": events}), tmp_path)
    fits = _match(analysis.table, truth)
    assert set(fits["status"]) == {"too_close"}
    pulls = (fits["mass_kda"] - truth["mass_kda"]) / fits["sigma_mass_kda"]
    assert pulls.abs().max() < FAR


def test_saturation_beside_a_particle_is_flagged(tmp_path: Path) -> None:
    analysis, truth = _run_with(tmp_path, (40, 22, 21), count=65535)
    fits = _match(analysis.table, truth)
    assert fits["status"].tolist() == ["saturated", "ok"]
    assert any("saturated" in text for text in analysis.warnings)


def test_nothing_is_found_where_nothing_is(tmp_path: Path) -> None:
    analysis, _ = _run(_small(simulation={"events": []}), tmp_path)
    assert analysis.table.empty
    # no particle tests the optics, so that places are as uncertain as they are
    assert tuple(analysis.table.columns) == (
        *EVENT_COLUMNS, "systematic_x_nm", "systematic_y_nm", *HEAVY,
    )  # fmt: skip
    assert (tmp_path / "movie.iscat" / "report.html").is_file()


def test_progress_runs_to_its_end(tmp_path: Path) -> None:
    seen: dict[str, tuple[int, int]] = {}
    notes: list[str] = []

    def progress(stage: str, done: int, total: int) -> None:
        assert 0 <= done <= total
        assert seen.get(stage, (0, total))[0] <= done
        seen[stage] = (done, total)

    _run(_small(), tmp_path, progress=progress, notify=notes.append)
    assert {"background", "detect"} <= set(seen)
    assert all(done == total for done, total in seen.values())


def test_a_field_smaller_than_the_region_is_refused(tmp_path: Path) -> None:
    config = _small(fit={"roi_nm": 7000.0})
    movie = tmp_path / "movie.tif"
    write_stack(config, movie)
    with pytest.raises(ConfigError, match=r"fit\.roi_nm = 7000.*72 x 68|68"):
        fit_stack(movie, config)
    with pytest.raises(DataError, match="absent"):
        fit_stack(tmp_path / "absent.tif", config)


@pytest.mark.parametrize("moves", [False, True])
def test_noise_and_drift_of_the_background(moves: bool, tmp_path: Path) -> None:
    rate = (0.002, -0.001) if moves else (0.0, 0.0)
    found, _ = _run(_small(**AS_CONFIGURED, simulation={"drift_px_per_frame": rate}), tmp_path)
    background = found.summary["background"]
    assert background["noise_frames"] == [1, 2, 3, 5, 7, 10, 15]
    # 16 rows of 68 pixels: robust variances are good to 1.65 √(2/1088), a few per cent.
    np.testing.assert_allclose(background["noise_variance_over_shot"][:3], 1, atol=0.3)
    assert (background["noise_variance_over_shot"][-1] > 2) == moves
    # Frames 0 to 29 against 30 to 59.
    truth = 30 * np.array(rate[::-1])
    pulls = (np.array(background["drift_px"]) - truth) / background["drift_error_px"]
    assert np.abs(pulls).max() < SIGMAS
    assert any("fixed pattern moved" in text for text in found.warnings) == moves


def test_no_drift_where_there_is_no_pattern(tmp_path: Path) -> None:
    found, _ = _run(_small(**AS_CONFIGURED, simulation={"background": "flat"}), tmp_path)
    assert found.summary["background"]["drift_px"] is None
