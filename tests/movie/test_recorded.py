"""Plain numbers that settings beside them describe, as PyLabLib writes them, or their name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_files import assert_whole, refused

from iscat_analysis.day.table import read_table
from iscat_analysis.movie import files_of, open_stack

COUNTS = np.random.default_rng(1).integers(0, 60000, (7, 6, 5)).astype("<u2")

# As `pylablib.core.fileio.savefile.save_dict` writes what cam-control's frame saver hands it.
SETTINGS = """\
cam/data_dimensions\t(6, 5)
cam/frame_timings\t(1.000000000000E-03, 2.000000000000E-03)
save/path\tD:/data/movie.bin
save/path_kind\tpfx
save/append\t{append}
save/format\traw
save/saved\t{saved}
save/frame/shape\t{shape}
save/frame/dtype\t{dtype}

# Saved on 2026/01/23 10:11:12
"""


def _settings(path: Path, **changes: object) -> None:
    given = {"append": False, "saved": 7, "shape": "(6, 5)", "dtype": "<u2", **changes}
    path.write_text(SETTINGS.format(**given), encoding="utf-8")


@pytest.mark.parametrize("suffix", [".bin", ".raw"])
@pytest.mark.parametrize("dtype", ["<u2", "|u1", "<f8"])
def test_reads_a_movie_with_its_settings(tmp_path: Path, dtype: str, suffix: str) -> None:
    counts = (COUNTS % 200).astype(dtype)
    path = tmp_path / f"movie{suffix}"
    path.write_bytes(counts.tobytes())
    _settings(tmp_path / "movie_settings.dat", dtype=dtype)
    assert_whole(path, counts)
    with open_stack(path) as stack:
        assert stack.shape == COUNTS.shape
        assert stack.read(2, 4).tolist() == counts[2:4].tolist()
        before = stack.identity
    _settings(tmp_path / "movie_settings.dat", dtype=dtype, shape="(5, 6)")
    with open_stack(path) as stack:
        assert stack.shape == (7, 5, 6)
        assert stack.identity != before


def test_settings_in_a_folder_of_the_recording(tmp_path: Path) -> None:
    (tmp_path / "frames.bin").write_bytes(COUNTS.tobytes())
    _settings(tmp_path / "settings.dat")
    assert_whole(tmp_path / "frames.bin", COUNTS)


def test_what_is_said_on_the_command_line_wins(tmp_path: Path) -> None:
    path = tmp_path / "movie.bin"
    path.write_bytes(COUNTS.tobytes())
    _settings(tmp_path / "movie_settings.dat")
    with open_stack(f"{path}::15x7,uint16") as stack:
        assert stack.shape == (2, 15, 7)


@pytest.mark.parametrize("stem", ["movie", "frames", "a[1]_20260123"])
def test_reads_a_movie_in_parts_from_any_of_them(tmp_path: Path, stem: str) -> None:
    for number, part in enumerate((COUNTS[:3], COUNTS[3:6], COUNTS[6:])):
        (tmp_path / f"{stem}_{number:04}.bin").write_bytes(part.tobytes())
    (tmp_path / f"{stem}_background.bin").write_bytes(COUNTS[0].tobytes())
    (tmp_path / f"{stem}_more_0000.bin").write_bytes(COUNTS[0].tobytes())
    settings = tmp_path / ("settings.dat" if stem == "frames" else f"{stem}_settings.dat")
    _settings(settings, append=True)
    hashes = set()
    for number in range(3):
        path = tmp_path / f"{stem}_{number:04}.bin"
        assert_whole(path, COUNTS)
        with open_stack(path) as stack:
            hashes.add(stack.sha256())
        assert len(files_of(path)) == 4
    assert len(hashes) == 1
    assert [row.given for row in read_table(tmp_path).rows] == [f"{stem}_0000.bin"]
    (tmp_path / f"{stem}_0001.bin").rename(tmp_path / "away.bin")
    refused(tmp_path / f"{stem}_0000.bin", "part 0001 of its movie is missing")
    (tmp_path / "away.bin").rename(tmp_path / f"{stem}_0001.bin")
    (tmp_path / f"{stem}_0002.bin").unlink()
    refused(tmp_path / f"{stem}_0000.bin", "7 frames were saved, but there are 6")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"shape": "(6, 4)"}, "420 bytes, but movie_settings.dat says 6 x 4 pixels of uint16"),
        ({"dtype": "<u4", "shape": "(6, 10)"}, "multiple of 240"),
        ({"saved": 6}, "6 frames were saved, but there are 7"),
        ({"saved": 8, "append": True}, "8 frames were saved, but there are 7"),
        ({"dtype": "<u17"}, "is no type of numbers"),
        ({"dtype": "?", "saved": 14}, "needs to be frames"),
        ({"shape": "(0, 5)"}, "multiple of 0"),
        ({"shape": "(7, 6, 5)"}, "does not say save/frame/shape"),
        ({"dtype": ""}, "written when a recording ends"),
    ],
)
def test_settings_that_do_not_fit_arerefused(
    tmp_path: Path, changes: dict[str, object], said: str
) -> None:
    (tmp_path / "movie.bin").write_bytes(COUNTS.tobytes())
    _settings(tmp_path / "movie_settings.dat", **changes)
    refused(tmp_path / "movie.bin", said, "movie")


def test_frames_added_to_an_earlier_recording_are_read_with_it(tmp_path: Path) -> None:
    (tmp_path / "movie.bin").write_bytes(COUNTS.tobytes())
    _settings(tmp_path / "movie_settings.dat", saved=3, append=True)
    assert_whole(tmp_path / "movie.bin", COUNTS)


def test_a_single_frame_is_no_movie(tmp_path: Path) -> None:
    (tmp_path / "movie.bin").write_bytes(COUNTS[:1].tobytes())
    _settings(tmp_path / "movie_settings.dat", saved=1)
    refused(tmp_path / "movie.bin", "holds a single frame")


def test_settings_that_cannot_be_settings_arerefused(tmp_path: Path) -> None:
    (tmp_path / "movie.bin").write_bytes(COUNTS.tobytes())
    (tmp_path / "movie_settings.dat").write_bytes(b"\xff\x00" * 100)
    refused(tmp_path / "movie.bin", "does not say save/frame/shape")
    with (tmp_path / "movie_settings.dat").open("wb") as file:
        file.truncate(2**30)
    refused(tmp_path / "movie.bin", "has 10000000 at most")


def test_the_name_of_piscats_movies_tells_their_shape(tmp_path: Path) -> None:
    path = tmp_path / "control_7_6_5_uint16_2.33FPS.raw"
    path.write_bytes(COUNTS.tobytes())
    assert_whole(path, COUNTS)
    assert [row.given for row in read_table(tmp_path).rows] == [path.name]
    path.write_bytes(COUNTS[:-1].tobytes())  # then the name tells nothing
    refused(path, "if it is plain numbers, say so")


def test_a_folder_leaves_out_numbers_that_nothing_describes(tmp_path: Path) -> None:
    for name in ("movie", "movie_snapshot", "other", "movie_background"):
        (tmp_path / f"{name}.bin").write_bytes(COUNTS.tobytes())
    for name in ("movie", "movie_snapshot"):
        _settings(tmp_path / f"{name}_settings.dat")
    assert [row.given for row in read_table(tmp_path).rows] == ["movie.bin"]
