"""The public list: complete, quick to import, documented, and pleasant in a notebook."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import tifffile
from matplotlib.figure import Figure

import iscat_analysis as ia
from iscat_analysis import notebook as shown
from iscat_analysis.records import REPEAT_COLUMNS

SMALL = {
    "simulation.frames": 120,
    "simulation.shape": [72, 72],
    "simulation.events": [
        {"frame": 60, "x_px": 20.2, "y_px": 22.8, "mass_kda": 900.0},
        {"frame": 60, "x_px": 50.9, "y_px": 47.1, "mass_kda": 1500.0},
    ],
    "background.frames": (0, 60),
    "fit.frames": (60, 120),
    "posterior.enabled": False,
    "bounds.pixels": 41,
}


@pytest.fixture(scope="module")
def config(sample_configs) -> ia.Config:
    return ia.configure(sample_configs["mass"], settings=SMALL)


@pytest.fixture(scope="module")
def movie(config, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("public") / "movie.tif"
    truth = ia.simulate_movie(config, str(path), seed=3)
    assert len(truth) == 2
    return path


@pytest.fixture(scope="module")
def result(movie, config) -> ia.Result:
    return ia.fit_movie(
        str(movie), config=config, posterior=True, settings={"posterior.steps": 1000}
    )


@pytest.fixture(scope="module")
def unsampled(movie, config) -> ia.Result:
    """Fit the movie as an array."""
    counts = tifffile.imread(movie)
    return ia.fit_movie(counts, name="from memory", config=config, posterior=False)


@pytest.fixture(scope="module")
def loaded(movie, config, tmp_path_factory) -> list[set[str]]:
    """List what a new process has loaded once it can analyse, in each way, and after a fit."""
    setup = tmp_path_factory.mktemp("loaded") / "setup.toml"
    setup.write_text(ia.config_to_toml(config), encoding="utf-8")
    code = (
        "import sys, iscat_analysis as ia; from iscat_analysis.pipeline.kinds import kind_of; "
        "of = lambda settings: kind_of(ia.configure(None, settings=settings)); "
        "of(['background.method=fixed']); print(*sys.modules); "
        "of(['background.method=sliding']), of(['fit.mode=track']); print(*sys.modules); "
        f"ia.fit_movie({str(movie)!r}, config={str(setup)!r}).view(0); print(*sys.modules)"
    )
    return [set(line.split()) for line in _in_a_new_process(code).splitlines()]


def _in_a_new_process(code: str) -> str:
    # Old libraries may use what new ones deprecate.
    strict = ["-W", "error", "-W", "default::DeprecationWarning"]
    return subprocess.run(
        [sys.executable, *strict, "-c", code], capture_output=True, text=True, check=True
    ).stdout


def test_importing_the_package_imports_nothing_heavy() -> None:
    code = "import sys, iscat_analysis; print(sorted({m.split('.')[0] for m in sys.modules}))"
    loaded = _in_a_new_process(code)
    assert not any(f"'{name}'" in loaded for name in ("numpy", "pandas", "numba", "matplotlib"))


def test_an_analysis_loads_nothing_that_it_does_not_need(loaded) -> None:
    """scipy.stats and scipy.signal, which loads it, would be a third of the time of the start."""
    fixed, every, _ = loaded
    assert {"scipy.special", "iscat_analysis.landing.find"} <= every  # the trap is set
    assert not {"scipy.stats", "scipy.signal", "scipy.sparse.linalg", "matplotlib"} & every
    assert not {name for name in fixed if name.startswith("iscat_analysis.tracking")}


def test_every_public_name_is_there_and_documented() -> None:
    source = ast.parse(Path(ia.__file__).read_text(encoding="utf-8"))
    typed = [node.names[0].name for node in ast.walk(source) if isinstance(node, ast.ImportFrom)]
    assert {*typed} - {"annotations", "import_module", "Path", "TYPE_CHECKING"} == {*ia.__all__}
    assert set(ia.__all__) <= set(dir(ia))
    for name in ia.__all__:
        assert getattr(ia, name).__doc__
        assert name in {*ia.__dir__()}
    with pytest.raises(AttributeError, match="no attribute 'fit_stakc'"):
        _ = ia.fit_stakc  # type: ignore[attr-defined]


def test_stages_do_not_hide_public_names() -> None:
    """A submodule of the same name would take its place once something imports it."""
    modules = {path.stem for path in Path(ia.__file__).parent.iterdir()}
    assert not modules & set(ia.__all__)


def test_the_docstring_walks_the_flow_with_names_that_exist() -> None:
    assert ia.__doc__ is not None
    used = {word.split("(")[0] for word in ia.__doc__.split("ia.")[1:]}
    assert {name for name in used if name.isidentifier()} <= set(ia.__all__)


# ---- configuration -----------------------------------------------------------------------------


def test_configure_changes_removes_and_keeps(config) -> None:
    changed = ia.configure(config, settings={"optics.na": 1.3, "camera.well_depth_e": None})
    assert changed.optics.na == 1.3
    assert changed.camera.well_depth_e is None
    assert config.optics.na == 1.42
    assert ia.configure(config) is config
    assert ia.configure() == ia.load_config()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"optics.nna": 1}, "did you mean na?"),
        ({"optic.na": 1}, "did you mean optics?"),
        ({"na": 1}, 'write "na" as "section.key"'),
        ({"optics.na": 2.0}, "must be below n_immersion"),
    ],
)
def test_configure_names_the_nearest_key(settings, said) -> None:
    with pytest.raises(ia.ConfigError, match=said.replace("?", r"\?")):
        ia.configure(settings=settings)


def test_a_configuration_may_be_a_path_as_text(sample_configs) -> None:
    assert ia.configure(str(sample_configs["joint"])).fit.mode == "joint"


# ---- fitting -----------------------------------------------------------------------------------


def test_two_arguments_are_enough_where_the_movie_tells_the_rest(movie) -> None:
    found = ia.fit_movie(movie, background=(0, 60), posterior=False)
    assert len(found) == 2
    assert found.mode == "mass"


def test_an_array_is_fitted_as_the_file_that_holds_it(unsampled, result) -> None:
    for name in ("x_px", "y_px", "mass_kda", "sigma_mass_kda"):
        np.testing.assert_array_equal(unsampled.table[name], result.table[name])
    assert unsampled.summary["input"]["path"] == "from memory"
    assert len(unsampled.summary["input"]["sha256"]) == 64


def test_named_arguments_win(movie, config, monkeypatch) -> None:
    given: list[ia.Config] = []

    def analyse(_: ia.Stack, resolved: ia.Config, *__: Any, **___: Any) -> None:
        given.append(resolved)

    monkeypatch.setattr(shown, "analyse", analyse)
    ia.fit_movie(
        movie, config=config, mode="joint", frames=(60, 100), workers=1, posterior=False,
        settings={"fit.mode": "mass", "fit.roi_nm": 2000.0, "optics.focus_nm": -300.0},
    )  # fmt: skip
    (found,) = given
    assert (found.fit.mode, found.fit.frames, found.fit.roi_nm) == ("joint", (60, 100), 2000.0)
    assert (found.compute.workers, found.posterior.enabled) == (1, False)


def test_the_table_is_a_frame(result) -> None:
    assert isinstance(result.table, pd.DataFrame)
    # two particles do not test the optics, and have 1.5 MDa on a line of light standards
    systematic = "systematic_x_nm", "systematic_y_nm", "systematic_mass_kda"
    columns = *ia.EVENT_COLUMNS, *systematic, *REPEAT_COLUMNS, "model"
    assert tuple(result.table.columns) == columns
    assert len(result) == len(result.table) == 2


def test_the_text_says_what_was_found(result) -> None:
    text = repr(result)
    assert text.startswith("Result: 2 events in movie.tif, mode mass")
    assert "2 ok" in text
    assert len(text.splitlines()) <= 20
    assert "CRB" in text
    assert "kDa" in text
    assert max(map(len, text.splitlines())) <= 80


def test_the_notebook_says_the_same_and_no_rows(result) -> None:
    page = result._repr_html_()
    assert "in events that are not alike and too few to tell species" in page
    assert "2 events: 2 ok." in page
    assert "<tr" not in page  # two events are no species


def test_what_one_types_first_works_or_names_the_nearest(result) -> None:
    """Control: a name like none of them gets no hint."""
    for name, near in {
        "plot_mass": "plot_masses",
        "hist": "histogram",
        "specie": "species",
    }.items():
        with pytest.raises(AttributeError, match=f"has no '{name}'; did you mean .*{near}"):
            getattr(result, name)
    with pytest.raises(AttributeError, match=r"has no 'qqqqqqq'$"):
        _ = result.qqqqqqq
    assert len(result.events) == 2
    assert result.species.empty
    figure = result.histogram(bins=5)
    assert len(figure.axes[0].patches) == 5


def test_figures_are_matplotlibs_and_draw_themselves(result) -> None:
    drawn = [result.overview(), result.view(0), result.histogram(), result.precision()]
    for figure in [*drawn, result.corner(1)]:
        assert isinstance(figure, Figure)
        assert figure._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]


def test_pyplot_is_left_alone(loaded) -> None:
    assert "matplotlib.figure" in loaded[-1]  # the trap is set
    assert "matplotlib.pyplot" not in loaded[-1]


def test_the_posterior_is_arviz(result) -> None:
    samples = result.posterior(0)
    assert set(samples.groups()) == {"posterior", "sample_stats"}
    mass = samples.posterior["mass_kda"]
    assert mass.dims == ("chain", "draw")
    assert mass.attrs["units"] == "kDa"
    row = result.table.iloc[0]
    assert abs(float(mass.mean()) - row["mass_kda"]) < row["sigma_mass_kda"]
    assert samples.sample_stats["log_likelihood"].shape == mass.shape


def test_images_have_one_shape(result) -> None:
    images = result.images(0)
    assert images.contrast.shape == images.model.shape == images.residual.shape
    assert np.isfinite(images.residual).all()


def test_what_is_not_there_is_said(result, unsampled) -> None:
    with pytest.raises(ia.DataError, match="there is no event 7; it has events 0 to 1"):
        result.view(7)
    with pytest.raises(ia.DataError, match=r"was not sampled; fit again with posterior\.enabled"):
        unsampled.posterior(0)


def test_nothing_found_is_a_result(movie, config) -> None:
    blank = ia.fit_movie(movie, config=config, background=(0, 30), frames=(30, 60))
    assert len(blank) == 0
    assert "0 events" in repr(blank)
    assert "0 events" in blank._repr_html_()
    assert blank.species.empty
    with pytest.raises(ia.DataError, match="no event was found"):
        blank.histogram()
    with pytest.raises(ia.DataError, match="no event was found"):
        blank.view(0)


def test_saving_is_the_command_lines(result, movie, config, tmp_path) -> None:
    folder = result.save(str(tmp_path / "kept"))
    assert (folder / "report.html").is_file()
    with pytest.raises(ia.DataError, match="pass `overwrite`"):
        result.save(folder)
    result.save(folder, overwrite=True)
    with pytest.raises(ia.DataError):
        ia.fit_movie(movie, config=config, out=folder)


# ---- bounds ------------------------------------------------------------------------------------


def test_bounds_are_frames(config) -> None:
    bounds = ia.compute_bounds(config, mode="joint", settings={"particle.mass_kda": 480.0})
    actual = bounds.actual
    assert list(actual.index) == ["x_nm", "y_nm", "z_nm", "mass_kda"]
    assert (actual["qcrb"] < actual["crb_single"]).all()
    assert "mass_rel" in bounds.per_photon.index
    assert repr(bounds).startswith("Bounds: 480 kDa at z = 5 nm")
    assert "crb_joint" in bounds._repr_html_()
    curve = bounds.scan("focus=-200:200:200")
    assert list(curve["focus"]) == [-200, 0, 200]
    with pytest.raises(ia.ConfigError):
        bounds.scan("focsu=0:1:1")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"background": 200}, "background: [start, stop) takes two numbers"),
        ({"frames": 200}, "frames: [start, stop) takes two numbers"),
        ({"mode": "masses"}, "mode: input should be 'mass'"),
        ({"pixel_size_nm": 0.0844}, "if 0.0844 is in micrometres, write 84.4"),
        ({"workers": 0}, "workers: "),
        ({"config": 200}, "not from a int"),
        ({"config": {"optics": {"nna": 1.4}}}, "did you mean na?"),
    ],
)
def test_messages_name_the_argument(arguments: dict[str, Any], expected: str) -> None:
    with pytest.raises(ia.ConfigError) as caught:
        ia.fit_movie("absent.tif", **arguments)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("event", ["0", 0.0, True, None])
def test_events_have_whole_numbers(result: ia.Result, event: Any) -> None:
    with pytest.raises(ia.ConfigError, match="events have whole numbers"):
        result.view(event)


def test_a_number_of_numpy_is_whole(result: ia.Result) -> None:
    assert result.view(np.int64(0)) is not None
