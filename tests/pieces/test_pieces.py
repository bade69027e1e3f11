"""The public pieces, each against what it says it is, written out here a second time."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binom, poisson

import iscat_analysis as ia
from iscat_analysis.bounds import bounds_report
from iscat_analysis.config import configure
from iscat_analysis.records import PARAMETERS

PIXELS = 25
CENTRE = (PIXELS - 1) / 2 * 84.4
LIGHT = 1e4
FRAMES = 200
SIGMAS = 5.0
QUADRATURE = 1e-6
"""Between models for fields of different size, which have different numbers of nodes."""

OPTICS = ia.Optics(na=1.42, wavelength_nm=525, focus_nm=-500)
CAMERA = ia.Camera(pixel_size_nm=84.4)
PROTEIN = ia.Particle(mass_kda=1000.0)
LINE = ia.Calibration(gradient_per_kda=-3.1e-5)
GOLD = ia.Particle(kind="gold", diameter_nm=30.0, height_nm=20.0)
DARK = ia.Optics(na=1.42, wavelength_nm=525, scheme="darkfield", focus_nm=-300)
MODES = {"mass": ("x_nm", "y_nm", "mass_kda"), "localize": ("x_nm", "y_nm", "z_nm"),
         "joint": PARAMETERS}  # fmt: skip


def _counts(
    count: int, seed: int = 1, *, known: bool = False, optics: ia.Optics = OPTICS, **at: float
) -> tuple[np.ndarray, np.ndarray]:
    """Draw counts before and after of many equal particles."""
    rng = np.random.default_rng(seed)
    light = FRAMES * LIGHT * np.ones((PIXELS, PIXELS))
    image = ia.psf(optics, PROTEIN, CAMERA, pixels=PIXELS, calibration=LINE, **at)
    after = rng.poisson(light * (1 + image), (count, PIXELS, PIXELS))
    return (np.array(LIGHT) if known else rng.poisson(light, after.shape)), after


# ---- psf --------------------------------------------------------------------------------------


def test_images_of_arrays_are_those_of_numbers() -> None:
    z, mass = np.array([[5.0], [80.0]]), np.array([300.0, 600.0, 900.0])
    many = ia.psf(OPTICS, PROTEIN, CAMERA, pixels=11, z_nm=z, mass_kda=mass, x_nm=20.0)
    assert many.shape == (2, 3, 11, 11)
    for i, j in np.ndindex(2, 3):
        one = ia.psf(OPTICS, PROTEIN, CAMERA, pixels=11, z_nm=z[i, 0], mass_kda=mass[j], x_nm=20.0)
        # another farthest height is another number of quadrature nodes
        np.testing.assert_allclose(many[i, j], one, atol=1e-9 * np.abs(one).max())


def test_images_have_the_contrast_of_the_calibration() -> None:
    fine = ia.Camera(pixel_size_nm=5.0)
    masses = np.array([100.0, 1000.0])
    images = ia.psf(OPTICS, PROTEIN, fine, pixels=121, calibration=LINE, mass_kda=masses)
    peak = np.take_along_axis(
        images.reshape(2, -1), np.abs(images).reshape(2, -1).argmax(axis=1)[:, None], axis=1
    )[:, 0]
    np.testing.assert_allclose(peak, -3.1e-5 * masses, rtol=1e-3)


def test_a_calibration_holds_for_regions_of_any_size() -> None:
    """Out of focus the peak lies on a ring, which few pixels do not hold."""
    many = ia.psf(OPTICS, PROTEIN, CAMERA, pixels=33, calibration=LINE)
    few = ia.psf(OPTICS, PROTEIN, CAMERA, pixels=1, calibration=LINE)
    assert few[0, 0] == pytest.approx(many[16, 16], rel=QUADRATURE)


def test_right_and_down_are_positive() -> None:
    optics = ia.Optics(na=1.42, focus_nm=-300)  # where the peak lies on the particle
    image = np.abs(ia.psf(optics, PROTEIN, CAMERA, pixels=15, x_nm=3 * 84.4, y_nm=-2 * 84.4))
    assert np.unravel_index(image.argmax(), image.shape) == (7 - 2, 7 + 3)


def test_dark_field_images_are_photoelectrons() -> None:
    """They come to those that the pupil collects; rings leave a share out that falls as 1/size."""
    particle = ia.Particle(kind="gold", diameter_nm=20.0, photons_per_frame=3000.0)
    optics = ia.Optics(na=1.2, wavelength_nm=525, scheme="darkfield", focus_nm=0)
    small, large = (ia.psf(optics, particle, CAMERA, pixels=n).sum() for n in (101, 201))
    assert small < large < 3000.0
    assert (201 * large - 101 * small) / 100 == pytest.approx(3000.0, rel=1e-3)


# ---- log_likelihood -----------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
def test_the_log_likelihood_is_scipys(mode: str) -> None:
    before, after = _counts(1, z_nm=5.0)
    logl = ia.log_likelihood(
        before[0], after[0], OPTICS, PROTEIN, CAMERA, mode=mode, n_before=FRAMES, n_after=FRAMES,
        power_ratio=1.02, calibration=LINE,
    )  # fmt: skip
    assert logl.names == MODES[mode]
    truth = {"x_nm": CENTRE, "y_nm": CENTRE, "z_nm": 5.0, "mass_kda": 1000.0}
    total = before[0] + after[0]
    rng = np.random.default_rng(2)
    thetas, expected = [], []
    for _ in range(4):
        at = {name: truth[name] * rng.uniform(0.9, 1.1) for name in MODES[mode]}
        full = {**truth, **at}
        image = ia.psf(
            OPTICS, PROTEIN, CAMERA, pixels=PIXELS, calibration=LINE,
            x_nm=full["x_nm"] - CENTRE, y_nm=full["y_nm"] - CENTRE, z_nm=full["z_nm"],
            mass_kda=full["mass_kda"],
        )  # fmt: skip
        terms = [
            binom.logpmf(after[0], total, q / (1 + q)).sum() for q in (1.02 * (1 + image), 1.02)
        ]
        thetas.append([at[name] for name in MODES[mode]])
        expected.append(terms[0] - terms[1])
    values = logl(np.array(thetas))
    np.testing.assert_allclose(values, expected, rtol=1e-6, atol=1e-5)
    assert float(logl(thetas[0])) == pytest.approx(values[0], rel=1e-12)


def test_a_known_background_is_poissons() -> None:
    before, after = _counts(1, known=True)
    logl = ia.log_likelihood(
        before, after[0], OPTICS, PROTEIN, CAMERA, n_before=0, n_after=FRAMES, calibration=LINE
    )
    image = ia.psf(OPTICS, PROTEIN, CAMERA, pixels=PIXELS, calibration=LINE, mass_kda=800.0)
    terms = [poisson.logpmf(after[0], FRAMES * LIGHT * (1 + c)).sum() for c in (image, 0 * image)]
    found = float(logl([CENTRE, CENTRE, 800.0]))
    assert found == pytest.approx(terms[0] - terms[1], rel=1e-6, abs=1e-5)


@pytest.mark.parametrize("offset", [0.0, -4e-4])
@pytest.mark.parametrize("mode", MODES)
def test_gradients_are_those_of_the_values(mode: str, offset: float) -> None:
    before, after = _counts(1)
    line = ia.Calibration(gradient_per_kda=-3.1e-5, offset=offset)
    logl = ia.log_likelihood(
        before[0], after[0], OPTICS, PROTEIN, CAMERA, mode=mode, n_before=FRAMES, n_after=FRAMES,
        calibration=line,
    )  # fmt: skip
    assert logl.names == (*MODES[mode], "log_level")
    at = {"x_nm": CENTRE + 30, "y_nm": CENTRE - 20, "z_nm": 40.0, "mass_kda": 900.0,
          "log_level": 1e-4}  # fmt: skip
    theta = np.array([at[name] for name in logl.names])
    value, gradient = logl.value_and_gradient(theta)
    assert float(value) == pytest.approx(float(logl(theta)), rel=1e-6)
    np.testing.assert_array_equal(gradient, logl.gradient(theta))
    for k, name in enumerate(logl.names):
        h = {"mass_kda": 0.5, "log_level": 1e-6}.get(name, 0.1)
        step = h * np.eye(theta.size)[k]
        f = logl.value_and_gradient(np.stack([theta + j * step for j in (-2, -1, 1, 2)]))[0]
        slope = (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * h)
        assert gradient[k] == pytest.approx(slope, rel=2e-5, abs=1e-6 / h)


def test_outside_the_support_nothing_is_likely() -> None:
    before, after = _counts(1)
    logl = ia.log_likelihood(
        before[0], after[0], OPTICS, PROTEIN, CAMERA, mode="joint", n_before=FRAMES,
        n_after=FRAMES, power_ratio=1.0, calibration=LINE, z_range_nm=(0, 300),
    )  # fmt: skip
    inside = np.array([CENTRE, CENTRE, 50.0, 1000.0])
    assert np.isfinite(logl(inside))
    for k, values in enumerate([(-1e3, 1e6, math.nan), (1e300,), (-1.0, 301.0), (-5.0, math.inf)]):
        for value in values:
            theta = inside.copy()
            theta[k] = value
            assert logl(theta) == -math.inf
            value_there, gradient = logl.value_and_gradient(theta)
            assert value_there == -math.inf
            assert np.isnan(gradient).all()
    assert logl(np.empty((0, 4))).shape == (0,)
    assert (logl.lower < inside).all()
    assert (logl.upper > inside).all()


# ---- fit_rois ---------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
def test_fits_are_unbiased_and_say_their_error(mode: str) -> None:
    z = 5.0 if mode == "mass" else 60.0
    before, after = _counts(120, seed=3, x_nm=40.0, y_nm=-60.0, z_nm=z)
    particle = ia.Particle(mass_kda=1000.0, height_nm=z) if mode == "mass" else PROTEIN
    table = ia.fit_rois(
        before, after, OPTICS, particle, CAMERA, mode=mode, n_before=FRAMES, n_after=FRAMES,
        calibration=LINE, workers=2, z_range_nm=(0.0, 300.0),
    )  # fmt: skip
    assert (table["status"] == "ok").mean() > 0.97
    truth = {"x_nm": CENTRE + 40, "y_nm": CENTRE - 60, "z_nm": z, "mass_kda": 1000.0}
    good = table[table["status"] == "ok"]
    for name in MODES[mode]:
        pull = (good[name] - truth[name]) / good[f"sigma_{name}"]
        assert abs(pull.mean()) < SIGMAS / math.sqrt(pull.size), name
        assert abs(pull.std() - 1) < SIGMAS / math.sqrt(2 * pull.size), name
        assert (good[f"crb_{name}"] / good[f"sigma_{name}"]).median() == pytest.approx(1, abs=0.1)
        assert (good[f"qcrb_{name}"] < good[f"crb_{name}"]).all()
    held = set(PARAMETERS) - set(MODES[mode])
    assert good[[f"sigma_{name}" for name in held]].isna().all().all()


def test_rows_come_in_the_order_of_the_regions() -> None:
    masses = np.array([400.0, 2000.0, 800.0, 3000.0])
    light = FRAMES * LIGHT
    images = ia.psf(OPTICS, PROTEIN, CAMERA, pixels=PIXELS, calibration=LINE, mass_kda=masses)
    rng = np.random.default_rng(4)
    before, after = rng.poisson(light, images.shape), rng.poisson(light * (1 + images))
    corners = np.array([[0, 0], [10, 20], [30, 5], [7, 7]])
    options = {"n_before": FRAMES, "n_after": FRAMES, "calibration": LINE, "power_ratio": 1.0}
    table = ia.fit_rois(
        before, after, OPTICS, PROTEIN, CAMERA, **options, corners_px=corners, workers=2
    )
    assert list(table.columns) == list(ia.EVENT_COLUMNS)
    assert table["event"].tolist() == [0, 1, 2, 3]
    assert table["frame"].isna().all()
    assert (np.abs(table["mass_kda"] - masses) < SIGMAS * table["sigma_mass_kda"]).all()
    half = (PIXELS - 1) / 2
    np.testing.assert_allclose(table[["y_px", "x_px"]] - corners, half, atol=0.5)
    for i in range(4):
        alone = ia.fit_rois(
            before[i : i + 1], after[i : i + 1], OPTICS, PROTEIN, CAMERA, **options,
            corners_px=corners[i : i + 1],
        )  # fmt: skip
        pd.testing.assert_series_equal(
            alone.iloc[0].drop("event"), table.iloc[i].drop("event"), check_names=False
        )


def test_a_known_background_makes_the_same_fit_sharper() -> None:
    known, after = _counts(30, seed=5, known=True)
    measured, _ = _counts(30, seed=5)
    options = {"n_after": FRAMES, "calibration": LINE, "power_ratio": None, "level": False}
    sharp = ia.fit_rois(known, after, OPTICS, PROTEIN, CAMERA, n_before=0, **options)
    usual = ia.fit_rois(measured, after, OPTICS, PROTEIN, CAMERA, n_before=FRAMES, **options)
    ratio = (usual["sigma_mass_kda"] / sharp["sigma_mass_kda"]).median()
    assert ratio == pytest.approx(math.sqrt(2), rel=0.02)
    pull = (sharp["mass_kda"] - 1000) / sharp["sigma_mass_kda"]
    assert abs(pull.mean()) < SIGMAS / math.sqrt(pull.size)


def test_a_level_that_is_not_told_is_fitted() -> None:
    """The light gained 0.6 %: with a free level nothing happens, held at 1 the masses suffer."""
    before, after = _counts(12, seed=6)
    after = np.random.default_rng(7).poisson(1.006 * after.astype(float))
    options = {"n_before": FRAMES, "n_after": FRAMES, "calibration": LINE}
    free = ia.fit_rois(before, after, OPTICS, PROTEIN, CAMERA, **options)
    told = ia.fit_rois(before, after, OPTICS, PROTEIN, CAMERA, **options, power_ratio=1.006)
    held = ia.fit_rois(before, after, OPTICS, PROTEIN, CAMERA, **options, power_ratio=1.0)
    pulls = [((t["mass_kda"] - 1000) / t["sigma_mass_kda"]).mean() for t in (free, told, held)]
    assert max(abs(p) for p in pulls[:2]) < SIGMAS / math.sqrt(12)
    assert abs(pulls[2]) > SIGMAS / math.sqrt(12)
    assert (told["sigma_mass_kda"] < free["sigma_mass_kda"]).all()


def test_saturated_and_missing_pixels_are_remarked_on() -> None:
    before, after = _counts(3, seed=8)
    burnt = np.zeros(after.shape, dtype=bool)
    burnt[0, 12, 12] = True
    burnt[1] = True
    table = ia.fit_rois(
        before, np.where(burnt, np.nan, after), OPTICS, PROTEIN, CAMERA, saturated=burnt,
        n_before=FRAMES, n_after=FRAMES, calibration=LINE,
    )  # fmt: skip
    assert table["status"].tolist() == ["saturated", "not_converged", "ok"]
    assert table["flags"].tolist() == ["saturated", "not_converged;saturated", ""]
    assert table.loc[1, ["x_nm", "mass_kda", "snr", "chi2_reduced"]].isna().all()


def test_dark_field_regions_are_fitted() -> None:
    particle = ia.Particle(kind="gold", diameter_nm=20.0, photons_per_frame=3000.0)
    image = ia.psf(DARK, particle, CAMERA, pixels=PIXELS)
    rng = np.random.default_rng(9)
    before = rng.poisson(50 * 2.0, (40, PIXELS, PIXELS))
    after = rng.poisson(10 * (2.0 + image), before.shape)
    table = ia.fit_rois(before, after, DARK, particle, CAMERA, n_before=50, n_after=10)
    nominal = float(ia.crb(DARK, particle, CAMERA, photons_per_pixel=2.0, n_after=10, n_before=50,
                           pixels=PIXELS)["mass_kda"])  # fmt: skip
    assert table["sigma_mass_kda"].median() == pytest.approx(nominal, rel=0.1)
    pull = (table["mass_kda"] - 48_700) / table["sigma_mass_kda"]
    assert table["contrast"].isna().all()
    assert (table["status"] == "ok").mean() > 0.9
    mass = table["mass_kda"].mean()
    gold = 19_300 * math.pi / 6 * 20e-9**3 / 1.66053906660e-24  # kDa
    assert abs(mass - gold) < SIGMAS * table["sigma_mass_kda"].median() / math.sqrt(40)
    assert np.isfinite(pull).all()


def test_no_region_is_an_empty_table() -> None:
    none = np.empty((0, PIXELS, PIXELS))
    table = ia.fit_rois(none, none, OPTICS, PROTEIN, CAMERA, n_before=1, n_after=1)
    assert len(table) == 0
    assert list(table.columns) == list(ia.EVENT_COLUMNS)


# ---- crb, qcrb --------------------------------------------------------------------------------


@pytest.mark.parametrize("n_before", [0, 50, 200])
def test_bounds_are_the_written_sum(n_before: int) -> None:
    """Central differences of the images, and the information of each pixel by hand."""
    at = {"x_nm": 20.0, "y_nm": -30.0, "z_nm": 40.0, "mass_kda": 700.0}
    steps = {"x_nm": 0.5, "y_nm": 0.5, "z_nm": 0.5, "mass_kda": 1.0}

    def image(**changed: float) -> np.ndarray:
        return ia.psf(OPTICS, PROTEIN, CAMERA, pixels=PIXELS, calibration=LINE, **{**at, **changed})

    slopes = np.stack([
        (8 * (image(**{n: at[n] + h}) - image(**{n: at[n] - h}))
         - image(**{n: at[n] + 2 * h}) + image(**{n: at[n] - 2 * h})) / (12 * h)
        for n, h in steps.items()
    ])  # fmt: skip
    ratio = 200 / n_before if n_before else 0.0
    weight = 200 * LIGHT / (1 + image()) / (1 + ratio * (1 + image()))
    fisher = np.einsum("yx,iyx,jyx->ij", weight, slopes, slopes)
    options = {"photons_per_pixel": LIGHT, "n_after": 200, "n_before": n_before,
               "pixels": PIXELS, "calibration": LINE, "mode": "joint", **at}  # fmt: skip
    joint = ia.crb(OPTICS, PROTEIN, CAMERA, **options)
    single = ia.crb(OPTICS, PROTEIN, CAMERA, joint=False, **options)
    expected = np.sqrt(np.diag(np.linalg.inv(fisher)))
    np.testing.assert_allclose(np.stack(list(joint.values())), expected, rtol=1e-5)
    np.testing.assert_allclose(np.stack(list(single.values())), 1 / np.sqrt(np.diag(fisher)),
                               rtol=1e-6)  # fmt: skip
    everything = np.concatenate([slopes / (1 + image()), np.ones((1, PIXELS, PIXELS))])
    whole = np.einsum("yx,iyx,jyx->ij", weight * (1 + image()) ** 2, everything, everything)
    level = ia.crb(OPTICS, PROTEIN, CAMERA, level=True, **options)
    expected = np.sqrt(np.diag(np.linalg.inv(whole)))[:4]
    np.testing.assert_allclose(np.stack(list(level.values())), expected, rtol=1e-5)


@pytest.mark.parametrize("scheme", ["iscat", "cobri", "darkfield"])
@pytest.mark.parametrize("n_before", [0, 100])
def test_bounds_are_those_of_the_command(scheme: str, n_before: int) -> None:
    dark = scheme == "darkfield"
    photons = 3000.0
    particle = {"kind": "gold", "diameter_nm": 25.0, "height_nm": 30.0}
    optics = {"scheme": scheme, "na": 1.3, "focus_nm": -250.0}
    camera = {"pixel_size_nm": 90.0, "read_noise_e": 2.0}
    config = configure(settings={
        **{f"optics.{k}": v for k, v in optics.items()},
        **{f"camera.{k}": v for k, v in camera.items()},
        **{f"particle.{k}": v for k, v in particle.items()},
        "fit.mode": "joint", "bounds.pixels": 31, "bounds.n_before": n_before,
        "bounds.n_after": 70, "bounds.photons_per_pixel": photons if dark else 5e3,
        **({"background.level_e": 4.0} if dark else {}),
    })  # fmt: skip
    told = bounds_report(config)["actual"]
    gold = ia.Particle(**particle, photons_per_frame=photons if dark else None)
    setup = {"photons_per_pixel": 4.0 if dark else 5e3, "n_after": 70, "mode": "joint"}
    found = ia.crb(
        ia.Optics(**optics), gold, ia.Camera(**camera), pixels=31, n_before=n_before, **setup
    )
    quantum = ia.qcrb(ia.Optics(**optics), gold, ia.Camera(**camera), **setup)
    both = ia.qcrb(ia.Optics(**optics), gold, ia.Camera(**camera), joint=True, **setup)
    for name in PARAMETERS:
        assert float(found[name]) == pytest.approx(told["crb_joint"][name], rel=QUADRATURE)
        assert float(quantum[name]) == pytest.approx(told["qcrb"][name], rel=QUADRATURE)
        assert float(both[name]) == pytest.approx(told["qcrb_joint"][name], rel=QUADRATURE)


def test_bounds_of_arrays_are_those_of_numbers() -> None:
    focus = np.array([[-300.0], [-500.0]])
    mass = np.array([300.0, 900.0, 2700.0])
    options = {"photons_per_pixel": LIGHT, "n_after": 10, "mode": "joint", "calibration": LINE}
    for piece in (ia.crb, ia.qcrb):
        many = piece(OPTICS, PROTEIN, CAMERA, focus_nm=focus, mass_kda=mass, **options)
        for i, j in np.ndindex(2, 3):
            one = piece(OPTICS, PROTEIN, CAMERA, focus_nm=focus[i, 0], mass_kda=mass[j], **options)
            for name in PARAMETERS:
                assert many[name].shape == (2, 3)
                assert float(one[name]) == pytest.approx(many[name][i, j], rel=1e-9)


def test_more_light_is_a_smaller_bound() -> None:
    photons = np.array([1e3, 4e3, 16e3])
    found = ia.crb(OPTICS, PROTEIN, CAMERA, photons_per_pixel=photons, n_after=[[1], [4]])
    for values in found.values():
        np.testing.assert_allclose(values[0, :-1] / values[0, 1:], 2, rtol=1e-9)
        np.testing.assert_allclose(values[0] / values[1], 2, rtol=1e-9)


# ---- what is refused --------------------------------------------------------------------------

REGION = np.full((2, 9, 9), 100.0)
IMAGE = REGION[0]
GIVEN = {"n_before": 10, "n_after": 10}
BAD_SETUPS = [
    ({"optics": "iscat"}, "optics: is str; give what iscat_analysis.Optics"),
    ({"particle": None}, "particle: is NoneType"),
    ({"camera": {"pixel_size_nm": 84.4}}, "camera: is dict"),
    ({"camera": ia.Camera()}, "camera.pixel_size_nm is needed"),
    ({"camera": ia.Camera(pixel_size_nm=84.4, read_noise_e="map.tif")}, "read_noise_e .* is a map"),
    ({"calibration": -3.1e-5}, "calibration: is float"),
]


def _call(piece: str, changed: dict) -> None:
    arguments: dict = {"optics": OPTICS, "particle": PROTEIN, "camera": CAMERA}
    arguments |= {
        "psf": {},
        "fit_rois": {"before": REGION, "after": REGION, **GIVEN},
        "log_likelihood": {"before": IMAGE, "after": IMAGE, **GIVEN},
        "crb": {"photons_per_pixel": 1e4},
        "qcrb": {"photons_per_pixel": 1e4},
    }[piece]
    getattr(ia, piece)(**{**arguments, **changed})


@pytest.mark.parametrize("piece", ["psf", "fit_rois", "log_likelihood", "crb", "qcrb"])
@pytest.mark.parametrize(("changed", "message"), BAD_SETUPS)
def test_bad_setups_are_refused_by_every_piece(piece: str, changed: dict, message: str) -> None:
    with pytest.raises(ia.ConfigError, match=message):
        _call(piece, changed)


@pytest.mark.parametrize(
    ("piece", "changed", "message"),
    [
        ("psf", {"pixels": 0}, "pixels = 0: give one whole number of at least 1"),
        ("psf", {"pixels": 2.5}, r"pixels = 2.5"),
        ("psf", {"z_nm": -1.0}, "z_nm = -1: give finite numbers of at least 0"),
        ("psf", {"mass_kda": [1.0, math.nan]}, "mass_kda = nan"),
        ("psf", {"x_nm": [1, 2], "z_nm": [1, 2, 3]}, r"x_nm \(2,\), z_nm \(3,\)"),
        ("psf", {"x_nm": -1e6}, r"x_nm = -1e\+06: give finite numbers of at most 100000"),
        ("psf", {"z_nm": 1e300}, r"z_nm = 1e\+300"),
        ("psf", {"mass_kda": 1e300}, r"mass_kda = 1e\+300: give finite numbers of at most 1e\+15"),
        ("psf", {"pixels": 10**6}, "pixels = 1000000: give one whole number of at most 1500"),
        ("crb", {"focus_nm": 1e9}, r"focus_nm = 1e\+09"),
        ("psf", {"optics": DARK}, "particle.photons_per_frame is needed"),
        ("crb", {"photons_per_pixel": 0.0}, "photons_per_pixel = 0"),
        ("crb", {"photons_per_pixel": -1.0}, "photons_per_pixel = -1"),
        ("crb", {"n_after": 0}, "n_after = 0: give finite numbers of at least 1"),
        ("crb", {"n_before": 0.5}, "n_before = 0.5: give whole frames"),
        ("crb", {"mode": "everything"}, "mode = 'everything': choose one of mass"),
        ("crb", {"x_nm": 1e5}, "x_nm = 100000 lies outside the region"),
        ("crb", {"pixels": 1}, "pixels = 1"),
        ("qcrb", {"z_nm": -5.0}, "z_nm = -5"),
        ("qcrb", {"n_after": math.inf}, "n_after = inf"),
        ("fit_rois", {"mode": "track"}, 'give "joint", frame by frame'),
        ("fit_rois", {"n_before": -1}, "n_before = -1: give one whole number of at least 0"),
        ("fit_rois", {"n_after": 1.5}, "n_after = 1.5"),
        ("fit_rois", {"level": "yes"}, "level = 'yes'"),
        ("fit_rois", {"level": np.zeros(2)}, "level = array"),
        ("fit_rois", {"n_after": 1e30}, "n_after = 1e\\+30: give one whole number of at most"),
        ("fit_rois", {"mode": ["mass"]}, r"mode = \['mass'\]: choose one of mass"),
        ("log_likelihood", {"mode": {}}, "mode = {}"),
        ("crb", {"mode": np.zeros(2)}, "mode = array"),
        ("crb", {"joint": "no"}, "joint = 'no': give True or False"),
        ("crb", {"level": 2}, "level = 2"),
        ("qcrb", {"joint": None}, "joint = None"),
        ("fit_rois", {"workers": 0}, "workers = 0"),
        ("fit_rois", {"z_range_nm": (300.0, 0.0)}, "z_range_nm"),
        ("log_likelihood", {"mode": "track"}, 'give "joint"'),
    ],
)
def test_bad_arguments_are_named(piece: str, changed: dict, message: str) -> None:
    with pytest.raises(ia.ConfigError, match=message):
        _call(piece, changed)


@pytest.mark.parametrize(
    ("piece", "changed", "message"),
    [
        ("fit_rois", {"after": IMAGE}, r"after: has shape \(9, 9\)"),
        ("fit_rois", {"after": REGION[:, :4]}, "at least 5 x 5"),
        ("fit_rois", {"before": REGION[:1]}, r"before: has shape \(1, 9, 9\); give \(2, 9, 9\)"),
        ("fit_rois", {"before": 100.0}, r"before: has shape \(\)"),
        ("fit_rois", {"after": REGION.astype(str)}, "after: holds"),
        ("fit_rois", {"after": np.where(REGION > 0, np.nan, 0)}, "162 pixels; mask them"),
        ("fit_rois", {"power_ratio": [1.0, 0.0]}, "power_ratio = 0"),
        ("fit_rois", {"power_ratio": 1e30}, r"power_ratio = 1e\+30: .* below 1e\+09"),
        ("fit_rois", {"masked": [[True], [True, False]]}, "masked: its rows have different"),
        ("fit_rois", {"power_ratio": [1.0, 1.0, 1.0]}, "power_ratio: has shape"),
        ("fit_rois", {"masked": REGION}, "masked: holds float64"),
        ("fit_rois", {"saturated": np.zeros((3, 9, 9), dtype=bool)}, "saturated: has shape"),
        ("fit_rois", {"corners_px": [0, 0]}, "corners_px: has shape"),
        ("log_likelihood", {"after": REGION}, r"after: has shape \(2, 9, 9\)"),
        ("log_likelihood", {"before": REGION}, "before: has shape"),
        ("psf", {"x_nm": "here"}, "x_nm: holds"),
        ("psf", {"x_nm": np.ma.array([1.0, 2.0], mask=[0, 1])}, "x_nm: has masked elements"),
        ("crb", {"photons_per_pixel": 1j}, "photons_per_pixel: holds complex128"),
    ],
)
def test_bad_arrays_are_named(piece: str, changed: dict, message: str) -> None:
    with pytest.raises(ia.DataError, match=message):
        _call(piece, changed)


def test_bounds_at_no_mass_are_limits() -> None:
    """No position of nothing; but how little mass is told from none is finite."""
    for bound in (ia.crb, ia.qcrb):
        found = bound(
            OPTICS, PROTEIN, CAMERA, photons_per_pixel=1e4, mass_kda=[0.0, 1e-3], calibration=LINE
        )
        assert np.isnan(found["x_nm"][0])
        assert found["x_nm"][1] > 1e5
        np.testing.assert_allclose(found["mass_kda"][0], found["mass_kda"][1], rtol=1e-5)


@pytest.mark.parametrize(
    "theta", [[1.0, 2.0], np.zeros((2, 2)), np.zeros((1, 1, 3)), ["a", "b", "c"]]
)
def test_points_of_another_shape_are_refused(theta: object) -> None:
    logl = ia.log_likelihood(IMAGE, IMAGE, OPTICS, PROTEIN, CAMERA, **GIVEN, power_ratio=1.0)
    for call in (logl, logl.gradient, logl.value_and_gradient):
        with pytest.raises(ia.DataError, match="theta"):
            call(theta)  # type: ignore[operator]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ia.Optics(na=1.6), "na = 1.6 must be below n_immersion = 1.515"),
        (lambda: ia.Optics(nna=1.2), "unknown key optics.nna; did you mean na"),
        (lambda: ia.Camera(pixel_size_nm=0.0844), "camera.pixel_size_nm: .* write 84.4"),
        (lambda: ia.Particle(mass_kda=1.0, diameter_nm=2.0), "mass_kda or diameter_nm, not both"),
        (lambda: ia.Calibration(gradient_per_kda=0.0), "gradient_per_kda = 0"),
    ],
)
def test_what_microscopes_are_made_of_is_checked(make, message: str) -> None:
    """Without a configuration file, in the words that a file's mistakes are told in."""
    with pytest.raises(ia.ConfigError, match=message):
        make()
