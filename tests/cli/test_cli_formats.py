"""The same counts in another file give the same results, in a folder of the file's name."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
import tifffile

from iscat_analysis.movie import path_beside
from iscat_cli import main

pytestmark = pytest.mark.usefixtures("sketched")


@pytest.fixture(scope="module")
def counts(tmp_path_factory: pytest.TempPathFactory, sample_configs: dict[str, Path]) -> np.ndarray:
    path = tmp_path_factory.mktemp("counts") / "movie.tif"
    few = ["--set", "simulation.shape=[64, 64]"]
    one = ["--set", "simulation.events=[{frame=200, x_px=31.2, y_px=30.8, mass_kda=900.0}]"]
    config = ["--config", str(sample_configs["mass"])]
    assert main(["simulate", *config, *few, *one, "--out", str(path), "--quiet"]) == 0
    return np.asarray(tifffile.imread(path))


def test_every_file_gives_the_same_fits(
    tmp_path: Path, counts: np.ndarray, sample_configs: dict[str, Path]
) -> None:
    np.save(tmp_path / "a.npy", counts)
    (tmp_path / "b.bin").write_bytes(counts.tobytes())
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file["run/movie"] = counts
    rows, columns = counts.shape[1:]
    jobs = (
        (tmp_path / "a.npy", []),
        (tmp_path / "b.bin", ["--raw", f"{rows}x{columns},{counts.dtype}"]),
        (Path(f"{tmp_path / 'c.h5'}::/run/movie"), []),
    )
    tables = []
    for movie, options in jobs:
        config = ["--config", str(sample_configs["mass"]), "--no-posterior", "--quiet"]
        assert main(["fit", str(movie), *options, *config]) == 0
        tables.append(pd.read_csv(path_beside(movie, ".iscat") / "fits.csv"))
    assert len(tables[0]) == 1
    for table in tables[1:]:
        pd.testing.assert_frame_equal(table, tables[0])
    assert sorted(path.name for path in tmp_path.glob("*.iscat")) == [
        "a.iscat", "b.iscat", "c.run.movie.iscat",
    ]  # fmt: skip


def test_a_shape_that_does_not_fit_is_one_clear_line(
    tmp_path: Path, counts: np.ndarray, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "b.bin").write_bytes(counts.tobytes())
    assert main(["fit", str(tmp_path / "b.bin"), "--raw", "100x63,uint16"]) == 1
    error = capsys.readouterr().err.strip()
    assert error.count("\n") == 0
    assert "b.bin" in error
    assert "a multiple of 12600" in error
