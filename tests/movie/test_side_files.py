"""Gain, exposure, scale and binning from drivers' names, in the file and in texts beside it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
from tiff_files import movie, write_micro_manager

from iscat_analysis.movie import open_stack
from iscat_analysis.records import StackMetadata

SOLIS = """\
Date and Time:\tTue Nov 24 10:11:12 2026
Software Version:\t4.32.30065.0
Acquisition Mode:\tKinetic
Exposure Time (secs):\t0.00400
Kinetic Cycle Time (secs):\t0.00500
Horizontal binning:\t2
Pre-Amplifier Gain:\t4x
"""
PYLON = """\
# {05D8C294-F295-4dfb-9D01-096BD04049F4}
# GenApi persistence file (version 3.1.0)
ExposureTime\t4000.0
Gain\t6.00000
BlackLevel\t4.00000
AcquisitionFrameRateEnable\t{on}
AcquisitionFrameRate\t200.0
BinningHorizontal\t1
"""
PYLABLIB = """\
cam/data_dimensions\t(6, 5)
cam/frame_timings\t(4.000000000000E-03, 5.000000000000E-03)
save/path\tD:/data/movie.tif
"""
OWN = {
    "camera": {"ExposureTime": 4000.0, "SensorPixelWidth": 5.04, "BinningHorizontal": 1},
    "optics": {"magnification": 60, "wavelength_nm": 445, "na": 1.3, "gain_e_per_adu": 0.5},
}


def read(folder: Path, beside: dict[str, str]) -> StackMetadata:
    path = folder / "movie.tif"
    tifffile.imwrite(path, movie(5), photometric="minisblack", metadata={"axes": "TYX"})
    for name, text in beside.items():
        (folder / name).write_text(text, encoding="utf-8")
    with open_stack(path) as stack:
        return stack.metadata


@pytest.mark.parametrize(
    ("name", "text", "found"),
    [
        ("movie.txt", SOLIS, {"exposure_ms": 4, "frame_rate_hz": 200, "binning": 2}),
        ("movie.pfs", PYLON.replace("{on}", "1"), {
            "exposure_ms": 4, "frame_rate_hz": 200, "binning": 1,
        }),
        ("movie.pfs", PYLON.replace("{on}", "0"), {"exposure_ms": 4, "binning": 1}),
        ("movie_settings.dat", PYLABLIB, {"exposure_ms": 4, "frame_rate_hz": 200}),
        ("movie.json", json.dumps(OWN), {
            "exposure_ms": 4, "binning": 1, "magnification": 60, "wavelength_nm": 445, "na": 1.3,
            "pixel_size_nm": 84, "gain_e_per_adu": 0.5,
        }),
        ("movie.json", json.dumps({"ExposureTime": 0.004, "StackCycleTime": 0.005}), {
            "exposure_ms": 4, "frame_rate_hz": 200,
        }),
    ],
)  # fmt: skip
def test_a_text_beside_the_movie(tmp_path: Path, name: str, text: str, found: dict) -> None:
    """A gain in decibels, or the factor of an amplifier, is not taken for electrons per count."""
    said = read(tmp_path, {name: text})
    for key in StackMetadata.__dataclass_fields__:
        expected = found.get(key, name if key == "source" else None)
        assert getattr(said, key) == (pytest.approx(expected) if key in found else expected), key


@pytest.mark.parametrize(
    "text", ["", "{broken", "[" * 5000, '{"exposure_ms": -4, "na": 7, "binning": "none"}',
             "exposure_ms = nan", "Gain: 4\nlaser 2"],
)  # fmt: skip
def test_what_says_nothing_is_left_alone(tmp_path: Path, text: str) -> None:
    assert read(tmp_path, {"movie.json": text, "movie.txt": text}) == StackMetadata()


def test_the_file_itself_comes_first(tmp_path: Path) -> None:
    path = tmp_path / "movie.tif"
    tifffile.imwrite(
        path, movie(5), imagej=True, resolution=(20.0, 20.0), metadata={"axes": "TYX", "unit": "um"}
    )
    (tmp_path / "movie.json").write_text('{"pixel_size_nm": 84, "exposure_ms": 4}')
    with open_stack(path) as stack:
        said = stack.metadata
    assert (said.pixel_size_nm, said.exposure_ms) == (pytest.approx(50, rel=1e-6), 4)
    assert said.source == "imagej+movie.json"


def test_photometrics_and_andor_in_micro_manager(tmp_path: Path) -> None:
    fields = {
        "Prime-Actual Gain e/ADU": {"PropVal": "0.87"}, "Prime-Binning": "2x2",
        "Prime-ActualInterval-ms": "5.0", "Prime-Gain": "3", "Prime-Pre-Amp-Gain": "Gain 2",
    }  # fmt: skip
    frames = [{"Frame": k, **fields} for k in range(5)]
    with open_stack(write_micro_manager(tmp_path / "m.tif", movie(5), frames)) as stack:
        said = stack.metadata
    assert (said.gain_e_per_adu, said.offset_adu, said.binning) == (0.87, None, 2)
    assert said.frame_rate_hz == pytest.approx(200)


def test_metadata_stay_with_what_is_made_of_a_movie(tmp_path: Path) -> None:
    path = tmp_path / "movie.tif"
    tifffile.imwrite(path, movie(9), photometric="minisblack", metadata={"axes": "TYX"})
    (tmp_path / "movie.txt").write_text(SOLIS)
    with open_stack(path) as stack:
        one = stack.channel((2, 1))
        assert one.metadata.exposure_ms == 4
        assert one.metadata.frame_rate_hz == pytest.approx(100)  # every other frame
        assert one.shape[0] == 4
        np.testing.assert_array_equal(one.read(1, 3), movie(9)[[3, 5]])
        assert one.read(2, 2).shape == (0, 10, 14)
