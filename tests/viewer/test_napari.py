"""The napari plugin, with real Qt and napari's model of a viewer; nothing is drawn in OpenGL."""

from __future__ import annotations

import os

os.environ["QT_QPA_PLATFORM"] = "offscreen"  # before Qt is imported

import gc
import importlib
import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import tifffile

import iscat_analysis as ia

# napari and npe2 describe their manifests and settings in an old manner of pydantic's.
pytestmark = [pytest.mark.filterwarnings("ignore::pydantic.warnings.PydanticDeprecatedSince20")]

PLUGIN, WINDOW = "iscat-analysis", 24
SETTINGS = {
    "simulation.frames": 160,
    "simulation.shape": [64, 64],
    "simulation.count": 0,
    "simulation.leavings": 0,
    "simulation.events": [
        {"frame": 60, "x_px": 20.3, "y_px": 40.8, "mass_kda": 700.0},
        {"frame": 110, "x_px": 45.0, "y_px": 15.0, "mass_kda": 900.0},
    ],
    "background.window_frames": WINDOW,
    "optics.calibrate": "never",
}


@pytest.fixture(scope="module")
def folder(sample_configs, tmp_path_factory) -> Path:
    """Simulate a movie with two landings and analyse it."""
    folder = tmp_path_factory.mktemp("napari")
    config = ia.configure(sample_configs["landing"], settings=SETTINGS)
    ia.simulate_movie(config, folder / "movie.tif", seed=5)
    (folder / "setup.toml").write_text(ia.config_to_toml(config), encoding="utf-8")
    result = ia.fit_movie(folder / "movie.tif", config=config, out=folder / "movie.iscat")
    assert len(result) == 2
    return folder


@pytest.fixture(scope="module")
def manifest(repo_root: Path, tmp_path_factory) -> Iterator[Any]:
    """Start Qt, and tell napari of the plugin; its settings are kept where they harm nobody."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NAPARI_CONFIG", str(tmp_path_factory.mktemp("settings") / "settings.yaml"))
        from npe2 import PluginManager, PluginManifest
        from qtpy.QtWidgets import QApplication

        application = QApplication.instance() or QApplication([])
        described = PluginManifest.from_file(repo_root / "viewer" / "napari.yaml")
        manager = PluginManager.instance()
        if PLUGIN in manager:
            manager.unregister(PLUGIN)
        manager.register(described)
        yield described
        manager.unregister(PLUGIN)
        application.processEvents()


@pytest.fixture
def viewer(manifest) -> Iterator[Any]:  # noqa: ARG001
    from napari.components import ViewerModel

    viewer = ViewerModel()
    yield viewer
    viewer.layers.clear()


@pytest.fixture
def explorer(viewer) -> Iterator[Any]:
    from iscat_napari.explorer import Explorer

    widget = Explorer(viewer)
    yield widget
    widget.close()
    widget.deleteLater()


@pytest.fixture
def searched(viewer, explorer, folder: Path) -> tuple[Any, Any]:
    """Open a movie and search it at its first landing."""
    viewer.open(str(folder / "movie.tif"), plugin=PLUGIN)
    explorer.config.setText(str(folder / "setup.toml"))
    viewer.dims.set_current_step(0, 60)
    explorer.detect()
    return viewer, explorer


def _settle(milliseconds: int = 60) -> None:
    """Let Qt do what it was asked to do soon; of two timers the shorter one is served first."""
    from qtpy.QtCore import QEventLoop, QTimer

    loop = QEventLoop()
    QTimer.singleShot(milliseconds, loop.quit)
    loop.exec()


def _found(viewer: Any) -> Any:
    return viewer.layers["found here"]


# ---- what napari is told ---------------------------------------------------------------------


def test_the_manifest_names_what_there_is(manifest, repo_root: Path) -> None:
    assert manifest.name == PLUGIN
    for command in manifest.contributions.commands:
        module, _, name = command.python_name.partition(":")
        assert callable(getattr(importlib.import_module(module), name)), command.python_name
    project = tomllib.loads((repo_root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["entry-points"]["napari.manifest"] == {PLUGIN: "iscat_napari:napari.yaml"}
    assert project["name"] == PLUGIN  # npe2 asks that the two are the same


# ---- movies and results as layers ------------------------------------------------------------


def test_a_movie_is_read_a_frame_at_a_time(viewer, folder: Path, monkeypatch) -> None:
    read: list[tuple[int, int]] = []
    original = ia.Stack.read

    def counted(self: ia.Stack, start: int, stop: int) -> Any:
        read.append((start, stop))
        return original(self, start, stop)

    monkeypatch.setattr(ia.Stack, "read", counted)
    (layer,) = viewer.open(str(folder / "movie.tif"), plugin=PLUGIN)
    assert 0 < sum(stop - start for start, stop in read) < 12  # of 160: limits, thumbnail, slice
    read.clear()
    viewer.dims.set_current_step(0, 33)
    assert set(read) == {(33, 34)}
    counts = tifffile.imread(folder / "movie.tif")
    assert layer.data.shape == counts.shape
    assert layer.data.dtype == counts.dtype
    for key in (7, (7, slice(3, 9)), slice(4, 20, 5), (slice(-2, None), 5, slice(None)),
                (Ellipsis, 2), [1, 5], (np.int64(4), slice(None), slice(None))):  # fmt: skip
        np.testing.assert_array_equal(layer.data[key], counts[key])
    np.testing.assert_array_equal(np.asarray(layer.data), counts)


def test_a_movie_is_closed_when_nothing_shows_it(folder: Path) -> None:
    from iscat_napari.readers import LazyMovie

    stack = ia.open_stack(folder / "movie.tif")
    assert LazyMovie(stack)[0].shape == (64, 64)
    gc.collect()
    with pytest.raises(ValueError, match="closed"):
        stack.read(0, 1)


def test_a_result_is_its_movie_and_a_point_for_each_event(viewer, folder: Path) -> None:
    movie, points = viewer.open(str(folder / "movie.iscat"), plugin=PLUGIN)
    table = pd.read_csv(folder / "movie.iscat" / "fits.csv")
    assert movie.name == "movie.tif"
    world = points.data * points.scale
    np.testing.assert_allclose(world, table[["frame", "y_px", "x_px"]])
    np.testing.assert_allclose(points.features["mass_kda"], table["mass_kda"], rtol=1e-8)
    assert set(table.columns) <= set(points.features.columns)
    # an event is seen in some frames around its own, and in no others
    for frame, shown in ((60, 0), (56, 0), (80, None)):
        viewer.dims.set_current_step(0, frame)
        place = {"view_direction": None, "dims_displayed": [1, 2], "world": True}
        assert points.get_value((frame, 40.8, 20.3), **place) == shown


def test_tracks_are_those_of_the_exporter(viewer, tmp_path) -> None:
    from walkers import SETUP, fits_of, walk

    from iscat_analysis.species import describe_tracks

    rng = np.random.default_rng(3)
    fits = fits_of([walk(rng, 30, 0.4) for _ in range(3)], rng, sigma_nm=20.0)
    out = tmp_path / "moving.iscat"
    out.mkdir()
    fits.to_parquet(out / "fits.parquet", index=False)
    described = describe_tracks(fits, SETUP)
    described.to_parquet(out / "tracks.parquet", index=False)
    (out / "config.toml").write_text('[fit]\nmode = "track"\n', encoding="utf-8")
    about = {
        "mode": "track", "input": {"path": "gone.tif", "sha256": ""}, "versions": {}, "seed": 0,
        "findings": [],
    }  # fmt: skip
    (out / "summary.json").write_text(json.dumps(about), encoding="utf-8")
    tracks, points = viewer.open(str(out), plugin=PLUGIN)
    np.testing.assert_array_equal(tracks.data, ia.to_napari(fits))
    masses = described.set_index("track")["mass_kda"].loc[tracks.data[:, 0].astype(int)]
    np.testing.assert_allclose(tracks.features["track_mass_kda"], masses)
    rows = tracks.features["row"].astype(int)
    np.testing.assert_allclose(fits["x_px"].iloc[rows], tracks.data[:, 3])
    assert len(points.data) == len(fits)


def test_what_is_not_ours_is_left_to_others(tmp_path) -> None:
    from iscat_napari.readers import movie_reader, result_reader

    (tmp_path / "some.iscat").mkdir()
    for path in (str(tmp_path), [str(tmp_path / "a.tif"), str(tmp_path / "b.tif")]):
        assert result_reader(path) is None
    assert movie_reader(str(tmp_path / "some.iscat")) is None
    assert movie_reader([str(tmp_path / "a.tif")]) is None
    assert movie_reader(str(tmp_path)) is None
    reader = result_reader(str(tmp_path / "some.iscat"))
    assert reader is not None
    with pytest.raises(ia.DataError, match="no result"):
        reader(str(tmp_path / "some.iscat"))


# ---- the search ------------------------------------------------------------------------------


def test_detect_marks_what_the_search_finds_in_the_frame_that_is_shown(searched, folder) -> None:
    viewer, explorer = searched
    with ia.open_stack(folder / "movie.tif") as movie:
        preview = ia.Preview(movie, ia.configure(folder / "setup.toml"))
        expected = preview.look(60).found()
    layer = _found(viewer)
    assert len(expected) == 1
    np.testing.assert_allclose(layer.data, [[60, *expected[["y_px", "x_px"]].iloc[0]]])
    assert layer.features["snr"].iloc[0] == pytest.approx(expected["snr"].iloc[0])
    assert explorer.window_frames.value() == WINDOW
    assert explorer.threshold.value() == pytest.approx(preview.threshold(), abs=0.01)
    assert "frames 60:84 over 36:60: 1 place above" in explorer.status.text()
    assert explorer.settings.text() == "as in the configuration"


def test_the_threshold_acts_at_once(searched) -> None:
    viewer, explorer = searched
    explorer.threshold.setValue(20.0)
    assert len(_found(viewer).data) == 1  # of 48 standard deviations
    explorer.threshold.setValue(2.5)
    assert len(_found(viewer).data) > 1
    assert "false_alarms_per_movie=" in explorer.settings.text()
    alarms = explorer.settings.text().rpartition("=")[2]
    assert float(alarms) > 1.0


def test_the_window_acts_at_once_and_on_the_contrast(searched) -> None:
    viewer, explorer = searched
    explorer.show_ratio()
    layer = viewer.layers["contrast"]
    wide, snr = np.asarray(layer.data[60]), _found(viewer).features["snr"].iloc[0]
    explorer.window_frames.setValue(8)
    _settle()
    narrow = np.asarray(layer.data[60])
    assert "--set background.window_frames=8" in explorer.settings.text()
    assert np.std(narrow) > 1.3 * np.std(wide)
    # of a third of the frames, a signal-to-noise ratio of 1/√3
    assert _found(viewer).features["snr"].iloc[0] == pytest.approx(snr / np.sqrt(3), rel=0.15)
    before, after = (np.mean(viewer.layers["movie.tif"].data[a:b], axis=0, dtype=float)
                     for a, b in ((52, 60), (60, 68)))  # fmt: skip
    contrast = after / before * before.mean() / after.mean() - 1
    np.testing.assert_allclose(narrow, contrast, atol=1e-6)


def test_the_search_follows_the_frame(searched) -> None:
    viewer, explorer = searched
    viewer.dims.set_current_step(0, 110)
    _settle()
    np.testing.assert_allclose(_found(viewer).data[0], [110, 15.0, 45.0], atol=0.2)
    explorer.follow.setChecked(False)
    viewer.dims.set_current_step(0, 85)
    _settle()
    assert _found(viewer).data[0, 0] == 110


def test_an_array_of_another_reader_is_searched_too(viewer, explorer, folder: Path) -> None:
    counts = tifffile.imread(folder / "movie.tif")
    scale = [0.5, 0.084, 0.084]  # it may know seconds and micrometres
    viewer.add_image(counts, name="counts", scale=scale)
    explorer.config.setText(str(folder / "setup.toml"))
    viewer.dims.set_point(0, 110 * scale[0])
    explorer.detect()
    layer = _found(viewer)
    np.testing.assert_allclose(layer.data[0], [110, 15.0, 45.0], atol=0.2)
    np.testing.assert_array_equal(layer.scale, scale)
    explorer.show_ratio()
    np.testing.assert_array_equal(viewer.layers["contrast"].scale, scale)


def test_what_cannot_be_done_is_said_and_not_raised(viewer, explorer, folder: Path) -> None:
    explorer.detect()
    assert "open a movie first" in explorer.status.text()
    viewer.add_image(np.zeros((8, 8)))
    viewer.add_image(np.zeros((8, 8, 3), dtype=np.uint8), rgb=True)
    viewer.add_labels(np.zeros((4, 8, 8), dtype=int))
    assert explorer.movie.count() == 0  # none of these is a movie
    viewer.open(str(folder / "movie.tif"), plugin=PLUGIN)
    for name, complaint in (("absent.toml", "absent.toml"), ("movie.tif", "not")):
        explorer.config.setText(str(folder / name))
        explorer.detect()
        assert complaint in explorer.status.text()
    broken = folder / "broken.toml"
    broken.write_text("[background]\nwindow_frames = 500\n", encoding="utf-8")
    explorer.config.setText(str(broken))
    explorer.detect()
    assert "500" in explorer.status.text()
    explorer.show_ratio()
    assert "contrast" not in viewer.layers
    # a configuration that was mended is read again
    broken.write_text((folder / "setup.toml").read_text(encoding="utf-8"), encoding="utf-8")
    explorer.detect()
    assert "above" in explorer.status.text()
    viewer.layers.clear()
    explorer.detect()
    assert "open a movie first" in explorer.status.text()


def test_another_configuration_is_searched_with_at_once(searched, folder: Path) -> None:
    _, explorer = searched
    wide = ia.configure(folder / "setup.toml", settings={"background.window_frames": 40})
    (folder / "wide.toml").write_text(ia.config_to_toml(wide), encoding="utf-8")
    explorer.config.setText(str(folder / "wide.toml"))
    explorer.config.editingFinished.emit()
    _settle()
    assert explorer.window_frames.value() == 40
    assert "frames 60:100 over 20:60" in explorer.status.text()


def test_a_widget_that_is_gone_hears_nothing(viewer, folder: Path) -> None:
    from qtpy.QtCore import QCoreApplication, QEvent

    from iscat_napari.explorer import Explorer

    clicks = len(viewer.mouse_drag_callbacks)
    widget = Explorer(viewer)
    assert len(viewer.mouse_drag_callbacks) == clicks + 1
    widget.deleteLater()
    QCoreApplication.sendPostedEvents(None, QEvent.Type.DeferredDelete)
    viewer.open(str(folder / "movie.tif"), plugin=PLUGIN)  # would reach what is deleted
    viewer.dims.set_current_step(0, 5)
    assert len(viewer.mouse_drag_callbacks) == clicks


# ---- events ----------------------------------------------------------------------------------


def _click(viewer: Any, explorer: Any, t: float, y: float, x: float) -> None:
    event = SimpleNamespace(
        position=(t, y, x), view_direction=None, dims_displayed=[1, 2], type="mouse_press"
    )
    explorer.on_click(viewer, event)


def test_a_click_shows_data_model_and_residual(viewer, explorer, folder: Path) -> None:
    viewer.open(str(folder / "movie.iscat"), plugin=PLUGIN)
    assert explorer.config.text() == str(folder / "movie.iscat" / "config.toml")
    viewer.dims.set_current_step(0, 110)
    _click(viewer, explorer, 110, 50, 50)  # where there is nothing
    assert explorer.event.canvas is None
    _click(viewer, explorer, 110, 15.0, 45.0)
    figure = explorer.event.canvas.figure
    images = [axes.images[0].get_array() for axes in figure.axes if axes.images]
    with ia.open_result(folder / "movie.iscat") as result:
        view = result.images(1)
        mass = result.table["mass_kda"].iloc[1]
    for image, expected in zip(images, (view.contrast, view.model, view.residual), strict=True):
        np.testing.assert_allclose(np.asarray(image), expected)
    assert "event 1" in explorer.event.facts.text()
    assert f"{mass:.1f}" in explorer.event.facts.text()
    first = explorer.event.canvas
    viewer.dims.set_current_step(0, 60)
    _click(viewer, explorer, 60, 40.8, 20.3)
    assert explorer.event.canvas is not first
    assert "event 0" in explorer.event.facts.text()


def test_without_its_movie_an_event_has_its_numbers(viewer, explorer, folder, tmp_path) -> None:
    import shutil

    lonely = shutil.copytree(folder / "movie.iscat", tmp_path / "lonely.iscat")
    summary = lonely / "summary.json"
    text = summary.read_text(encoding="utf-8").replace(str(folder / "movie.tif"), "gone.tif")
    summary.write_text(text, encoding="utf-8")
    (points,) = viewer.open(str(lonely), plugin=PLUGIN)
    explorer.show_event(points.metadata["iscat_result"], 0)
    assert explorer.event.canvas is None
    assert "event 0" in explorer.event.facts.text()
    assert "gone.tif" in explorer.event.facts.text()
