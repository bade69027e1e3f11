"""Figures for papers: what they show, in which unit, and that they leave no setting behind."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from report_factory import make_analysis, with_traces, without_events

from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.notebook import Result
from iscat_analysis.records import Analysis
from iscat_analysis.report import plots, write_report
from iscat_analysis.report.numbers import number
from iscat_analysis.species import describe


def _described(scale: str = "calibration", n: int = 60) -> Analysis:
    """Invent a landing movie of three species, all of whose events are ok."""
    analysis = make_analysis(n)
    table = analysis.table.assign(status="ok", flags="")
    masses, errors = (table[name].to_numpy() for name in ("mass_kda", "sigma_mass_kda"))
    errors = np.where(np.isfinite(errors), errors, 4.2)
    found = describe(masses, errors, seed=1).to_dict()
    more = {"distribution": found, "mass_scale": scale, "landing": {}}
    return replace(
        analysis, table=table.assign(sigma_mass_kda=errors), summary={**analysis.summary, **more}
    )


def _words(axes: Axes) -> str:
    words = axes.get_xlabel(), axes.get_ylabel(), axes.get_title("left")
    return "\n".join([*words, *(text.get_text() for text in axes.texts)])


def test_masses_show_landings_leavings_and_named_species() -> None:
    analysis = _described()
    axes = plots.plot_masses(analysis)
    labels = axes.get_legend_handles_labels()[1]
    assert set(labels) == {"landing", "leaving", "species"}
    heights = sum(patch.get_height() for patch in axes.patches)
    assert heights == 60
    species = Result(analysis).species
    assert len(species) == 3
    texts = [text.get_text() for text in axes.texts]
    expected = zip(species["mass_kda"], species["count"], strict=True)
    assert texts == [f"{number(mass)} kDa\n{count:.0f}" for mass, count in expected]
    (curve,) = axes.lines
    x, y = (np.asarray(values, float) for values in curve.get_data())
    width = axes.patches[0].get_width()
    assert np.trapezoid(y, x) / width == pytest.approx(60, rel=0.02)  # events under the curve


@pytest.mark.parametrize("draw", [plots.plot_masses, plots.plot_precision])
def test_without_a_scale_nothing_is_in_kda(draw) -> None:
    """Control: with a scale the same figures are in kDa."""
    for scale, said in (("absolute model", "contrast"), ("calibration", "kDa")):
        drawn = draw(_described(scale))
        text = "".join(map(_words, np.atleast_1d(np.asarray(drawn, dtype=object)).ravel()))
        assert said in text
        assert ("kDa" in text) == (scale == "calibration")


def test_bins_are_as_many_as_are_asked_for() -> None:
    analysis = _described()
    assert len({p.get_x() for p in plots.plot_masses(analysis, bins=7).patches}) == 7
    edges = np.arange(0, 600, 100)
    drawn = plots.plot_masses(analysis, bins=edges)
    assert sorted({p.get_x() for p in drawn.patches}) == edges[:-1].tolist()


def test_every_figure_draws_into_the_axes_that_it_is_given() -> None:
    """No setting is left, none is used, and pyplot is not loaded by a figure of its own."""
    analysis, tracked = with_traces(make_analysis(12)), make_analysis(60, "track")
    view = analysis.views[0]
    before = dict(mpl.rcParams)
    own = Figure()
    for draw, panels in (
        (lambda ax: plots.plot_masses(analysis, ax=ax), 1),
        (lambda ax: plots.plot_field(analysis, ax=ax), 1),
        (lambda ax: plots.plot_field(tracked, ax=ax), 1),
        (lambda ax: plots.plot_tracks(tracked, ax=ax), 1),
        (lambda ax: plots.plot_precision(analysis, ax=ax), 1),
        (lambda ax: plots.plot_precision(analysis, ax=ax), 3),
        (lambda ax: plots.plot_event(view, "iscat", 84.0, ax=ax), 3),
        (lambda ax: plots.plot_event(view, "iscat", 84.0, ax=ax), 4),
    ):
        own.clear()
        given = own.subplots(1, panels, squeeze=False)[0]
        drawn = draw(given if panels > 1 else given[0])
        assert list(np.atleast_1d(np.asarray(drawn, dtype=object))) == list(given)
        assert all(axes.has_data() for axes in given)
        assert given[0].spines["top"].get_visible() or panels > 2  # the style is the user's
        alone = draw(None)
        assert alone._repr_png_().startswith(b"\x89PNG")
        assert dict(mpl.rcParams) == before
    with pytest.raises(ConfigError, match=r"`ax`: has 2 axes, and this figure has 1 or 3"):
        plots.plot_precision(analysis, ax=own.subplots(1, 2))


def test_what_cannot_be_drawn_is_said() -> None:
    with pytest.raises(DataError, match="no event was found"):
        plots.plot_masses(without_events(make_analysis(1)))
    with pytest.raises(DataError, match="has no tracks, which mode track makes"):
        plots.plot_tracks(make_analysis(3))


@pytest.mark.parametrize(
    ("shape", "said"),
    [((64, 64), ""), ((20, 1000), "10 times as tall as wide"), ((1000, 20), "as wide as tall")],
)
def test_no_field_is_a_line(shape: tuple[int, int], said: str) -> None:
    axes = plots.plot_field(replace(make_analysis(3), ratio_image=np.zeros(shape)))
    assert said in axes.get_title("left")
    assert bool(axes.get_title("left")) == bool(said)
    figure = plots.figure_of(axes)
    figure.draw_without_rendering()
    assert min(axes.get_window_extent().size) / figure.dpi > 0.8


@pytest.mark.parametrize(
    ("mode", "scheme"),
    [("mass", "iscat"), ("mass", "darkfield"), ("localize", "iscat"), ("track", "iscat")],
)
def test_files_are_the_same_at_any_time(
    tmp_path: Path, mode: str, scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plots, "EVENT_FIGURES", 1)
    analysis = make_analysis(24, mode, scheme=scheme, side=16)
    names = {path.name for path in plots.write_figures(analysis, tmp_path, ("svg",))}
    expected = {"field.svg", "masses.svg", "precision.svg", "event_0000.svg"}
    assert names == expected | ({"tracks.svg"} if mode == "track" else set())
    assert "contrast" in (tmp_path / "event_0000.svg").read_text() or scheme == "darkfield"
    if scheme == "darkfield":
        again = tmp_path / "again"
        plots.write_figures(analysis, again, ("svg",))
        assert all((tmp_path / name).read_bytes() == (again / name).read_bytes() for name in names)


def test_nothing_found_has_only_a_field(tmp_path: Path) -> None:
    written = plots.write_figures(without_events(make_analysis(1)), tmp_path, ("svg",))
    assert [path.name for path in written] == ["field.svg"]


def test_a_report_has_figures_only_where_they_are_wanted(tmp_path: Path) -> None:
    analysis = make_analysis(3)
    plain = write_report(analysis, tmp_path / "plain")
    drawn = Result(analysis).save(tmp_path / "drawn", figures=True)
    assert not (plain / "figures").exists()
    assert (drawn / "figures" / "masses.png").is_file()
    assert (drawn / "figures" / "masses.svg").is_file()


def test_an_equilibrium_is_drawn_into_one_or_two_axes() -> None:
    profile = {"ln_kd_nm": [1.0, 2.0, 3.0], "deviance": [4.0, 0.0, 5.0]}
    rows = [
        {"concentration_nm": c, "complexes": s, "complexes_low": s - 0.1, "complexes_high": s + 0.1}
        for c, s in ((5.0, 0.2), (50.0, 0.6))
    ]
    found = {"model": "dimer", "samples": rows, "profile": profile, "kd_nm": 7.4, "kd_low": 3.0}
    found |= {"kd_high": 15.0, "curve": {"concentration_nm": [5, 50], "complexes": [0.2, 0.6]}}
    whole = plots.plot_kd(found)
    assert [axes.get_xlabel() for axes in whole] == ["monomers in all [nM]", "$K_D$ [nM]"]
    assert whole[1].get_title("left") == "$K_D$ = 7.40 nM"
    own = Figure().add_subplot()
    (only,) = plots.plot_kd(found, ax=own)
    assert only is own
