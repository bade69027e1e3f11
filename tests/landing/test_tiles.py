"""A field that is cut into tiles: the rows of the whole field, each once, on seams as well."""

from __future__ import annotations

import gc
import weakref
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from landings import analysed, drawn, landing_config

from iscat_analysis.camera import Camera, measure_spectrum
from iscat_analysis.config import Config, load_config
from iscat_analysis.errors import DataError
from iscat_analysis.inference.nuisances import NOTHING
from iscat_analysis.landing import chunks as chunk_work
from iscat_analysis.landing import neighbours, steps
from iscat_analysis.movie import open_stack
from iscat_analysis.records import FRAME_COLUMN
from iscat_analysis.search import chunks as chunks_module
from iscat_analysis.search import chunks as planning
from iscat_analysis.search.chunks import Reader
from iscat_analysis.search.frames import Tile, cut_field, frames_in_place
from iscat_analysis.threads import threads

SIDE, FRAMES = 176, 130
# of 2 × 2 tiles the seams are at 87.5: on them, beside them, where they cross, and bright ones
# whose rings cross them
EVENTS = [
    (60, 95, 87.5, 87.5, 480.0),
    (40, None, 40.2, 87.47, 480.0),
    (70, None, 135.4, 87.6, 480.0),
    (80, None, 130.6, 62.4, 800.0),
    (90, None, 93.3, 48.9, 480.0),
    (50, None, 44.1, 126.2, 480.0),
]


def _config() -> Config:
    settings = [
        "background.window_frames=30", "detection.false_alarms_per_movie=0.01", "fit.roi_nm=1000",
    ]  # fmt: skip
    return landing_config(SIDE, FRAMES, *settings, events=EVENTS)


@pytest.fixture(scope="module")
def counts() -> np.ndarray:
    """Draw the movie of `EVENTS` once."""
    return drawn(_config())


def _run(movie: Any) -> Any:
    return analysed(movie, _config())[0]


def _tiled(monkeypatch: pytest.MonkeyPatch, parts: tuple[int, int], core: int) -> None:
    monkeypatch.setattr(planning, "plan_chunks", lambda *_: 0)
    monkeypatch.setattr(planning, "choose_tiles", lambda *_, **__: (parts, core))


@pytest.fixture(scope="module")
def whole(counts: np.ndarray) -> Any:
    """Analyse the field at once."""
    return _run(counts)


def _difference(found: Any, whole: Any) -> float:
    """Compare estimates, in standard errors of the whole field's."""
    there, here = whole.fits, found.fits
    return max(
        float(np.abs((here[name] - there[name]) / there[f"sigma_{name}"]).max())
        for name in ("x_nm", "y_nm", "mass_kda")
    )


def _check(found: Any, whole: Any) -> None:
    """Compare rows, masks, light, views and the image of the field."""
    assert len(whole.fits) == len(EVENTS) + 1
    for name in ("frame", "status", "flags", "n_before", "n_after"):
        assert found.fits[name].tolist() == whole.fits[name].tolist()
    assert _difference(found, whole) < 0.01
    assert found.compared.masked_pixels == whole.compared.masked_pixels
    np.testing.assert_allclose(found.compared.power, whole.compared.power, rtol=1e-12)
    corners = [(view.event, view.row_px, view.column_px) for view in whole.views]
    assert [(view.event, view.row_px, view.column_px) for view in found.views] == corners
    clear = np.abs(whole.image) > 0.2 * np.abs(whole.image).max()
    np.testing.assert_allclose(found.image[clear], whole.image[clear], rtol=0.01)


def test_tiles_change_nothing(
    counts: np.ndarray, whole: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Frames stay where they lie in the file; last fits are of rows and of what is on seams."""
    _tiled(monkeypatch, (2, 2), FRAMES)
    fits: list[Any] = []
    fit = steps.fit_particle
    monkeypatch.setattr(steps, "fit_particle", lambda *a, **k: fits.append(a) or fit(*a, **k))
    large = steps.large_steps

    def found_first(*arguments: Any) -> Any:  # whose fits are not the last ones
        number = len(fits)
        bright = large(*arguments)
        del fits[number:]
        return bright

    monkeypatch.setattr(steps, "large_steps", found_first)
    np.save(tmp_path / "movie.npy", counts)
    with open_stack(tmp_path / "movie.npy") as movie:
        found = _run(movie)
    # the first lands and leaves in the corner of four tiles, two others are on seams of two
    assert len(fits) == 2 * 4 + 2 * 2 + 3
    assert (whole.summary["tiles"], found.summary["tiles"]) == (1, 4)
    assert found.summary["chunks"] == 1
    _check(found, whole)
    places = (part.counts.sum(axis=1) for part in (found.empty, whole.empty))
    assert np.divide(*places) == pytest.approx(1.0, abs=0.05)  # none in two tiles


def test_rows_of_one_step_are_found_among_those_of_its_frames() -> None:
    """As by looking at all pairs; 600 rows, half of them beside another in place and time."""
    rng = np.random.default_rng(5)
    there = {
        "frame": rng.integers(0, 200, 300).astype(float), FRAME_COLUMN: rng.integers(0, 6, 300),
        "x_px": rng.uniform(0, 60, 300), "y_px": rng.uniform(0, 60, 300),
        "mass_kda": rng.choice([-66.0, 66.0], 300),
    }  # fmt: skip
    table = pd.DataFrame({
        name: np.concatenate([value, value + rng.integers(-3, 4, 300) * (name != "mass_kda") / 2])
        for name, value in there.items()
    })  # fmt: skip
    same = chunk_work.SameSteps(table)
    found = 0
    for one in range(600):
        frame, error, x, y, mass = (table[name].to_numpy(float) for name in there)
        near = np.abs(frame - frame[one]) <= np.maximum(2, error + error[one])
        near &= np.hypot(x - x[one], y - y[one]) < chunk_work.SEAM_PX
        near &= mass * mass[one] > 0
        near[one] = False
        assert sorted(same.like(one)) == np.flatnonzero(near).tolist()
        found += int(near.sum())
    assert found > 200


def test_images_that_are_drawn_again_are_the_same(
    counts: np.ndarray, whole: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No image of a step is held, and what a chunk took is free without a search for cycles."""
    monkeypatch.setattr(neighbours, "_IMAGE_BYTES", 0)
    left: list[weakref.ref[Any]] = []
    build = neighbours.Neighbours.__init__

    def watched(self: Any, *arguments: Any) -> None:
        build(self, *arguments)
        left.extend((weakref.ref(self), weakref.ref(self._images)))

    monkeypatch.setattr(neighbours.Neighbours, "__init__", watched)
    gc.disable()
    try:
        found = _run(counts)
        assert [one() for one in left] == [None, None]
    finally:
        gc.enable()
    pd.testing.assert_frame_equal(found.fits, whole.fits)


def test_a_tile_shows_half_more_than_its_share_at_most() -> None:
    first, last = (cut_field((100, 400), (1, 4), 10)[k] for k in (0, -1))
    assert first.share == last.share == 0.25
    assert [chunk_work._shown_of(first, left) for left in (1000, 3, 0, -7)] == [375, 2, 0, 0]
    half = cut_field((100, 400), (1, 2), 10)[0]
    assert [chunk_work._shown_of(tile, 9) for tile in (half, None)] == [7, 9]


def test_frames_of_several_files_lie_where_they_are(
    counts: np.ndarray, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A tile sees them as one array; what does not fit into memory is not copied to a disk."""
    for number, part in enumerate(np.split(counts, [3, 70])):
        part.astype("<u2").tofile(tmp_path / f"movie_{number:04}.bin")
    (tmp_path / "movie_settings.dat").write_text(
        f"save/frame/shape\t({SIDE}, {SIDE})\nsave/frame/dtype\t<u2\nsave/saved\t{FRAMES}\n",
        encoding="utf-8",
    )
    monkeypatch.setattr(chunks_module, "Scratch", None)
    camera, box = Camera(), (slice(20, 90), slice(5, 60))
    with open_stack(tmp_path / "movie_0000.bin") as movie, threads(1) as pool:
        runs = frames_in_place(movie, 1, 120)
        assert [len(run.counts) for run in runs] == [2, 67, 50]
        reader = Reader(movie, camera, 1, 120, 40 * SIDE * SIDE * 2)
        tile = Tile((20, 90), (5, 60), (20, 90), (5, 60), (SIDE, SIDE))
        sums = reader.field_sums((60, 110), pool)
        chunk = reader.tile_chunk(sums.part(box), tile, 20, pool)
        np.testing.assert_allclose(sums.mean_e.sum(), counts[60:110].mean(axis=0).sum(), rtol=1e-6)
        for (first, last), block in zip(pairwise((60, 80, 100, 110)), chunk.blocks_e, strict=True):
            np.testing.assert_array_equal(block, counts[(slice(first, last), *box)].sum(axis=0))
        region = chunk.patch(65, 75, (3, 9), (4, 20)).counts
        np.testing.assert_array_equal(region, counts[65:75, 23:29, 9:25])
    with open_stack(counts) as movie:
        assert frames_in_place(movie, 0, 9) == []


@pytest.mark.large
@pytest.mark.parametrize(("parts", "core"), [((2, 2), 70), ((3, 1), FRAMES)])
def test_tiles_and_chunks_of_frames_that_exceed_the_memory(
    counts: np.ndarray,
    whole: Any,
    parts: tuple[int, int],
    core: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """They are read once, into a temporary file."""
    _tiled(monkeypatch, parts, core)
    monkeypatch.setattr(chunks_module, "MEMORY_SHARE", 0.002)
    found = _run(counts)
    assert found.summary["chunks"] == -(-FRAMES // core)
    _check(found, whole)


def test_without_halos_rows_change(
    counts: np.ndarray, whole: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Control: particles on seams are cut in half."""
    _tiled(monkeypatch, (2, 2), FRAMES)
    monkeypatch.setattr(planning, "halo_px", lambda _: 6)
    found = _run(counts)
    assert len(found.fits) != len(whole.fits) or _difference(found, whole) > 0.1


def test_a_particle_on_a_seam_is_reported_once() -> None:
    """Each tile may place it in the core of the other, or both in their own."""
    tiles = cut_field((100, 100), (1, 2), 20)
    rows = {"frame": 40, FRAME_COLUMN: 1, "y_px": 30.0, "mass_kda": 100.0, "snr": 9.0,
            "y_nm": 1.0, "x_nm": 1.0}  # fmt: skip
    for left, right in ((49.3, 49.6), (49.6, 49.3), (49.7, 49.8)):
        tables = [pd.DataFrame([rows | {"x_px": x}]) for x in (left, right)]
        assert len(chunk_work.joined(tiles, [_finished(table) for table in tables]).lines) == 1
    apart = [pd.DataFrame([rows | {"x_px": x}]) for x in (47.0, 50.2)]
    assert len(chunk_work.joined(tiles, [_finished(table) for table in apart]).lines) == 2


def _finished(lines: pd.DataFrame) -> chunk_work.FinishedChunk:
    """Make the results of half of a field that found one step."""
    none = np.zeros((100, 50), dtype=bool)
    return chunk_work.FinishedChunk(
        core=(0, 100), lines=lines, repeats=np.zeros((1, 4)), evidence=np.zeros((1, len(NOTHING))),
        views=(), good=np.ones(100, dtype=bool), light=np.ones(100), masked=none, saturated=none,
        strongest=np.zeros((2, 100, 50)), ends_e=np.empty(0),
    )  # fmt: skip


def test_noise_and_optics_of_a_tile_are_those_of_its_place() -> None:
    rng = np.random.default_rng(1)
    light = rng.uniform(0.8, 1.2, (120, 140))
    leak = rng.poisson(1000 * light, (160, 120, 140)).astype(float)
    leak[:, :, 1:] = 0.8 * leak[:, :, 1:] + 0.2 * leak[:, :, :-1]
    spectrum = measure_spectrum(leak, Camera())
    assert spectrum is not None
    here = slice(20, 100), slice(30, 130)
    signal = rng.standard_normal((120, 140))
    seen = spectrum.whitened(signal, light)[here]
    part = spectrum.on((80, 100)).whitened(signal[here], light[here])
    inner = slice(10, -10), slice(10, -10)
    assert np.abs(part - seen)[inner].max() < 2e-3 * np.abs(seen).max()
    assert np.abs(signal[here] - seen)[inner].max() > 0.1 * np.abs(seen).max()  # control


def test_the_division_of_a_field_minds_memory_and_halos() -> None:
    """What a camera of 1200 × 1920 pixels needs fits into the limit, and little is done twice."""
    config = load_config(None, ["camera.pixel_size_nm=84.0"])
    reader = SimpleNamespace(
        shape=(1200, 1920), frame_bytes=1200 * 1920 * 2, first=0, last=10_000, name="movie"
    )
    (high, wide), core = _chosen(reader, config, 100)
    halo = planning.halo_px(config)
    tiles = cut_field(reader.shape, (high, wide), halo)
    largest = max(tile.shape[0] * tile.shape[1] for tile in tiles)
    blocks = (core + 2 * planning.halo_frames(100)) / 25
    assert largest * blocks * 4 < 0.2016 * 1000e6  # of sums, whose place the maps take
    seen = np.zeros(reader.shape, dtype=int)
    for tile in tiles:
        seen[tile.core] += 1
    assert (seen == 1).all()  # each pixel has one home
    work = sum(tile.shape[0] * tile.shape[1] for tile in tiles) * (core + 400) / core
    assert work < 2.6 * seen.size
    (high, wide), core = _chosen(reader, config, 100, in_place=False)
    tiles = cut_field(reader.shape, (high, wide), halo)
    largest = max(tile.shape[0] * tile.shape[1] for tile in tiles)
    assert largest * (core + 400) / 25 * 8 < 0.2016 * 1000e6  # of sums and maps
    small = load_config(None, ["camera.pixel_size_nm=84.0", "compute.memory_limit_mb=64"])
    with pytest.raises(DataError, match=r"compute\.memory_limit_mb = "):
        _chosen(reader, small, 100)
    longer = load_config(None, ["camera.pixel_size_nm=84.0", "compute.memory_limit_mb=64000"])
    with pytest.raises(DataError, match=r"6 GB hold 1302 of 1920 x 1200 pixels: lower"):
        _chosen(reader, longer, 400)  # no memory is enough
    _chosen(reader, longer, 150)  # control


def _chosen(
    reader: Any, config: Config, window: int, *, in_place: bool = True
) -> tuple[tuple[int, int], int]:
    return planning.choose_tiles(reader, config, window, 10_000, in_place=in_place)
