"""Tracks in the layouts of trackpy and napari, read back as those programs read them."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from walkers import EXPOSURE_MS, PIXEL_NM, RATE_HZ, SETUP, fits_of, walk

from iscat_analysis import to_napari, to_trackpy
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.report.exchange import export_tracks
from iscat_analysis.species import describe_tracks
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


def test_trackpy_has_places_in_pixels_and_errors_beside_them() -> None:
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
    assert main(["export", str(folder), "--to", "trackpy"]) == 0
    written = folder.parent / "moving.trackpy.csv"
    assert f"3 tracks in {written}" in capsys.readouterr().out
    assert pd.read_csv(written)["particle"].nunique() == 3
    array = folder.parent / "here.npy"
    assert main(["export", str(folder), "--to", "napari", "--out", str(array)]) == 0
    assert np.load(array).shape == (300, 4)
    assert main(["export", str(folder), "--to", "trackpy"]) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert main(["export", str(folder), "--to", "trackpy", "--overwrite"]) == 0


def test_a_folder_without_tracks_is_refused(folder: Path) -> None:
    (folder / "tracks.csv").rename(folder / "others.csv")
    with pytest.raises(DataError, match=r"holds no tracks\.csv"):
        export_tracks(folder, "napari")
    (folder / "others.csv").rename(folder / "tracks.csv")
    with pytest.raises(ConfigError, match="choose one of trackpy, napari"):
        export_tracks(folder, "imaris")  # type: ignore[arg-type]
    (folder / "fits.csv").write_text("a,b\n1,2\n")
    with pytest.raises(DataError, match="is not a table of fits"):
        export_tracks(folder, "napari")
