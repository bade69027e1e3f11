"""`iscat init`: from a bare movie to a configuration that says where every value comes from."""

from __future__ import annotations

import io
import json
import tomllib
from pathlib import Path
from typing import get_args

import jsonschema
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from tiff_files import ASCII, pages_of, write_tiff

from iscat_analysis.config import Particle, load_config
from iscat_analysis.movie import open_stack
from iscat_analysis.pipeline.setup import SAMPLES
from iscat_analysis.schemas import schema
from iscat_cli import main, main_fit
from iscat_cli.setup import Sample

GAIN = 4.0
FRAMES, SIDE = 300, 64
LANDING = [
    f"simulation.shape=[{SIDE}, {SIDE}]",
    f"simulation.frames={FRAMES}",
    "simulation.leavings=0",
    "simulation.events=[{frame=150, x_px=31.2, y_px=30.8, mass_kda=900.0}]",
]
OME = (
    '<?xml version="1.0" encoding="UTF-8"?>'
    '<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06">'
    '<Instrument ID="Instrument:0"><Objective ID="Objective:0" LensNA="1.4" '
    'NominalMagnification="60"/></Instrument><Image ID="Image:0"><Pixels ID="Pixels:0" '
    f'DimensionOrder="XYZCT" Type="uint16" SizeX="{SIDE}" SizeY="{SIDE}" SizeZ="1" SizeC="1" '
    f'SizeT="{FRAMES}" PhysicalSizeX="84" PhysicalSizeXUnit="nm" PhysicalSizeY="84" '
    'PhysicalSizeYUnit="nm" TimeIncrement="5" TimeIncrementUnit="ms"><Channel ID="Channel:0:0" '
    'ExcitationWavelength="520"/></Pixels></Image></OME>'
)


OME_FILE, ANSWER, LEARNED = "read from the file (ome)", "your answer", "will be learned"


@pytest.fixture(scope="module")
def counts(tmp_path_factory: pytest.TempPathFactory, sample_configs) -> NDArray:
    """Simulate a landing, with 4 electrons per count."""
    path = tmp_path_factory.mktemp("landing") / "movie.tif"
    options = [f"--set={change}" for change in LANDING]
    assert main(["simulate", "--config", str(sample_configs["landing"]), "--out", str(path),
                 "--quiet", *options]) == 0  # fmt: skip
    with open_stack(path) as movie:
        return movie.read(0, FRAMES)


@pytest.fixture
def ome(counts: NDArray, tmp_path: Path) -> Path:
    tags = {0: {270: (ASCII, OME)}}
    return write_tiff(tmp_path / "ome.tif", pages_of(counts), counts.shape[1:], page_tags=tags)


@pytest.fixture
def imagej(counts: NDArray, tmp_path: Path) -> Path:
    options = {"axes": "TYX", "unit": "um", "finterval": 0.01}
    scale = 1 / 0.084
    path = tmp_path / "imagej.tif"
    tifffile.imwrite(path, counts, imagej=True, resolution=(scale, scale), metadata=options)
    return path


@pytest.fixture
def plain(counts: NDArray, tmp_path: Path) -> Path:
    return write_tiff(tmp_path / "plain.tif", pages_of(counts), counts.shape[1:])


def _found(capsys, *arguments: str) -> dict:
    capsys.readouterr()
    assert main(["init", *arguments, "--yes", "--json", "--quiet"]) == 0
    found: dict = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    jsonschema.Draft202012Validator(schema("init")).validate(found)
    return found


@pytest.mark.parametrize(
    ("kind", "options", "origins"),
    [
        ("ome", [], [OME_FILE, OME_FILE, f"{OME_FILE}, {LEARNED}", "assumed"]),
        (
            "imagej",
            ["--wavelength-nm", "520"],
            ["read from the file (imagej)", ANSWER, f"assumed, {LEARNED}", "assumed"],
        ),
        (
            "plain",
            ["--pixel-size-nm", "84", "--na=1.4", "--sample=gold"],
            [ANSWER, "assumed", ANSWER, ANSWER],
        ),
        ("ome", ["--na", "1.4", "--instrument", "iscat"], [OME_FILE, OME_FILE, ANSWER, "assumed"]),
        (
            "plain",
            ["--pixel-size-nm=84", "--sample=gold", "--instrument", "iscat"],
            [ANSWER, "instrument iscat", f"instrument iscat, {LEARNED}", ANSWER],
        ),
    ],
)
def test_every_value_has_its_origin(
    kind: str, options: list[str], origins: list[str], request, capsys
) -> None:
    movie: Path = request.getfixturevalue(kind)
    found = _found(capsys, str(movie), *options)
    asked = ("camera.pixel_size_nm", "optics.wavelength_nm", "optics.na", "particle.kind")
    for key, origin in zip(asked, origins, strict=True):
        assert found["values"][key]["from"] == origin, key
    focus = found["values"]["optics.focus_nm"]
    named = "--instrument" in options
    assert focus["from"] == f"{'instrument iscat' if named else 'assumed'}, {LEARNED}"
    assert focus["value"] == (-150.0 if named else -300.0)
    assert "learned as an aberration" in found["values"]["optics.n_immersion"]["from"]
    calibration = found["values"]["calibration.gradient_per_kda"]
    assert calibration["value"] == ""
    assert calibration["from"].startswith("to be given, by `iscat calibrate mass`")
    out = movie.with_name("iscat.toml")
    assert found["out"] == str(out)
    text, config = out.read_text(encoding="utf-8"), load_config(out)
    assert config.camera.pixel_size_nm == pytest.approx(84)
    assert config.optics.wavelength_nm == found["values"]["optics.wavelength_nm"]["value"]
    assert config.optics.na == found["values"]["optics.na"]["value"]
    assert config.particle.kind == ("gold" if kind == "plain" else "protein")
    lines = [line for line in text.splitlines() if " = " in line]
    assert all(" # " in line for line in lines)
    assert "[simulation]" not in text  # which no movie has
    assert load_config(out).calibration is None
    assert len(lines) == len(found["values"])


def test_the_movie_tells_gain_light_and_what_is_there(ome: Path, capsys) -> None:
    found = _found(capsys, str(ome))
    gain = found["values"]["camera.gain_e_per_adu"]
    assert gain["from"] == "measured from the movie"
    assert found["values"]["fit.mode"] == {"value": "mass", "se": None, "from": "assumed"}
    assert abs(gain["value"] - GAIN) < 4 * gain["se"] < 0.1
    seen = found["preview"]
    assert seen["light_e"] == pytest.approx(1e5, rel=0.05)
    assert sum(seen["candidates"]) == 1
    assert seen["strongest_snr"] > seen["threshold_snr"]
    text = ome.with_name("iscat.toml").read_text(encoding="utf-8")
    assert 'gain_e_per_adu = "auto"' in text
    assert "# frame_rate_hz = 200.0" in text
    assert "frame_rate_hz" not in tomllib.loads(text)["camera"]


def test_a_field_in_which_nothing_happens_has_no_candidate(counts, tmp_path, capsys) -> None:
    empty = write_tiff(tmp_path / "empty.tif", pages_of(counts[:140]), counts.shape[1:])
    found = _found(capsys, str(empty), "--pixel-size-nm", "84")
    assert sum(found["preview"]["candidates"]) == 0
    assert found["preview"]["strongest_snr"] is None


def test_what_the_file_says_is_said(ome: Path, plain: Path, capsys) -> None:
    assert main(["init", str(ome), "--yes"]) == 0
    shown = capsys.readouterr()
    assert (
        "its ome metadata say pixels of 84 nm, wavelength 520 nm, NA 1.4, 60×, "
        "200 frames per second" in shown.err
    )
    assert "not known: kind of sample" in shown.err
    assert shown.out.count("read from the file (ome)") == 4
    assert main(["init", str(plain), "--yes", "--pixel-size-nm=84", "--overwrite"]) == 0
    assert "the file has no metadata that help" in capsys.readouterr().err


def test_what_nobody_can_guess_has_to_be_given(plain: Path, only_line) -> None:
    assert "give --pixel-size-nm" in only_line("init", str(plain), "--yes", "--quiet", status=1)
    assert not plain.with_name("iscat.toml").exists()


def test_a_file_that_is_there_is_kept(plain: Path, capsys) -> None:
    setup = plain.with_name("iscat.toml")
    setup.write_text("# mine\n", encoding="utf-8")
    options = [str(plain), "--yes", "--pixel-size-nm", "84"]
    assert main(["init", *options]) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert setup.read_text(encoding="utf-8") == "# mine\n"
    assert main(["init", *options, "--overwrite"]) == 0
    assert load_config(setup).camera.pixel_size_nm == 84


def test_particles_that_move_are_told_from_those_that_land(
    sample_configs, tmp_path: Path, capsys
) -> None:
    """The same setting with three proteins on a membrane."""
    movie = tmp_path / "moving.tif"
    changes = [
        "simulation.frames=160", "simulation.leavings=0", "simulation.count=0", "fit.mode=track",
        "simulation.movers=[{count=3, mass_kda=900.0, d_um2_s=0.15}]", "simulation.shape=[56, 56]",
        "camera.frame_rate_hz=331",
    ]  # fmt: skip
    options = [f"--set={change}" for change in changes]
    assert main(["simulate", "--config", str(sample_configs["landing"]), "--out", str(movie),
                 "--quiet", *options]) == 0  # fmt: skip
    found = _found(capsys, str(movie))
    mode = found["values"]["fit.mode"]
    assert (mode["value"], mode["from"]) == ("track", "measured from the movie")
    assert all(found["preview"]["candidates"])
    assert load_config(found["out"]).background.method == "tracks"


def test_the_kinds_of_samples_are_kinds_of_particles() -> None:
    assert get_args(Sample) == SAMPLES
    for kind in SAMPLES:
        assert Particle(kind=kind).kind == kind


class _Terminal(io.StringIO):
    """What somebody types."""

    def isatty(self) -> bool:
        """Say that it is a terminal."""
        return True


def test_only_what_is_not_known_is_asked_and_asked_again(imagej: Path, monkeypatch, capsys) -> None:
    """Of a wavelength in micrometres the program says what is wrong with it, and asks again."""
    monkeypatch.setattr("sys.stdin", _Terminal("0.52\n520\n\ngold\n"))
    assert main(["init", str(imagej)]) == 0
    shown = capsys.readouterr()
    assert "its imagej metadata say pixels of 84 nm" in shown.err
    assert "if 0.52 is in micrometres, write 520" in shown.err
    assert shown.err.count("wavelength in vacuum [nm] [525.0]:") == 2
    assert "numerical aperture of the objective [1.42]:" in shown.err
    assert "size of a pixel" not in shown.err
    config = load_config(imagej.with_name("iscat.toml"))
    assert (config.optics.wavelength_nm, config.optics.na) == (520, 1.42)
    assert config.particle.kind == "gold"
    assert "your answer" in shown.out


def test_an_interrupted_question_writes_nothing(imagej: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr("sys.stdin", _Terminal(""))
    assert main(["init", str(imagej)]) == 130
    assert "interrupted" in capsys.readouterr().err
    assert not imagej.with_name("iscat.toml").exists()


def test_fit_finds_the_file_beside_the_movie(plain: Path, tmp_path: Path, capsys) -> None:
    assert main(["init", str(plain), "--yes", "--pixel-size-nm=84", "--na=1.4", "--quiet"]) == 0
    capsys.readouterr()
    changes = ["--set", "optics.calibrate=never", "--set", "fit.spheres=[]", "--json"]
    assert main_fit([str(plain), *changes]) == 0
    shown = capsys.readouterr()
    said = f"the configuration is {plain.with_name('iscat.toml')}, which lies beside the movie"
    assert shown.err.count(said) == 1
    assert load_config(plain.with_suffix(".iscat") / "config.toml").optics.na == 1.4
    events = json.loads(shown.out)["events"]
    assert len(events) == 1
    assert np.hypot(events[0]["x_nm"] - 31.2 * 84, events[0]["y_nm"] - 30.8 * 84) < 30

    other = tmp_path / "other.toml"
    other.write_text("[optics]\nna = 1.3\n[camera]\npixel_size_nm = 84.0\n", encoding="utf-8")
    assert main_fit([str(plain), "--config", str(other), *changes, "--overwrite"]) == 0
    assert "lies beside the movie" not in capsys.readouterr().err
    assert load_config(plain.with_suffix(".iscat") / "config.toml").optics.na == 1.3
