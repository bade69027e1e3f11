"""Events and tracks in the layouts of other programs, read back as those programs read them."""

from __future__ import annotations

import json
import math
import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
from report_factory import make_analysis
from walkers import EXPOSURE_MS, PIXEL_NM, RATE_HZ, SETUP, fits_of, walk

from iscat_analysis import to_napari, to_photomol, to_picasso, to_trackpy
from iscat_analysis.answers.calibrations import mass_calibration
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.movie.tables import TABLE_COLUMNS, read_events
from iscat_analysis.report.exchange import export_result
from iscat_analysis.species import describe_tracks
from iscat_analysis.species.tables import event_table
from iscat_cli import main

SIGMA_NM, D = 20.0, 0.4


def _fits(tracks: int = 30) -> pd.DataFrame:
    rng = np.random.default_rng(1)
    paths = [walk(rng, 100, D) for _ in range(tracks)]
    return fits_of(paths, rng, sigma_nm=SIGMA_NM, first=(0, 7)).sample(frac=1, random_state=2)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    fits = _fits(3)
    out = tmp_path / "moving.iscat"
    out.mkdir()
    fits.to_csv(out / "fits.csv", index=False)
    describe_tracks(fits, SETUP).to_csv(out / "tracks.csv", index=False)
    return out


def test_trackpy_finds_the_mean_squared_displacement_that_d_errors_and_blur_predict() -> None:
    import trackpy

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of trackpy's own, against new versions of pandas
        found = trackpy.imsd(to_trackpy(_fits()), PIXEL_NM / 1e3, RATE_HZ, max_lagtime=3)
    lag = found.index.to_numpy()
    blur_s = EXPOSURE_MS / 1e3 / 3
    predicted = 4 * D * (lag - blur_s) + 4 * (SIGMA_NM / 1e3) ** 2
    error = found.std(axis=1) / math.sqrt(found.shape[1])
    assert np.all(np.abs(found.mean(axis=1) - predicted) < 4 * error)
    table = to_trackpy(_fits(2))
    assert list(table.columns) == ["y", "x", "frame", "particle", "mass", "signal", "ep", "z"]
    assert np.allclose(table["ep"], SIGMA_NM / PIXEL_NM)
    assert table["frame"].dtype == table["particle"].dtype == np.int64
    assert table.groupby("particle")["frame"].is_monotonic_increasing.all()


def test_napari_is_given_sorted_tracks_with_each_frame_once() -> None:
    fits = _fits(3)
    doubled = pd.concat([fits, fits.iloc[:5]])
    array = to_napari(doubled)
    assert array.shape == (300, 4)
    assert np.all(np.diff(array[:, 0]) >= 0)  # as napari asks of its tracks
    for track in np.unique(array[:, 0]):
        assert np.all(np.diff(array[array[:, 0] == track, 1]) == 1)
    first = fits[(fits["event"] == 0) & (fits["frame"] == 0)].iloc[0]
    assert array[0].tolist() == [0, 0, first["y_px"], first["x_px"]]
    assert to_napari(fits.iloc[:0]).shape == (0, 4)
    assert to_trackpy(fits.iloc[:0]).empty


def test_the_command_writes_what_the_programs_read(folder: Path, capsys) -> None:
    export = ["export", str(folder), "--to"]
    assert main([*export, "trackpy"]) == 0
    written, array = folder.parent / "moving.trackpy.csv", folder.parent / "here.npy"
    assert f"3 tracks in {written}" in capsys.readouterr().out
    assert pd.read_csv(written)["particle"].nunique() == 3
    assert main([*export, "napari", "--out", str(array)]) == 0
    assert np.load(array).shape == (300, 4)
    assert main([*export, "trackpy"]) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert main([*export, "trackpy", "--overwrite"]) == 0


def test_what_cannot_be_exported_is_refused(folder: Path) -> None:
    def refused(layout: Any, match: str, out: Path | None = None) -> None:
        with pytest.raises((DataError, ConfigError), match=match):
            export_result(folder, layout, out=out)

    refused("photomol", "PhotoMol reads landings")
    refused("imaris", "choose one of trackpy, napari, photomol, picasso")
    refused("picasso", "does not say how large the movie is")
    refused("picasso", r"let `out` end in \.hdf5", folder / "locs.yaml")
    (folder / "fits.csv").write_text("a,b\n1,2\n")
    refused("napari", "`fits`: has no column event, frame")
    (folder / "fits.csv").unlink()
    refused("napari", r"holds no fits\.csv")
    assert [path.name for path in folder.iterdir()] == ["tracks.csv"]


# ---- events ----------------------------------------------------------------------------------


@pytest.fixture
def landings(tmp_path: Path) -> Path:
    """Write what `iscat fit` would of 300 landings, some of them flagged."""
    out = tmp_path / "landing.iscat"
    out.mkdir()
    _landings().to_csv(out / "fits.csv", index=False)
    summary = {"mode": "mass", "mass_scale": "calibration", "input": {"shape": [900, 128, 120]}}
    (out / "summary.json").write_text(json.dumps(summary))
    return out


def _landings() -> pd.DataFrame:
    table = make_analysis(300).table
    random = np.random.default_rng(7)
    truth = random.choice([66.0, 146.0, 480.0], len(table)) * np.sign(table["mass_kda"])
    table["sigma_mass_kda"] = 4.0
    table["mass_kda"] = random.normal(truth, 4.0)
    return table.assign(snr=table["mass_kda"].abs() / 4.5)


def _good() -> pd.DataFrame:
    table = _landings()
    return table[table["status"] == "ok"].sort_values("frame", kind="stable")


def test_photomol_finds_contrasts_and_masses(landings: Path) -> None:
    written = export_result(landings, "photomol")
    assert written.text == f"{len(_good())} events"
    assert written.notes == (
        f"{300 - len(_good())} events whose status is not ok, or without a place, left out",
    )
    table = pd.read_csv(written.path)  # as PhotoMol does, which then takes two columns
    for ours, theirs in (("contrast", "contrasts"), ("mass_kda", "masses_kDa")):
        np.testing.assert_allclose(table[theirs], _good()[ours], rtol=1e-8)
    assert table["frame_indices"].dtype == np.int64
    assert (table["contrasts"] * table["masses_kDa"] < 0).all()


def test_without_calibration_photomol_is_given_contrasts_alone(landings: Path) -> None:
    (landings / "summary.json").write_text('{"mode": "mass", "mass_scale": "absolute model"}')
    written = export_result(landings, "photomol")
    assert written.notes[1].startswith("contrasts alone")
    names = ["frame_indices", "x_coords", "y_coords", "contrasts", "snr"]
    assert list(pd.read_csv(written.path).columns) == names
    with pytest.raises(DataError, match="has contrasts and no masses; give `calibration`"):
        event_table(written.path)


def test_picasso_finds_localisations_and_the_size_of_the_movie(landings: Path) -> None:
    written = export_result(landings, "picasso")
    yaml = written.path.with_suffix(".yaml").read_text().splitlines()
    found = {line.split(": ")[0]: json.loads(line.split(": ", 1)[1]) for line in yaml}
    expected = {"Width": 120, "Height": 128, "Frames": 900, "Pixelsize": pytest.approx(84.4)}
    assert {key: found[key] for key in expected} == expected
    with h5py.File(written.path) as file:
        locs = file["locs"][()]
        assert json.loads(file["metadata"][()]) == [found]
    names = ("frame", "x", "y", "photons", "lpx", "lpy", "contrast", "snr", "mass_kda",
             "sigma_mass_kda")  # fmt: skip
    assert locs.dtype.names == names
    assert locs.dtype["frame"] == np.uint32
    assert all(locs.dtype[name] == np.float32 for name in names[1:])
    good = _good()
    np.testing.assert_allclose(locs["lpx"], good["sigma_x_nm"] / 84.4, rtol=1e-5)
    np.testing.assert_allclose(locs["photons"], good["n_scattered"], rtol=1e-6)
    assert all(np.isfinite(locs[name]).all() for name in names)  # Picasso drops other rows
    with pytest.raises(DataError, match=r"landing\.picasso\.hdf5: exists already"):
        export_result(landings, "picasso")
    written.path.unlink()
    with pytest.raises(DataError, match=r"landing\.picasso\.yaml: exists already"):
        export_result(landings, "picasso")
    table = pd.read_csv(landings / "fits.csv")  # of no particles the columns are the same
    table.iloc[:0].to_csv(landings / "fits.csv", index=False)
    assert export_result(landings, "picasso", overwrite=True).text == "0 events"
    with h5py.File(written.path) as file:
        assert file["locs"].shape == (0,)
        assert set(file["locs"].dtype.names) <= set(names)
        assert file["locs"].dtype["lpx"] == np.float32


def test_heights_and_tracks_reach_picasso() -> None:
    joint = to_picasso(make_analysis(20, "joint").table)
    assert {"z", "lpz", "mass_kda"} <= set(joint.columns)
    flat = to_picasso(make_analysis(20, "localize").table)
    assert "z" in flat.columns
    assert "mass_kda" not in flat.columns
    tracks = to_picasso(_fits(3).assign(snr=9.0, n_scattered=1e4), tracked=True)
    assert tracks["group"].nunique() == 3
    assert len(tracks) == 300


@pytest.mark.parametrize("layout", ["photomol", "picasso"])
def test_species_are_the_same_after_a_round_trip(landings: Path, layout: Any) -> None:
    back = event_table(export_result(landings, layout).path)
    own = event_table(landings)
    order = np.argsort(own.frame, kind="stable")
    for name in ("mass_kda", "sigma_kda", "frame", "x_px", "y_px"):
        np.testing.assert_allclose(getattr(back, name), getattr(own, name)[order], rtol=1e-6)
    assert back.efficiency is not None
    assert own.efficiency is not None
    assert back.efficiency.sigma_kda == pytest.approx(own.efficiency.sigma_kda, rel=1e-5)
    assert back.findings == own.findings == ()


def test_landings_are_points_and_features_without_masses(landings: Path, tmp_path: Path) -> None:
    features, points = (export_result(landings, name).path for name in ("trackpy", "napari"))
    np.testing.assert_allclose(np.load(points), _good()[["frame", "y_px", "x_px"]], rtol=1e-8)
    names = ["y", "x", "frame", "mass", "signal", "ep", "z"]
    assert list(pd.read_csv(features).columns) == names
    with pytest.raises(DataError, match="trackpy's, whose mass is a brightness"):
        event_table(features)
    with pytest.raises(DataError, match="neither an HDF5 file nor a text file"):
        event_table(points)
    locs = to_picasso(_landings())
    for left_out, match in (("mass_kda", "photons and no mass"), ("", "and not events")):
        path = tmp_path / f"locs{left_out}.hdf5"
        with h5py.File(path, "w") as file:
            kept = locs.drop(columns=left_out) if left_out else locs.assign(group=1)
            file["locs"] = kept.to_records(index=False)
        with pytest.raises(DataError, match=match):
            event_table(path)


def test_tables_for_photomol_need_no_frames(tmp_path: Path) -> None:
    path = tmp_path / "masses.csv"
    path.write_text("masses_kDa\n" + "".join(f"{mass}\n" for mass in range(60, 75)))
    assert event_table(path).mass_kda.tolist() == list(range(60, 75))
    table = read_events(path)
    assert tuple(table.columns) == TABLE_COLUMNS
    assert table[["frame", "x_px", "contrast"]].isna().all(axis=None)
    with pytest.raises(DataError, match="masses and no contrasts"):
        mass_calibration(path, [66.0], tmp_path / "line")
    path.write_text("contrasts\n-0.01\n-0.02\n")
    assert read_events(path)["contrast"].tolist() == [-0.01, -0.02]
    path.write_text("peaks\n-0.01\n")
    with pytest.raises(DataError, match="is no table of events"):
        event_table(path)


def test_the_command_writes_events_and_says_what_it_left_out(landings: Path, capsys) -> None:
    assert main(["export", str(landings), "--to", "photomol"]) == 0
    said = capsys.readouterr()
    assert f"{len(_good())} events in " in said.out
    assert f"{300 - len(_good())} events whose status is not ok" in said.err
    assert list(to_photomol(_landings(), masses=False)) == [
        "frame_indices", "x_coords", "y_coords", "contrasts", "snr"
    ]  # fmt: skip
    assert main(["species", str(landings.parent / "landing.photomol.csv"), "--k", "3"]) == 0
    assert "480" in capsys.readouterr().out
