"""The report of a tracking job: paths, masses, speeds, films."""

from __future__ import annotations

import base64
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from report_factory import make_analysis
from walkers import EXPOSURE_MS, RATE_HZ, fits_of, walk

from iscat_analysis.findings.results import NOT_A_MASS
from iscat_analysis.notebook import Result
from iscat_analysis.records import FREE_PARAMETERS, TRACK_COLUMNS, free_parameters
from iscat_analysis.report import pictures, render_report, write_report
from iscat_analysis.report.answer import spoken
from iscat_analysis.report.movie_figures import Sample, mean_squared_displacement, movie_figures
from iscat_analysis.report.pictures import films_shown
from iscat_analysis.report.vega import figures_in


def test_a_page_of_tracks_shows_paths_masses_speeds_and_films(tmp_path: Path) -> None:
    analysis = make_analysis(100, "track")
    assert analysis.tracks is not None
    out = write_report(analysis, tmp_path / "out")
    page = (out / "report.html").read_text(encoding="utf-8")
    figures = figures_in(out / "report.html")
    assert {"masses", "field", "mobility", "msd"} <= set(figures)
    assert figures["field"].name == "paths"
    assert len(figures["masses"].data["bars"]["low"]) > 1
    assert figures["mobility"].data["events"]["event"] == analysis.tracks["track"].tolist()
    assert len(analysis.tracks) == 10
    assert page.count("data:image/webp;base64,") == len(analysis.films) == 2
    assert "because it is &lt;b&gt;long" in page
    film = next(films_shown(analysis))
    content = base64.b64decode(film["film"].removeprefix("data:image/webp;base64,"))
    with Image.open(io.BytesIO(content)) as moving:
        assert moving.n_frames == 6
        assert moving.info["loop"] == 0
        assert moving.size == (3 * 24 + 2 * 2, 24)
    written = pd.read_csv(out / "tracks.csv")
    assert list(written.columns) == list(TRACK_COLUMNS)


def test_spheres_lie_on_lines_of_constant_index() -> None:
    """The configured one runs through spheres whose two diameters are equal."""
    analysis = make_analysis(40, "track")
    assert "sizes" not in movie_figures(analysis)
    assert analysis.tracks is not None
    sizes = np.linspace(60.0, 180.0, len(analysis.tracks))
    errors = {"sigma_diameter_nm": 5.0, "sigma_optical_diameter_nm": 1.0}
    tracks = analysis.tracks.assign(diameter_nm=sizes, optical_diameter_nm=sizes, **errors)
    toml = 'fit.mode = "track"\nbackground.frames = [0, 9]\nparticle.model = "mie"\n'
    toml += 'particle.kind = "silica"\n'
    spheres = replace(analysis, tracks=tracks, config_toml=toml)
    data = movie_figures(spheres)["sizes"].data
    lines, dots = (pd.DataFrame(data[name]) for name in ("materials", "spheres"))
    own = lines[lines["own"]]
    assert len(dots) == len(sizes)
    off = np.interp(dots["diameter"], own["diameter"], own["length"]) - dots["length"]
    assert np.abs(off).max() < 0.05


def test_films_that_would_fill_the_page_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    analysis = make_analysis(40, "track")
    assert len(list(pictures.films_shown(analysis))) == 2
    monkeypatch.setattr(pictures, "FILM_BYTES", 9000)
    assert len(list(pictures.films_shown(analysis))) == 1


def test_the_line_through_a_mean_squared_displacement_is_the_one_expected() -> None:
    """Over many tracks the points of the figure are what D, errors and blur make of them."""
    rng, lags_of = np.random.default_rng(3), []
    for _ in range(200):
        path = fits_of([walk(rng, 80, 0.3)], rng, sigma_nm=20.0)
        lags, measured, error = mean_squared_displacement(path)
        predicted = 4 * 0.3e6 * (lags / RATE_HZ - EXPOSURE_MS / 3e3) + error
        lags_of.append(measured / predicted)
    ratios = np.array(lags_of)
    error = ratios.std(axis=0) / np.sqrt(len(ratios))
    assert np.all(np.abs(ratios.mean(axis=0) - 1) < 4 * error)


def test_a_headline_of_tracks_that_are_flagged_has_no_median() -> None:
    analysis = make_analysis(200, "track")
    assert analysis.tracks is not None
    tracks = analysis.tracks.assign(status="ok", flags="")
    assert spoken(replace(analysis, tracks=tracks)).facts[0].startswith("Mass 6")
    tracks.loc[:4, ["status", "flags"]] = "not_free"
    said = spoken(replace(analysis, tracks=tracks))
    assert said.cautions[0].startswith("5 of 20 that are long enough are flagged")
    assert said.facts == []
    tracks.loc[:4, ["status", "flags"]] = "few_frames"
    assert spoken(replace(analysis, tracks=tracks)).facts[0].startswith("Mass 6")
    bare = replace(analysis, tracks=tracks, summary={**analysis.summary, "mass_scale": "absolute"})
    said = spoken(bare)
    assert f"{NOT_A_MASS().text}." in said.cautions
    assert said.facts[0].startswith("Contrast")
    assert "kDa" not in said.facts[0]


def test_a_height_that_was_held_fixed_is_in_no_table_of_precision() -> None:
    analysis = make_analysis(40, "track")
    assert free_parameters("track", analysis.table) == FREE_PARAMETERS["joint"]
    flat = analysis.table.assign(sigma_z_nm=np.nan, crb_z_nm=np.nan)
    assert free_parameters("track", flat) == FREE_PARAMETERS["mass"]
    assert free_parameters("joint", flat) == FREE_PARAMETERS["joint"]
    page = render_report(replace(analysis, table=flat))
    assert "<td>z [nm]</td>" not in page
    assert "<td>z [nm]</td>" in render_report(analysis)


def test_a_result_shows_its_tracks() -> None:
    result = Result(make_analysis(40, "track"))
    assert "4 tracks of 40 positions" in repr(result)
    assert ".tracks" in repr(result)
    assert "4 tracks of 40 positions" in result._repr_html_()
    assert len(result.tracks) == 4
    assert list(Result(make_analysis(3)).tracks.columns) == list(TRACK_COLUMNS)
    assert result.overview() is not None
    assert result.histogram() is not None


def test_populations_of_spheres_that_move_are_the_answer() -> None:
    analysis = make_analysis(200, "track")
    assert analysis.tracks is not None
    sizes = np.random.default_rng(5).lognormal(np.log(100), 0.05, len(analysis.tracks))
    tracks = analysis.tracks.assign(
        status="ok", flags="", diameter_nm=sizes, optical_diameter_nm=sizes,
        sigma_diameter_nm=2.0, sigma_optical_diameter_nm=2.0,
    )  # fmt: skip
    one = {
        "diameter_nm": 100.0, "diameter_low": 97.0, "diameter_high": 103.0, "geometric_sd": 1.05,
        "count": 20.0, "fraction": 1.0, "fraction_low": 1.0, "fraction_high": 1.0, "outlier": False,
    }  # fmt: skip
    curve = {"diameter_nm": [90.0, 100.0, 110.0], "model": [0.1, 0.8, 0.1]}
    summary = {**analysis.summary, "sizes": {"populations": [one], "curve": curve, "notes": []}}
    sample = Sample(replace(analysis, tracks=tracks, summary=summary))
    assert [each.name for each in sample.species] == ["100"]
    assert set(sample.members) == {0}
    assert movie_figures(sample.analysis)["masses"].data["peaks"]["label"] == ["100 nm"]
