"""What is no argument is refused by name, whatever it is: never a crash, never a silent number."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest

import iscat_analysis as ia

_RANDOM = np.random.default_rng(1)
_EVENTS = pd.DataFrame(
    {
        "mass_kda": _RANDOM.normal(np.repeat([66.0, 132.0], [60, 40]), 8.0),
        "frame": np.arange(100) * 10,
        "x_px": 1.0,
        "y_px": 1.0,
    }
)
_TRACK = {
    "frames": np.arange(30),
    "positions_nm": np.cumsum(_RANDOM.normal(0, 30, (30, 2)), axis=0),
    "sigma_nm": np.full((30, 2), 5.0),
    "frame_rate_hz": 331.0,
}
_SPECIES = {"events": _EVENTS, "k": 2, "draws": 0, "sigma_kda": 8.0}
_GOOD: dict[str, dict[str, object]] = {
    "find_species": _SPECIES,
    "compare_samples": {"first": _EVENTS, "other": _EVENTS, "k": 1, "sigma_kda": 8.0},
    "fit_kinetics": {"events": _EVENTS, "frame_rate_hz": 100.0},
    "fit_diffusion": _TRACK,
    "confinement_test": _TRACK | {"resamples": 3},
    "anomalous_test": _TRACK,
    "hydrodynamic_diameter": {"d_um2_s": 1.0},
    "refractive_index": {"mass_kda": 150.0, "diameter_nm": 7.0},
}
# What no option of these is: of another type, of another shape, of no possible size.
_WRONG: list[object] = [
    "x", {}, [], math.nan, -1e30, 1e30, 1j, object(), b"a", np.zeros(0), np.zeros((2, 2, 2, 2)),
    np.array(["a", "b"]), [1, [2, 3]], np.datetime64("2020"),
]  # fmt: skip
_OPTIONS = {
    "find_species": ("events", "k", "start_kda", "draws", "seed", "sigma_kda", "above_kda",
                     "limit_kda", "offset", "hold", "background", "widths", "branch"),
    "compare_samples": ("first", "k", "sigma_kda", "above_kda", "background"),
    "fit_kinetics": ("events", "frame_rate_hz", "frames", "radius_px"),
    "fit_diffusion": ("frames", "positions_nm", "sigma_nm", "frame_rate_hz", "exposure_ms",
                      "counted", "level"),
    "confinement_test": ("resamples", "enough", "rng"),
    "anomalous_test": ("frame_rate_hz", "exposure_ms"),
    "hydrodynamic_diameter": ("viscosity_mpa_s", "temperature_c"),
    "refractive_index": ("index", "density_kg_m3", "n_medium"),
}  # fmt: skip


@pytest.mark.parametrize(
    ("function", "option"), [(name, option) for name, some in _OPTIONS.items() for option in some]
)
def test_what_is_no_argument_is_refused(function: str, option: str) -> None:
    called = "events" if option == "first" else option
    for value in _WRONG:
        with pytest.raises(ia.IscatError, match="x: cannot be read|" + called):
            getattr(ia, function)(**(_GOOD[function] | {option: value}))


@pytest.mark.parametrize("function", sorted(_GOOD))
def test_the_arguments_that_were_changed_are_good(function: str) -> None:
    getattr(ia, function)(**_GOOD[function])


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"k": None, "masses_kda": 66.0}, "`masses_kda` = 66: give a list, as in"),
        ({"k": None, "masses_kda": [66.0, "b"]}, "`masses_kda` = 'b': give one mass in kDa"),
        ({"k": None, "masses_kda": []}, "`masses_kda`: is empty"),
        ({"k": None, "ladder": "66 kDa"}, "`ladder` = '66 kDa': give one mass of a monomer"),
        ({"k": None, "ladder": 66.0, "steps": [1.5]}, "`steps` = 1.5: give one whole number"),
        ({"k": True}, "`k` = True: give one whole number"),
    ],
)
def test_what_says_which_species_is_checked(changed: dict[str, object], said: str) -> None:
    with pytest.raises(ia.ConfigError, match=said):
        ia.find_species(**(_SPECIES | changed))


@pytest.mark.parametrize(
    ("function", "arguments", "said"),
    [
        ("fit_movie", {"movie": 3}, "int is no movie"),
        ("fit_movie", {"movie": np.zeros((9, 8, 8)), "out": 3}, "`out` = 3: give a path"),
        ("fit_movie", {"movie": "m.tif", "settings": 3}, "`settings` = 3: give a mapping"),
        ("open_stack", {"movie": np.zeros((9, 8, 8)), "pixel_size_nm": "x"}, "pixel_size_nm = 'x'"),
        ("open_result", {"folder": 3}, "`folder` = 3: give a path"),
        ("schema", {"name": []}, r"schema \[\] is not known"),
        ("forecast_optics", {"events": "x"}, "`events` = 'x': give one whole number"),
        ("forecast_optics", {"free": 3}, "`free` = 3: give some of focus"),
        ("calibrate_optics", {"movie": "m.tif", "focus_step_nm": "x"}, "`focus_step_nm` = 'x'"),
        ("batch", {"samples": 3, "out": "x"}, "`samples` = 3: give a path"),
        ("batch", {"samples": "s.csv", "out": 3}, "`out` = 3: give a path"),
        ("batch", {"samples": "s.csv", "out": "x", "only": 3}, r"`only` = 3: give \(K, N\)"),
        ("watch", {"folder": 3}, "`folder` = 3: give a path"),
        ("watch", {"folder": ".", "interval_s": "x"}, "`interval_s` = 'x'"),
        ("watch", {"folder": ".", "standards": 3}, "`standards`: 3 is no list of masses"),
        ("to_trackpy", {"fits": 3}, "`fits`: is int"),
        ("to_napari", {"fits": pd.DataFrame()}, "`fits`: has no column event"),
        ("to_picasso", {"fits": pd.DataFrame()}, "`fits`: has no column event"),
        ("config_to_toml", {"config": 3}, "`config`: is int"),
        ("Preview", {"movie": 3, "config": 3}, "`movie` is int"),
        ("fit_stack", {"stack": 3, "config": ia.configure()}, "`stack` = 3: give a path"),
    ],
)
def test_whole_jobs_name_their_arguments(
    function: str, arguments: dict[str, object], said: str
) -> None:
    setup = {"settings": {"camera.pixel_size_nm": 84.4}}
    takes = function in ("forecast_optics", "calibrate_optics", "watch") and "settings" not in said
    with pytest.raises(ia.IscatError, match=said):
        getattr(ia, function)(**arguments, **(setup if takes else {}))


def test_errors_below_zero_are_refused() -> None:
    with pytest.raises(ia.DataError, match="sigma_mass_kda = -1"):
        ia.refractive_index(150.0, 7.0, sigma_mass_kda=-1.0)
