"""Particles that move: paths with the statistics of diffusion, pictures that are averages."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scenes import PIXEL_NM, make_config
from scipy.stats import kstest

import iscat_analysis as ia
from iscat_analysis.config import Config, config_to_toml, parse_config
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.study import Movie, write_stack
from iscat_analysis.study import movers as moving
from iscat_analysis.study.movers import MovingParticle, place_movers
from iscat_analysis.study.simulate import TRACK_COLUMNS, TRUTH_COLUMNS

SIGMAS = 4.0
PICTURE = 1e-3  # of the sharp picture's peak; what `FINE` is chosen for
TABLE = 1e-7  # the model's radial interpolation
INTERVAL_S = 1 / 331.0
WIDE = 16_000  # pixels, which nothing crosses

SHAPE = (40, 44)
EVENT = {"frame": 3, "x_px": 17.3, "y_px": 21.8}


def _config(simulation: dict[str, Any], **sections: Any) -> Config:
    values = {"shape": list(SHAPE), "frames": 12} | simulation
    camera = {"frame_rate_hz": 331.0} | sections.pop("camera", {})
    sections.setdefault("background", {"frames": [0, 3]})
    return make_config(camera=camera, fit={"frames": None}, simulation=values, **sections)


def _paths(kind: dict[str, Any], *, seed: int = 1, **more: Any) -> tuple[MovingParticle, ...]:
    camera = more.pop("camera", {})
    config = _config({"movers": [kind]} | more, camera=camera)
    return place_movers(config, 0.0, lambda i: np.random.default_rng([seed, i]))


def _within(values: np.ndarray, expected: float) -> bool:
    """Whether the mean of independent values is as expected."""
    return bool(abs(values.mean() - expected) < SIGMAS * values.std() / math.sqrt(values.size))


# ---- paths -----------------------------------------------------------------------------------


@pytest.mark.parametrize("exposed", [1.0, 0.4])
def test_displacements_are_those_of_diffusion(exposed: float) -> None:
    """Var = 2D(nΔ − e/3) over n frames, neighbours share D e/3, and 2DnΔ between the middles.

    D 0.8 µm²/s at 331 Hz, exposed all the time: 3223 nm² from frame to frame rather than 4834, and
    806 nm² in common.
    """
    d, e = 0.8e6, exposed * INTERVAL_S
    particles = _paths(
        {"count": 300, "d_um2_s": 0.8}, shape=[WIDE, WIDE], frames=60,
        camera={"exposure_ms": 1e3 * e},
    )  # fmt: skip
    mean = np.array([p.mean_nm for p in particles])[..., :2]
    middle = np.array([p.middle_nm for p in particles])[..., :2]
    for lag in (1, 2, 7):
        steps = mean[:, lag:] - mean[:, :-lag]
        assert _within(np.mean(steps**2, axis=(1, 2)), 2 * d * (lag * INTERVAL_S - e / 3))
        steps = middle[:, lag:] - middle[:, :-lag]
        assert _within(np.mean(steps**2, axis=(1, 2)), 2 * d * lag * INTERVAL_S)
    steps = np.diff(mean, axis=1)
    assert _within(np.mean(steps[:, 1:] * steps[:, :-1], axis=(1, 2)), d * e / 3)
    assert _within(np.mean(steps[:, 2:] * steps[:, :-2], axis=(1, 2)), 0.0)
    assert _within(np.mean(steps[..., 0] * steps[..., 1], axis=1), 0.0)
    # a control: the numbers without blur are far off
    assert not _within(np.mean(steps**2, axis=(1, 2)), 2 * d * INTERVAL_S)
    # the mean of an exposure about its middle: D e/6
    assert _within(np.mean((mean - middle) ** 2, axis=(1, 2)), d * e / 6)


def test_the_estimate_finds_what_was_simulated() -> None:
    found = []
    for p in _paths({"count": 40, "d_um2_s": 0.15}, shape=[WIDE, WIDE], frames=300):
        found.append(ia.fit_diffusion(range(300), p.mean_nm[:, :2], 1.0, frame_rate_hz=331.0))
    d = np.array([f.d_um2_s for f in found])
    assert _within(d, 0.15)
    assert d.std() / found[0].crb_d_um2_s == pytest.approx(1, abs=SIGMAS / math.sqrt(80))


def test_velocity() -> None:
    """2 µm/s along x: 6.04 nm in a frame, on top of diffusion, and alone."""
    kind = {"count": 200, "drift_um_s": [2.0, -1.0]}
    for d in (0.0, 0.05):
        particles = _paths(kind | {"d_um2_s": d}, shape=[WIDE, WIDE], frames=40)
        gone = np.array([(p.mean_nm[-1] - p.mean_nm[0]) / 39 / INTERVAL_S for p in particles])
        if d:
            assert _within(gone[:, 0], 2000.0)
            assert _within(gone[:, 1], -1000.0)
        else:
            np.testing.assert_allclose(gone[:, :2], [[2000.0, -1000.0]] * 200)


def test_walls_hold() -> None:
    """Between walls 300 nm apart a particle is everywhere alike, but never outside."""
    particles = _paths(
        {"count": 150, "d_um2_s": 2.0, "confinement_nm": 300.0}, shape=[WIDE, WIDE], frames=200
    )
    middle = np.array([p.middle_nm for p in particles])[..., :2]
    assert np.ptp(middle, axis=1).max() <= 300.0
    assert np.ptp(middle, axis=1).mean() > 280.0
    places = np.array([p.middle_nm[-1, 0] - p.middle_nm[:, 0].min() for p in particles])
    assert kstest(places / 300.0, "uniform").pvalue > 1e-3
    # well after a crossing of the box, 300²/(π² D) = 5 ms, its variance is 300²/12
    spread = middle[:, 40:].var(axis=1).mean(axis=1)
    assert spread.mean() == pytest.approx(300**2 / 12, rel=0.03)


@pytest.mark.parametrize("ceiling", [None, 400.0])
def test_a_surface_reflects(ceiling: float | None) -> None:
    kind = {"count": 150, "d_um2_s": 5.0, "space": "volume", "ceiling_nm": ceiling, "z_nm": 60.0}
    particles = _paths(kind, shape=[WIDE, WIDE], frames=20)
    heights = np.array([p.middle_nm[:, 2] for p in particles])
    for p in particles:
        assert p.points_nm[..., 2].min() >= 0
        assert p.mean_nm[..., 2].min() > 0
        assert ceiling is None or p.points_nm[..., 2].max() <= ceiling
    if ceiling is None:
        # reflected, z² has the mean of free diffusion from 60 nm
        elapsed = (19 + 0.5) * INTERVAL_S
        assert _within(heights[:, -1] ** 2, 60.0**2 + 2 * 5e6 * elapsed)
    else:
        assert kstest(heights[:, -1] / ceiling, "uniform").pvalue > 1e-3


def test_as_many_enter_as_leave() -> None:
    """20 in a field of 10 µm at 5 µm²/s for 1.8 s: all of them are replaced several times."""
    config = _config({
        "movers": [{"count": 20, "d_um2_s": 5.0}], "shape": [120, 120], "frames": 600,
        "photons_per_pixel": 100.0,
    })  # fmt: skip
    movie = Movie(config, 3)
    truth = movie.truth
    counts = truth.groupby("frame").size().reindex(range(600), fill_value=0)
    assert counts[0] == 20
    later = counts.to_numpy()[100:].reshape(5, 100).mean(axis=1)
    assert abs(later.mean() - 20) < SIGMAS * math.sqrt(20 / 5)
    assert truth["track"].nunique() > 30
    assert truth["x_px"].between(-0.5, 119.5).all()
    assert truth["y_px"].between(-0.5, 119.5).all()
    steps = truth.groupby("track")[["frame", "x_nm", "y_nm"]].diff().dropna()
    usual = math.sqrt(2 * 5e6 * INTERVAL_S)
    assert steps.loc[steps["frame"] == 1, ["x_nm", "y_nm"]].abs().to_numpy().max() < 6 * usual
    starts = truth.groupby("track")["frame"].min()
    assert (starts > 0).any()
    assert (truth.groupby("track")["frame"].max() < 599).any()


# ---- pictures --------------------------------------------------------------------------------

BLURRED = [
    ({"d_um2_s": 0.15}, 331.0, {}),
    ({"d_um2_s": 0.8}, 331.0, {}),
    ({"d_um2_s": 0.05, "drift_um_s": [30.0, 20.0]}, 331.0, {}),
    (
        {"d_um2_s": 14.6, "space": "volume", "z_nm": 300.0},
        1000.0,
        {"particle": {"kind": "gold", "mass_kda": None, "diameter_nm": 30.0}, "calibrated": False},
    ),
]


@pytest.mark.parametrize(("kind", "rate", "more"), BLURRED)
def test_a_blurred_picture_is_the_average_along_the_path(
    kind: dict[str, Any], rate: float, more: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """4096 parts of the same path, each drawn, against the points that stand for them."""
    placed = kind | {"x_px": 20.2, "y_px": 19.7}
    config = _config({"movers": [placed], "frames": 2}, camera={"frame_rate_hz": rate}, **more)
    grid = PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), PIXEL_NM)
    model = forward_model(config, 2 * grid.diagonal_nm, z_max_nm=3000.0)
    mass = (usual := _place(config)).mass_kda

    def pictures(points: np.ndarray) -> np.ndarray:
        return np.array([
            np.mean([model.image(grid, *place, mass) for place in frame], axis=0)
            for frame in points
        ])  # fmt: skip

    points_of = moving._points
    groups = usual.points_nm.shape[1] // (6 if "space" in kind else 4)
    parts = max(moving.LEAST_PARTS, moving.PARTS_OF_GROUP * groups)

    def coarse(path: np.ndarray, number: int, axes: int, within: float) -> np.ndarray:
        assert number == groups
        fine = path.shape[1] // parts
        means = path.reshape(len(path), parts, fine, 3).mean(axis=2)
        return points_of(means, number, axes, within * fine)

    monkeypatch.setattr(moving, "LEAST_PARTS", 4096)
    monkeypatch.setattr(moving, "_points", coarse)
    drawn = _place(config)
    monkeypatch.setattr(moving, "_points", lambda path, *_: path.copy())
    brute = _place(config)
    np.testing.assert_array_equal(drawn.mean_nm, brute.mean_nm)
    assert drawn.points_nm.shape == usual.points_nm.shape
    expected, sharp = pictures(brute.points_nm), pictures(brute.mean_nm[:, None])
    peak = np.abs(sharp).max()
    off = np.abs(pictures(drawn.points_nm) - expected).max() / peak
    blur = np.abs(sharp - expected).max() / peak
    print(f"{kind}: {drawn.points_nm.shape[1]} points, off by {off:.1e}, blur {blur:.1e}")
    assert off < PICTURE
    assert blur > 20 * off


def _place(config: Config) -> MovingParticle:
    return place_movers(config, 0.0, lambda i: np.random.default_rng([7, i]))[0]


def _expected(config: Config, seed: int = 1) -> np.ndarray:
    return np.array(list(Movie(config, seed).expected_frames()))


@pytest.mark.parametrize(("d", "lost"), [(0.15, 0.0125), (0.8, 0.0647)])
def test_a_fit_finds_the_averaged_place_and_loses_mass(d: float, lost: float) -> None:
    """Frames without noise, fitted without blur.

    A blur of variance D e/3 along each axis takes 1.25 % of the mass at 0.15 µm²/s and 6.47 % at
    0.8: the share of the sharp picture in the blurred one, at points.  Single frames are blurred
    more or less.
    There is so much light that the bias of order 1/N, which a fit takes off, does not matter.
    """
    frames, side, light = 60, 29, 1e8
    kind = {"d_um2_s": d, "x_px": 24.0, "y_px": 24.0, "confinement_nm": 1500.0}
    config = _config(
        {"movers": [kind], "frames": frames, "shape": [48, 48], "photons_per_pixel": light},
        camera={"gain_e_per_adu": 1e4, "samples_per_pixel": 1},
    )
    movie = Movie(config, 3)
    truth = movie.truth
    corners = np.rint(truth[["y_px", "x_px"]].to_numpy()).astype(int) - side // 2
    regions = np.array([
        frame[row : row + side, column : column + side]
        for frame, (row, column) in zip(movie.expected_frames(), corners, strict=True)
    ])  # fmt: skip
    found = ia.fit_rois(
        np.full_like(regions, light), regions, config.optics, config.particle, config.camera,
        n_before=0, n_after=1, mode="mass", calibration=config.calibration, corners_px=corners,
        power_ratio=1.0,
    )  # fmt: skip
    grid = PixelGrid.centred(side, PIXEL_NM)
    model = forward_model(config, 2 * grid.diagonal_nm)
    sharp = model.image(grid, 0.0, 0.0, 5.0, 1000.0)
    r = math.sqrt(d * 1e6 * INTERVAL_S / 3)
    nodes, weights = np.polynomial.hermite_e.hermegauss(5)
    blurred = sum(
        a * b * model.image(grid, r * x, r * y, 5.0, 1000.0) / weights.sum() ** 2
        for x, a in zip(nodes, weights, strict=True)
        for y, b in zip(nodes, weights, strict=True)
    )
    predicted = 1 - np.sum(sharp * blurred) / np.sum(sharp**2)
    assert predicted == pytest.approx(lost, abs=1e-4)
    for name in ("x_nm", "y_nm"):
        off = found[name].to_numpy() - truth[name].to_numpy()
        assert np.abs(off.mean()) < 0.1 * r / math.sqrt(frames)
        assert off.std() < 0.03 * r
    mass = found["mass_kda"].to_numpy() / 1000
    assert _within(mass, 1 - predicted)
    assert 0.3 * lost < mass.std() < lost


def test_a_mover_that_stands_still_is_an_event() -> None:
    still = {"x_px": 17.3, "y_px": 21.8, "d_um2_s": 0.0, "frame": 3, "leave": 9, "z_nm": 40.0}
    event = EVENT | {"leave": 9, "z_nm": 40.0}
    for more in ({}, {"background": "speckle", "power_noise": 0.01},
                 {"drift_px_per_frame": [0.1, -0.2], "background": "speckle"}):  # fmt: skip
        one, two = (_config(more | given) for given in ({"movers": [still]}, {"events": [event]}))
        if "drift_px_per_frame" in more:  # a mover's place is that in the first frame of the movie
            two = _config(more | {"events": [event | {"x_px": 17.6, "y_px": 21.2}]})
            np.testing.assert_allclose(_expected(one), _expected(two), rtol=1e-12)
            continue
        np.testing.assert_array_equal(_expected(one), _expected(two))
    truth = Movie(_config({"movers": [still]}), 1).truth
    assert truth["frame"].tolist() == [3, 4, 5, 6, 7, 8]
    assert set(truth["x_px"]) == {17.3}
    assert set(truth["contrast"]) == {Movie(_config({"events": [event]}), 1).truth["contrast"][0]}


@pytest.mark.parametrize("samples", [1, 2])
def test_fields_of_movers_add_before_they_are_squared(samples: int) -> None:
    """Two gold particles and one that stands, near each other, against the whole average."""
    gold = {"kind": "gold", "mass_kda": None, "diameter_nm": 30.0}
    kinds = [
        {"d_um2_s": 0.3, "x_px": 18.0, "y_px": 20.0},
        {"d_um2_s": 0.3, "x_px": 22.0, "y_px": 20.5},
    ]
    config = _config(
        {"movers": kinds, "events": [EVENT | {"frame": 0, "y_px": 23.5}], "frames": 2},
        camera={"samples_per_pixel": samples}, particle=gold, calibrated=False,
    )  # fmt: skip
    movie = Movie(config, 5)
    frames = list(movie.expected_frames())
    model, grid = movie._model, movie._grid
    stands = movie._field_of(movie.particles[0], 0)
    for t in range(2):
        total = np.zeros(grid.shape)
        pairs = [(a, b) for a in movie.movers[0].points_nm[t] for b in movie.movers[1].points_nm[t]]
        for places in pairs:
            mass = movie.movers[0].mass_kda
            field = stands + sum(movie._field_at(*place, mass) for place in places)
            total += movie._signal(field) / len(pairs)
        difference = np.abs(frames[t] / 1e4 - total).max()
        alone = sum(
            np.mean([model.image(grid, *place, mass) for place in p.points_nm[t]], axis=0)
            for p in movie.movers
        )
        added = np.abs(movie._signal(stands) + alone - total).max()
        assert difference < 2e-3
        assert added > 20 * difference


def test_a_moving_sample_takes_its_movers_along() -> None:
    """Places of the truth are those in the picture: its middle is where they say."""
    mover = {"x_px": 20.0, "y_px": 18.0, "d_um2_s": 0.01, "mass_kda": 3000.0}
    config = _config({"movers": [mover], "drift_px_per_frame": [0.25, -0.1]})
    movie = Movie(config, 2)
    truth = movie.truth
    for t, frame in enumerate(movie.expected_frames()):
        x, y = truth["x_px"][t], truth["y_px"][t]
        signal = movie._model.image(
            PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), PIXEL_NM),
            x * PIXEL_NM, y * PIXEL_NM, 5.0, 3000.0,
        )  # fmt: skip
        off = frame / 1e4 - 1 - signal
        assert np.abs(off).max() < 0.03 * np.abs(signal).max()
    assert abs(truth["x_px"][11] - 20 - 0.25 * 11) < 3


def test_a_particle_above_the_surface_is_seen_at_its_heights() -> None:
    """Without noise, and slow enough to be sharp, its picture is that of the truth's place."""
    gold = {"kind": "gold", "mass_kda": None, "diameter_nm": 30.0}
    kind = {"d_um2_s": 1e-3, "space": "volume", "z_nm": 700.0, "x_px": 21.0, "y_px": 20.0}
    movie = Movie(_config({"movers": [kind]}, particle=gold, calibrated=False), 2)
    truth = movie.truth
    assert truth["contrast"].isna().all()
    assert truth["z_nm"].nunique() == len(truth) == 12
    grid, mass = PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), PIXEL_NM), truth["mass_kda"][0]
    for t, frame in enumerate(movie.expected_frames()):
        signal = movie._model.image(
            grid, *truth.loc[t, ["x_nm", "y_nm", "z_nm"]].astype(float), mass
        )
        assert np.abs(frame / 1e4 - 1 - signal).max() < 0.01 * np.abs(signal).max()


# ---- files -----------------------------------------------------------------------------------


def test_the_same_seed_writes_the_same_bytes(tmp_path: Path) -> None:
    kinds = [{"count": 2, "d_um2_s": 0.8}, {"count": 1, "d_um2_s": 0.1, "mass_kda": 300.0}]
    files = []
    for name, workers, seed in (("a", 1, 9), ("b", 3, 9), ("c", 1, 10)):
        config = _config(
            {"movers": kinds, "events": [EVENT], "power_noise": 0.01, "frames": 20},
            compute={"workers": workers},
        )
        write_stack(config, tmp_path / f"{name}.tif", seed=seed)
        content = (tmp_path / f"{name}.tif").read_bytes().replace(f"{name}.tif".encode(), b"")
        files.append((content, (tmp_path / f"{name}.truth.csv").read_bytes()))
    assert files[0] == files[1]
    assert files[2][0] != files[0][0]
    assert files[2][1] != files[0][1]
    truth = pd.read_csv(tmp_path / "a.truth.csv")
    assert tuple(truth.columns) == (*TRUTH_COLUMNS, *TRACK_COLUMNS)
    assert truth["event"].tolist() == list(range(len(truth)))
    assert truth["track"].isna().tolist() == [True] + [False] * (len(truth) - 1)
    assert (truth["leave"][1:] == truth["frame"][1:] + 1).all()
    assert set(truth["mass_kda"]) == {1000.0, 300.0}
    np.testing.assert_allclose(truth["x_nm"], truth["x_px"] * PIXEL_NM)
    np.testing.assert_allclose(truth["contrast"], -3.1e-5 * truth["mass_kda"], rtol=1e-6)


def test_kinds_have_their_own_random_numbers() -> None:
    """A kind that is added at the end leaves the others where they were."""
    first = {"count": 3, "d_um2_s": 0.5}
    one, two = (
        Movie(_config({"movers": kinds}), 4).truth
        for kinds in ([first], [first, {"count": 2, "d_um2_s": 0.1}])
    )
    pd.testing.assert_frame_equal(one, two.iloc[: len(one)])


def test_a_kind_may_be_given_by_its_diameter() -> None:
    gold = {"kind": "gold", "mass_kda": None, "diameter_nm": 30.0}
    config = _config(
        {"movers": [{"d_um2_s": 1.0, "diameter_nm": 20.0}]}, particle=gold, calibrated=False
    )
    mass = Movie(config, 1).truth["mass_kda"][0]
    nominal = forward_model(config, 1000.0).material.mass_kda
    assert mass == pytest.approx(nominal * (20 / 30) ** 3)


def test_the_configuration_is_written_and_read_again() -> None:
    config = _config({"movers": [{"d_um2_s": 1.0, "space": "volume", "ceiling_nm": 900.0},
                                 {"d_um2_s": 0.0, "x_px": 3.0, "y_px": 4.0}],
                      "events": [EVENT]})  # fmt: skip
    import tomllib

    assert parse_config(tomllib.loads(config_to_toml(config))) == config


# ---- what cannot be --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mover", "said"),
    [
        ({}, "simulation.movers.0.d_um2_s: is required"),
        ({"count": 3}, "simulation.movers.0.d_um2_s: is required"),
        ({"d_um2_s": -0.1}, "simulation.movers.0.d_um2_s: input should be greater than or equal"),
        ({"d_um2_s": 1, "diametr_nm": 30}, "did you mean diameter_nm?"),
        ({"d_um2_s": 1, "mass_kda": 9, "diameter_nm": 9}, "give mass_kda or diameter_nm, not both"),
        ({"d_um2_s": 1, "x_px": 9}, "give x_px and y_px, or neither"),
        ({"d_um2_s": 1, "x_px": 9, "y_px": 9, "count": 2}, "count = 2 particles cannot all begin"),
        ({"d_um2_s": 1, "x_px": 9, "y_px": 99}, "lies outside the field of 44 x 40 pixels"),
        ({"d_um2_s": 1, "frame": 12}, "movers[0] appears at frame 12, after the 12 frames"),
        ({"d_um2_s": 1, "frame": 5, "leave": 5}, "leave = 5 must come after frame = 5"),
        ({"d_um2_s": 1, "ceiling_nm": 300}, 'ceiling_nm needs space = "volume"'),
        (
            {"d_um2_s": 1, "space": "volume", "ceiling_nm": 300, "z_nm": 301},
            "z_nm = 301 lies above ceiling_nm = 300",
        ),
        ({"d_um2_s": 1, "space": "air"}, "simulation.movers.0.space: input should be 'membrane'"),
        ({"d_um2_s": 1, "confinement_nm": 0.0003}, "simulation.movers.0.confinement_nm"),
    ],
)
def test_impossible_movers(mover: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        _config({"movers": [mover]})
    assert said in str(caught.value)


def test_impossible_timing() -> None:
    movers = {"movers": [{"d_um2_s": 1.0}]}
    with pytest.raises(ConfigError, match=r"camera\.frame_rate_hz is needed for simulation.movers"):
        Movie(_config(movers, camera={"frame_rate_hz": None}), 1)
    with pytest.raises(
        ConfigError, match=r"camera\.exposure_ms = 4 is longer than the 3\.02115 ms"
    ):
        Movie(_config(movers, camera={"exposure_ms": 4.0}), 1)
