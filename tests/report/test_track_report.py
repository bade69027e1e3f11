"""The report of a tracking job: paths, masses, speeds, films."""

from __future__ import annotations

import re
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
from iscat_analysis.report import event_figures, render_report, track_figures, write_report
from iscat_analysis.report.answer import headline


def test_a_page_of_tracks_shows_paths_masses_speeds_and_films(tmp_path: Path) -> None:
    analysis = make_analysis(100, "track")
    assert analysis.tracks is not None
    out = write_report(analysis, tmp_path / "out")
    page = (out / "report.html").read_text(encoding="utf-8")
    drawn = {path.stem for path in (out / "figures").iterdir()}
    assert {"overview", "mass_d", "distributions", "msd", "track_0000"} <= drawn
    assert page.count('<tr id="row-') == len(analysis.tracks) == 10
    assert page.count("data:image/webp;base64,") == len(analysis.films) == 2
    assert "because it is &lt;b&gt;long" in page
    with Image.open(out / "figures" / "track_0000.webp") as film:
        assert film.n_frames == 6
        assert film.info["loop"] == 0
        assert film.size == (3 * 24 + 2 * 2, 24)
    for gid in re.findall(r'id="\w+-rows-([\d_]+)"', page):
        assert all(int(row) < 10 for row in gid.split("_"))
    assert f"{len(analysis.tracks)} tracks of 100 fitted positions" in page
    written = pd.read_csv(out / "tracks.csv")
    assert list(written.columns) == list(TRACK_COLUMNS)


def test_spheres_lie_on_lines_of_constant_index() -> None:
    """The configured one runs through spheres whose two diameters are equal."""
    analysis = make_analysis(40, "track")
    assert not track_figures.has_plane(analysis)
    assert analysis.tracks is not None
    sizes = np.linspace(60.0, 180.0, len(analysis.tracks))
    errors = {"sigma_diameter_nm": 5.0, "sigma_optical_diameter_nm": 1.0}
    tracks = analysis.tracks.assign(diameter_nm=sizes, optical_diameter_nm=sizes, **errors)
    toml = 'fit.mode = "track"\nbackground.frames = [0, 9]\nparticle.model = "mie"\n'
    toml += 'particle.kind = "silica"\n'
    spheres = replace(analysis, tracks=tracks, config_toml=toml)
    assert track_figures.has_plane(spheres)
    (axes,) = track_figures.size_plane(spheres).axes
    lines = [line for line in axes.lines if len(line.get_xdata()) == 200]
    own = np.asarray(lines[-1].get_xydata(), dtype=float)
    dots = [np.asarray(line.get_xydata()) for line in axes.lines if line.get_marker() == "o"]
    found = np.concatenate(dots)
    assert len(found) == len(sizes)
    assert np.abs(np.interp(found[:, 0], *own.T) - found[:, 1]).max() < 0.05


def test_films_that_would_fill_the_page_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    analysis = make_analysis(40, "track")
    assert len(list(event_figures.films_shown(analysis))) == 2
    monkeypatch.setattr(event_figures, "FILM_BYTES", 9000)
    assert len(list(event_figures.films_shown(analysis))) == 1


def test_the_line_through_a_mean_squared_displacement_is_the_one_expected() -> None:
    """Over many tracks the points of the figure are what D, errors and blur make of them."""
    rng, lags_of = np.random.default_rng(3), []
    for _ in range(200):
        path = fits_of([walk(rng, 80, 0.3)], rng, sigma_nm=20.0)
        lags, measured, error = track_figures.mean_squared_displacement(path)
        predicted = 4 * 0.3e6 * (lags / RATE_HZ - EXPOSURE_MS / 3e3) + error
        lags_of.append(measured / predicted)
    ratios = np.array(lags_of)
    error = ratios.std(axis=0) / np.sqrt(len(ratios))
    assert np.all(np.abs(ratios.mean(axis=0) - 1) < 4 * error)


def test_a_headline_of_tracks_that_are_flagged_has_no_median() -> None:
    analysis = make_analysis(200, "track")
    assert analysis.tracks is not None
    tracks = analysis.tracks.assign(status="ok", flags="")
    said = headline(replace(analysis, tracks=tracks), analysis.table)
    assert "Over tracks: median mass" in said[0]
    tracks.loc[:4, ["status", "flags"]] = "not_free"
    said = headline(replace(analysis, tracks=tracks), analysis.table)
    assert "5 of 20 that are long enough are flagged" in said[0]
    assert "median mass" not in said[0]
    tracks.loc[:4, ["status", "flags"]] = "few_frames"
    assert "median mass" in headline(replace(analysis, tracks=tracks), analysis.table)[0]
    bare = replace(analysis, tracks=tracks, summary={**analysis.summary, "mass_scale": "absolute"})
    said = headline(bare, analysis.table)
    assert f"{NOT_A_MASS().text}." in said
    assert "contrast" in said[0]
    assert "kDa" not in said[0]


def test_the_colours_of_paths_cover_all_that_are_drawn() -> None:
    """Beyond those that are ok too, but for what is so far from them that they had one colour."""
    analysis = make_analysis(40, "track")
    assert analysis.tracks is not None
    tracks = analysis.tracks.assign(status="ok", mass_kda=[399.8, 400.3, 401.2, 196.0])
    tracks.loc[3, "status"] = "not_free"
    scale, _, beyond = track_figures.path_colors(replace(analysis, tracks=tracks))
    assert (scale.vmin, scale.vmax, beyond) == (196.0, 401.2, "neither")
    tracks.loc[3, "mass_kda"] = 9e3
    scale, _, beyond = track_figures.path_colors(replace(analysis, tracks=tracks))
    assert (scale.vmin, beyond) == (399.8, "max")
    assert scale.vmax == pytest.approx(3 * 401.2)
    drawn = track_figures.trajectories(replace(analysis, tracks=tracks), analysis.table)
    assert drawn.axes[-1].get_ylabel().startswith("mass")


@pytest.mark.usefixtures("sketched")
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
    assert "d_um2_s" in result._repr_html_()
    assert len(result.tracks) == 4
    assert list(Result(make_analysis(3)).tracks.columns) == list(TRACK_COLUMNS)
    assert result.overview() is not None
    assert result.histogram() is not None
