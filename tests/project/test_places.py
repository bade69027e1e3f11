"""Where work runs: what is said of wrong places, and what a job takes with it."""

from __future__ import annotations

import pickle
import socket
import sys
from pathlib import Path

import numpy as np
import pytest

import iscat_analysis as ia
from iscat_analysis.camera import Camera
from iscat_analysis.config import with_absolute_paths
from iscat_analysis.errors import DataError
from iscat_analysis.executors import open_executor
from iscat_analysis.movie import open_stack
from iscat_analysis.search.chunks import Reader
from iscat_analysis.threads import allotted, threads
from iscat_cli import main, main_fit


def _job(number: int, *, progress: object = None) -> int:
    del progress
    return 2 * number


def test_here_is_one_after_the_other() -> None:
    with open_executor() as place:
        assert not place.distant
        assert list(place.each(lambda n: place.call(_job, n), [3, 4])) == [(0, 6), (1, 8)]
        assert place.warnings(1000) == []


@pytest.fixture
def nobody() -> str:
    """Return an address at which nothing listens."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"tcp://127.0.0.1:{free.getsockname()[1]}"


def test_wrong_places_are_refused_in_one_line(
    nobody: str, tmp_path: Path, capsys, monkeypatch
) -> None:
    monkeypatch.setattr("iscat_analysis.executors.CONNECT_S", 0.3)
    empty = tmp_path / "empty.json"
    empty.write_text("{}")
    (tmp_path / "samples.csv").write_text("path\nmovie.npy\n")
    np.save(tmp_path / "movie.npy", np.ones((4, 8, 8), "u2"))
    cases = [
        (["--scheduler", nobody], f"--scheduler {nobody}: no Dask scheduler answers there"),
        (["--scheduler", "thread"], '--scheduler thread must be "threads", or the address'),
        (["--scheduler-file", str(tmp_path / "none")], "cannot be read (No such file or"),
        (["--scheduler-file", str(empty)], f"--scheduler-file {empty}: holds no address"),
        (["--scheduler", nobody, "--scheduler-file", str(empty)], "name two places: give one"),
    ]
    for options, complaint in cases:
        assert main_fit([str(tmp_path / "movie.npy"), *options]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert complaint in line
        out = ["--out", str(tmp_path / "out")]
        assert main(["batch", str(tmp_path / "samples.csv"), *out, *options]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert complaint in line


def test_a_cluster_needs_dask(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(ia.ConfigError, match=r'pip install "iscat-analysis\[dask\]"'),
        open_executor("tcp://127.0.0.1:1"),
    ):
        pass


# ---- what a job takes with it ----------------------------------------------------------------


def test_a_movie_is_opened_again_where_it_is_sent(tmp_path: Path, monkeypatch) -> None:
    counts = np.arange(4 * 6 * 8, dtype="u2").reshape(4, 6, 8)
    np.save(tmp_path / "movie.npy", counts)
    counts.tofile(tmp_path / "movie.bin")
    monkeypatch.chdir(tmp_path)
    for address in ("movie.npy", "movie.bin::4x6x8,uint16"):
        with open_stack(address) as stack:
            sent = pickle.dumps(stack)
        with monkeypatch.context() as elsewhere:
            elsewhere.chdir("/")
            again = pickle.loads(sent)
        assert np.array_equal(again.read(1, 3), counts[1:3])
        again.close()


def test_a_movie_that_is_another_where_it_is_sent_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "movie.npy"
    np.save(path, np.zeros((4, 6, 8), "u2"))
    with open_stack(path) as stack:
        sent = pickle.dumps(stack)
    np.save(path, np.ones((4, 6, 8), "u2"))
    with pytest.raises(ia.DataError, match=r"movie\.npy: is not on .*must share the file system"):
        pickle.loads(sent)
    path.unlink()
    with pytest.raises(ia.DataError, match=r"movie\.npy: is not on "):
        pickle.loads(sent)


def test_what_is_in_memory_is_not_sent(tmp_path: Path) -> None:
    np.save(tmp_path / "movie.npy", np.zeros((4, 6, 8), "u2"))
    with open_stack(np.zeros((4, 6, 8), "u2"), name="mine") as array, pytest.raises(TypeError):
        pickle.dumps(array)
    with open_stack(tmp_path / "movie.npy") as stack, pytest.raises(TypeError):
        pickle.dumps(stack.seen_as(stack._frames))


def test_files_of_a_configuration_are_found_from_everywhere(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    settings = {"camera.gain_e_per_adu": "maps/gain.tif", "simulation.background": "speckle"}
    config = ia.configure(settings=settings)
    sent = with_absolute_paths(config)
    assert sent.camera.gain_e_per_adu == str(tmp_path / "maps" / "gain.tif")
    assert sent.simulation == config.simulation
    assert with_absolute_paths(ia.configure()) == ia.configure()


@pytest.mark.parametrize("stored", ["<u2", ">u2"], ids=["in place", "read"])
def test_a_chunk_knows_the_frame_before_it(tmp_path: Path, stored: str) -> None:
    """Its first frame may repeat that one, whether or not the reader has held it."""
    counts = np.random.default_rng(1).poisson(100, (30, 8, 8)).astype("u2")
    counts[12] = counts[11]
    np.save(tmp_path / "movie.npy", counts.astype(stored))
    with open_stack(tmp_path / "movie.npy") as stack:
        goods = []
        for spans in ([(12, 20)], [(5, 15), (12, 20)]):
            reader = Reader(stack, Camera(), 0, 30, 10_000)
            for span in spans:
                _, good, _ = reader.counts(*span)
            goods.append(good.tolist())
        first = Reader(stack, Camera(), 12, 30, 10_000)
        assert first.counts(12, 20)[1].all()  # nothing before it is looked at
    assert goods[0] == goods[1] == [False] + 7 * [True]


@pytest.mark.parametrize("stored", ["<u2", ">u2"], ids=["in place", "read"])
def test_frames_of_one_chunk_after_the_other_are_those_of_the_file(
    tmp_path: Path, stored: str
) -> None:
    counts = np.random.default_rng(2).poisson(100, (40, 6, 8)).astype(stored)
    np.save(tmp_path / "movie.npy", counts)
    with open_stack(tmp_path / "movie.npy") as stack:
        reader = Reader(stack, Camera(), 3, 40, 12 * 6 * 8 * 2)
        for span in [(3, 9), (3, 15), (5, 13), (10, 25), (30, 40), (3, 15), (20, 40)]:
            found, good, light = reader.counts(*span)
            np.testing.assert_array_equal(found, counts[slice(*span)])
            assert good.all()
            np.testing.assert_allclose(light, counts[slice(*span)].mean(axis=(1, 2)), rtol=1e-12)
            if span == (30, 40):
                reader.forget()


def test_a_region_of_a_file_that_has_shrunk_is_not_looked_at(tmp_path: Path) -> None:
    counts = np.random.default_rng(3).poisson(100, (40, 32, 32)).astype("<u2")
    path = tmp_path / "movie.npy"
    np.save(path, counts)
    with open_stack(path) as stack, threads(1) as pool:
        chunk = Reader(stack, Camera(), 0, 40, 10**6).chunk((0, 40), 10, pool)
        np.testing.assert_array_equal(
            chunk.patch(3, 9, (1, 4), (2, 7)).counts, counts[3:9, 1:4, 2:7]
        )
        path.write_bytes(path.read_bytes()[:2000])
        with pytest.raises(DataError, match="shrank"):
            chunk.patch(3, 9, (1, 4), (2, 7))


# ---- threads of a worker ---------------------------------------------------------------------


def test_a_place_says_how_many_threads_there_are() -> None:
    with allotted(3, lambda: None), threads(1) as pool:
        assert pool._max_workers == 3
    with threads(1) as pool:
        assert pool._max_workers == 1


def test_work_that_is_no_longer_wanted_stops_before_its_next_task() -> None:
    done: list[int] = []

    def stop() -> None:
        if len(done) == 2:
            raise KeyboardInterrupt

    with allotted(1, stop), threads(4) as pool, pytest.raises(KeyboardInterrupt):
        list(pool.map(done.append, range(5)))
    assert done == [0, 1]
