"""Results that were written before: their tables, and the images that their fits saw."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from looked_at import bound_settings, landing_settings, moving_settings
from matplotlib.figure import Figure

import iscat_analysis as ia
from iscat_analysis.camera import CutFrames
from iscat_analysis.movie import Stack
from iscat_analysis.pipeline import landings as redraw_module
from iscat_cli import main

IMAGE_ATOL = 1e-4
"""Of a contrast, whose peaks here exceed 0.01 and whose noise is 1e-3: the neighbours of a fit move
by a part of their errors when the last sweep ends."""

LANDING = landing_settings(
    160,
    {"frame": 50, "leave": 110, "x_px": 20.3, "y_px": 40.8, "mass_kda": 700.0},
    {"frame": 62, "x_px": 34.3, "y_px": 32.8, "mass_kda": 1200.0},
    {"frame": 140, "x_px": 45.0, "y_px": 15.0, "mass_kda": 900.0},
)
BOUND = bound_settings(
    100,
    {"x_px": 20.2, "y_px": 22.8, "mass_kda": 900.0},
    {"x_px": 35.9, "y_px": 31.1, "mass_kda": 1500.0},
)


@pytest.fixture(scope="module")
def written(sample_configs, tmp_path_factory) -> dict[str, tuple[Path, ia.Result]]:
    """Analyse a landing movie and one with a background; both folders lie beside their movies."""
    done = {}
    for kind, sample, settings in (("landing", "landing", LANDING), ("bound", "mass", BOUND)):
        folder = tmp_path_factory.mktemp(kind)
        config = ia.configure(sample_configs[sample], settings=settings)
        ia.simulate_movie(config, folder / "movie.tif", seed=8)
        out = folder / "movie.iscat"
        done[kind] = out, ia.fit_movie(folder / "movie.tif", config=config, out=out)
    return done


@pytest.mark.parametrize(("kind", "rows"), [("landing", 4), ("bound", 2)])
def test_the_images_are_those_that_the_fit_saw(written, kind: str, rows: int) -> None:
    folder, analysed = written[kind]
    with ia.open_result(folder) as result:
        assert len(result) == rows
        for row in range(rows):
            seen, expected = result.images(row), analysed.images(row)
            assert (seen.event, seen.row_px) == (row, expected.row_px)
            assert seen.column_px == expected.column_px
            np.testing.assert_allclose(seen.contrast, expected.contrast, atol=IMAGE_ATOL)
            np.testing.assert_allclose(seen.model, expected.model, atol=IMAGE_ATOL)
            np.testing.assert_allclose(seen.residual, expected.residual, atol=0.1)
            assert (seen.trace is None) == (expected.trace is None)
            if seen.trace is not None and expected.trace is not None:
                assert seen.trace.first == expected.trace.first
                assert seen.trace.frame == expected.trace.frame
                difference = seen.trace.contrast - expected.trace.contrast
                assert np.nanmax(np.abs(difference)) < 0.2 * seen.trace.sigma
        # the comparison notices another event
        one, other = result.images(0).model, result.images(1).model
        assert one.shape != other.shape or np.abs(one - other).max() > 10 * IMAGE_ATOL


def test_of_a_large_field_only_the_surroundings_are_read(
    written, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The image is the same but for its level, which follows the light of what is read."""
    whole: list[int] = []
    cut: list[int] = []
    read, read_cut = Stack.read, CutFrames.read

    def counting(self: Stack, start: int, stop: int) -> np.ndarray:
        whole.append(stop - start)
        return read(self, start, stop)

    def counting_cut(self: CutFrames, start: int, stop: int) -> np.ndarray:
        cut.append(self.shape[2])
        return read_cut(self, start, stop)

    with ia.open_result(written["landing"][0]) as result:
        expected = [result.images(row) for row in range(4)]  # and the light is judged
        monkeypatch.setattr(Stack, "read", counting)
        monkeypatch.setattr(CutFrames, "read", counting_cut)
        monkeypatch.setattr(redraw_module, "LARGEST_PX", 0)
        monkeypatch.setattr(redraw_module, "halo_px", lambda _: 30)
        for row, one in enumerate(expected):
            seen = result.images(row)
            assert (seen.row_px, seen.column_px) == (one.row_px, one.column_px)
            np.testing.assert_allclose(seen.residual, one.residual, atol=0.01)  # sigma, as of tiles
            np.testing.assert_allclose(seen.model, one.model, atol=1e-6)
            np.testing.assert_allclose(seen.contrast, one.contrast, atol=2e-5)
            assert np.ptp(seen.contrast - one.contrast) < 1e-6
    assert whole == []
    assert max(cut) <= 61


def test_tables_and_configuration_are_those_of_the_folder(written) -> None:
    folder, analysed = written["landing"]
    with ia.open_result(str(folder)) as result:
        assert result.mode == "mass"
        assert result.tracks.empty
        assert result.analysis.tracks is None
        pd.testing.assert_series_equal(result.table["mass_kda"], analysed.table["mass_kda"])
        assert ia.config_to_toml(result.config) == analysed.config_toml
        assert isinstance(result.view(1), Figure)
        result.close()
        assert result.images(2).contrast.shape  # the movie is opened again
        text = " ".join(repr(result).split())
        assert "StoredResult: 4 events in movie.tif, mode mass Mass 695 to 1198 kDa" in text
        assert "4 events: 4 ok." in text


def test_a_folder_gives_back_what_the_fit_gave(written) -> None:
    for folder, analysed in written.values():
        with ia.open_result(folder) as result:
            pd.testing.assert_frame_equal(result.species, analysed.species)
            assert result.events.index.tolist() == analysed.events.index.tolist()
            assert [f.text for f in result.findings] == [
                f["text"] for f in analysed.summary["findings"]
            ]
            assert result.warnings == analysed.warnings
            assert repr(result).partition(":")[2] == repr(analysed).partition(":")[2]
            assert len(repr(result).splitlines()) <= 20
            pd.testing.assert_frame_equal(result.budget, analysed.budget)
            masses = analysed.figure("masses").data["bars"]
            assert result.figure("masses").data["bars"] == masses
            with pytest.raises(ia.ConfigError, match=r"no figure 'mass'; known: .*masses"):
                result.figure("mass")
            drawn, again = (each.plot_masses(bins=4).patches for each in (analysed, result))
            assert [p.get_height() for p in drawn] == [p.get_height() for p in again]


def test_figures_are_drawn_from_a_folder_and_events_where_the_movie_is(
    written, tmp_path, capsys
) -> None:
    folder, _ = written["bound"]
    command = ["figures", "--format", "svg", "--out", str(tmp_path / "paper")]
    assert main([*command, str(folder)]) == 0
    names = {Path(line).name for line in capsys.readouterr().out.splitlines()}
    assert {"field.svg", "masses.svg", "precision.svg", "event_0000.svg", "event_0001.svg"} == names
    assert {path.name for path in (tmp_path / "paper").iterdir()} == names
    alone = shutil.copytree(folder, tmp_path / "alone.iscat")
    summary = (alone / "summary.json").read_text().replace("movie.tif", "gone.tif")
    (alone / "summary.json").write_text(summary)
    assert main([*command, str(alone)]) == 1
    assert "pass --overwrite to replace its figures" in capsys.readouterr().err
    assert main(["figures", str(alone)]) == 0
    told = capsys.readouterr()
    assert "no single event is drawn" in told.err
    assert {path.name for path in (tmp_path / "alone.figures").iterdir()} == {
        "field.pdf", "masses.pdf", "precision.pdf",
    }  # fmt: skip


def test_the_movie_is_looked_for_beside_the_folder(written, tmp_path) -> None:
    folder = shutil.copytree(written["bound"][0], tmp_path / "moved.iscat")
    summary = folder / "summary.json"
    text = summary.read_text(encoding="utf-8")
    said = str(written["bound"][0].parent / "movie.tif")
    assert said in text
    summary.write_text(text.replace(said, "gone/movie.tif"), encoding="utf-8")
    result = ia.open_result(folder)
    with pytest.raises(ia.DataError, match="nor beside it"):
        result.images(0)
    shutil.copy(said, tmp_path / "movie.tif")
    assert result.movie_path == tmp_path / "movie.tif"
    assert result.images(0).contrast.shape
    result.close()
    with pytest.raises(ia.DataError, match=r"nowhere\.tif"):
        ia.open_result(folder, movie="nowhere.tif").images(0)


def test_another_movie_is_refused(written) -> None:
    other = written["landing"][0].parent / "movie.tif"
    with (
        ia.open_result(written["bound"][0], movie=other) as result,
        pytest.raises(ia.DataError, match="is not the movie"),
    ):
        result.images(0)


def test_what_is_no_result_is_refused(written, tmp_path) -> None:
    for folder in (tmp_path, tmp_path / "absent.iscat"):
        with pytest.raises(ia.DataError, match="no result"):
            ia.open_result(folder)
    broken = shutil.copytree(written["bound"][0], tmp_path / "broken.iscat")
    (broken / "summary.json").write_text("{", encoding="utf-8")
    with pytest.raises(ia.DataError, match="cannot be read"):
        ia.open_result(broken)


def test_of_no_rows_none_is_there(written, sample_configs, tmp_path: Path) -> None:
    """A movie without particles has no "rows 0 to -1"."""
    empty = {"background.frames": (0, 25), "fit.frames": (25, 50)}
    config = ia.configure(sample_configs["mass"], settings=BOUND | empty)
    movie, blank = written["bound"][0].parent / "movie.tif", tmp_path / "blank.iscat"
    ia.fit_movie(movie, config=config, out=blank)
    none = pytest.raises(ia.ConfigError, match=r"row = 0: blank\.iscat has none")
    with ia.open_result(blank) as result, none:
        result.images(0)


def test_rows_that_are_not_there_are_refused(written) -> None:
    with ia.open_result(written["bound"][0]) as result:
        for row in (-1, len(result)):
            with pytest.raises(ia.ConfigError, match=f"row = {row}"):
                result.images(row)


def test_particles_that_move_are_drawn_over_their_background(tmp_path) -> None:
    settings = moving_settings(36, 30, d_um2_s=0.2, x_px=8.0, y_px=17.0, drift_um_s=[12.0, 0.0])
    settings["track.free"] = "mass"
    config = ia.configure(None, settings=settings)
    ia.simulate_movie(config, tmp_path / "movie.tif", seed=2)
    analysed = ia.fit_movie(tmp_path / "movie.tif", config=config, out=tmp_path / "movie.iscat")
    track = analysed.table[analysed.table["track"] == 0]
    best = int(track["snr"].idxmax())  # the frame that the report shows
    expected = analysed.images(0)
    with ia.open_result(tmp_path / "movie.iscat") as result:
        assert result.tracks is not None
        seen = result.images(best)
        np.testing.assert_allclose(seen.model, expected.model, atol=IMAGE_ATOL)
        np.testing.assert_allclose(seen.contrast, expected.contrast, atol=10 * IMAGE_ATOL)
        assert np.std(seen.residual) == pytest.approx(1.0, abs=0.1)
        assert len(ia.tracked_rows(result.table)) == len(ia.to_napari(result.table))
