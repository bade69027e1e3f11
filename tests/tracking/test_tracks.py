"""What the frames of a track say together: mass, D, size, and what is remarked on it."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
from walkers import PIXEL_NM, SETUP, fits_of, setup, walk

from iscat_analysis import fit_diffusion, refractive_index
from iscat_analysis.config import parse_config
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.records import TRACK_COLUMNS, TrackStatus
from iscat_analysis.species import describe_tracks
from iscat_analysis.species.tracks import combine_masses, information_power
from iscat_analysis.tracking.tracks import SHORT_MOVIE, cut_steps, judge_times
from iscat_analysis.units import sphere_mass_kda

SIGMAS = 4.0


def _frames(
    rng: np.random.Generator, n: int, relative: float, power: float
) -> tuple[np.ndarray, np.ndarray]:
    """Estimates of a mass of 400 kDa, and the σ that each frame believes."""
    mass = 400 * (1 + relative * rng.standard_normal(n))
    return mass, 400 * relative * (mass / 400) ** (-power / 2)


@pytest.mark.parametrize("power", [0.01, 2.0])
def test_weights_that_follow_the_estimate_bias_the_mass_as_predicted(power: float) -> None:
    rng, n, relative, tracks = np.random.default_rng(1), 200, 0.1, 400
    drawn = [_frames(rng, n, relative, power) for _ in range(tracks)]
    learned = information_power(drawn)
    assert abs(learned - power) < 1e-6 * max(power, 1)
    naive = [combine_masses(m, s, s).mass_kda / 400 - 1 for m, s in drawn]
    right = [combine_masses(m, s, s, power=learned).mass_kda / 400 - 1 for m, s in drawn]
    error = relative / math.sqrt(n * tracks)
    assert abs(np.mean(right)) < SIGMAS * error
    predicted = power * relative**2 * (1 - 1 / n)
    next_order = 3 * power * relative**4
    assert abs(np.mean(naive) - predicted) < SIGMAS * error + next_order
    pulls = [
        (combine_masses(m, s, s, power=learned).mass_kda - 400)
        / combine_masses(m, s, s, power=learned).sigma_mass_kda
        for m, s in drawn
    ]
    assert abs(np.std(pulls) - 1) < SIGMAS / math.sqrt(2 * tracks)


def test_frames_of_different_precision_are_weighted() -> None:
    sigma = np.array([10.0, 10.0, 1000.0])
    found = combine_masses(np.array([400.0, 402.0, 900.0]), sigma, sigma)
    assert abs(found.mass_kda - 401) < 0.1
    assert abs(found.sigma_mass_kda - 10 / math.sqrt(2)) < 0.01


def test_errors_that_frames_share_do_not_average_out() -> None:
    rng, n, share, tracks = np.random.default_rng(2), 100, 0.02, 500
    among = share * np.ones((n, n)) + (1 - share) * np.eye(n)
    factor = np.linalg.cholesky(among)
    pulls, naive = [], []
    sigma = np.full(n, 20.0)
    for _ in range(tracks):
        mass = 400 + 20 * factor @ rng.standard_normal(n)
        found = combine_masses(mass, sigma, sigma, correlation=among)
        pulls.append((found.mass_kda - 400) / found.sigma_mass_kda)
        naive.append((mass.mean() - 400) / combine_masses(mass, sigma, sigma).sigma_mass_kda)
    doubt = SIGMAS / math.sqrt(2 * tracks)
    assert abs(np.std(pulls) - 1) < doubt
    assert abs(np.std(naive) / math.sqrt(1 + share * (n - 1)) - 1) < doubt


def test_the_scatter_of_one_mass_is_not_remarked_on_and_that_of_two_is() -> None:
    rng = np.random.default_rng(3)
    sigma = np.full(100, 20.0)
    p_values = [
        combine_masses(400 + 20 * rng.standard_normal(100), sigma, sigma).p_mass for _ in range(200)
    ]
    assert abs(np.mean(p_values) - 0.5) < SIGMAS / math.sqrt(12 * 200)
    two = np.where(np.arange(100) < 50, 380.0, 420.0) + 20 * rng.standard_normal(100)
    assert combine_masses(two, sigma, sigma).p_mass < 1e-6


def test_a_sphere_of_its_own_material_has_its_own_index() -> None:
    diameter = np.array([5.0, 30.0, 100.0])
    for own, density in ((1.46, 1350.0), (1.59, 1050.0), (1.20, 800.0)):
        mass = np.array([sphere_mass_kda(float(d), density) for d in diameter])
        found, _ = refractive_index(mass, diameter, index=own, density_kg_m3=density, n_medium=1.33)
        assert np.allclose(found, own, rtol=1e-12)
    empty, _ = refractive_index(0.0, 30.0)
    assert abs(float(empty) - 1.33) < 1e-12


def test_the_error_of_an_index_is_that_of_drawn_masses_and_diameters() -> None:
    rng = np.random.default_rng(4)
    n, draws = 1.46, 20_000
    mass = sphere_mass_kda(30.0, 1350.0)
    drawn, _ = refractive_index(
        mass * (1 + 0.01 * rng.standard_normal(draws)), 30 * (1 + 0.01 * rng.standard_normal(draws))
    )
    found, sigma = refractive_index(mass, 30.0, sigma_mass_kda=0.01 * mass, sigma_diameter_nm=0.3)
    assert abs(float(found) - n) < 1e-9
    assert abs(np.std(drawn) / float(sigma) - 1) < 0.02 + SIGMAS / math.sqrt(2 * draws)


def test_no_sphere_scatters_more_than_a_perfect_conductor() -> None:
    found, sigma = refractive_index(1e6, 10.0)
    assert np.isnan(found)
    assert np.isnan(sigma)
    assert np.isnan(refractive_index(150.0, np.inf)[0])
    with pytest.raises(ConfigError, match="is that of the medium"):
        refractive_index(150.0, 7.0, index=1.33)
    with pytest.raises(DataError, match="shapes that do not go together"):
        refractive_index([1.0, 2.0], [1.0, 2.0, 3.0])


def test_tracks_have_the_mass_and_d_of_their_particles() -> None:
    rng, many, n = np.random.default_rng(5), 60, 150
    truth = [0.15, 0.8]
    paths = [walk(rng, n, truth[k % 2], start_nm=(4e4 * k, 5e3)) for k in range(many)]
    tracks = describe_tracks(
        fits_of(paths, rng, mass_kda=(400.0, 200.0)), setup(field_nm=(1e4, 1e7))
    )
    assert tuple(tracks.columns) == TRACK_COLUMNS
    assert (tracks["n_frames"] == n).all()
    for kind, (mass, d) in enumerate(((400.0, 0.15), (200.0, 0.8))):
        rows = tracks.iloc[kind::2]
        for name, true in (("mass_kda", mass), ("d_um2_s", d)):
            off = (rows[name] - true).to_numpy()
            pulls = off / rows[f"sigma_{name}"]
            assert abs(off.mean()) < SIGMAS * off.std() / math.sqrt(len(rows))
            assert abs(pulls.std() - 1) < SIGMAS / math.sqrt(2 * len(rows))
            assert (rows[f"sigma_{name}"] / rows[f"crb_{name}"]).between(0.9, 1.1).all()
    flagged = (tracks["status"] != TrackStatus.OK).sum()
    assert flagged <= 4  # of 60 free tracks with two tests at 0.5 %: 0.6 on average
    assert tracks[["diameter_nm", "refractive_index", "confinement_nm"]].notna().sum().sum() <= 1
    assert (tracks["begins"] == "movie").all()
    assert (tracks["ends"] != "movie").all()


def test_threads_do_not_change_the_table() -> None:
    rng = np.random.default_rng(7)
    fits = fits_of([walk(rng, 60, 0.4, start_nm=(4e4 * (k + 1), 5e3)) for k in range(6)], rng)
    shared = setup(field_nm=(1e4, 1e7))
    one, three = (describe_tracks(fits, shared, workers=n) for n in (1, 3))
    pd.testing.assert_frame_equal(one, three)
    assert one["p_anomalous"].notna().all()


def test_an_interrupt_leaves_out_the_tests_of_the_rest() -> None:
    rng = np.random.default_rng(8)
    fits = fits_of([walk(rng, 60, 0.4, start_nm=(4e4 * (k + 1), 5e3)) for k in range(6)], rng)

    def stop(*so_far: object) -> None:
        if so_far[1] == 2:
            raise KeyboardInterrupt

    tracks = describe_tracks(fits, setup(field_nm=(1e4, 1e7)), progress=stop)
    assert tracks["d_um2_s"].notna().all()
    assert tracks["p_anomalous"].notna().tolist() == 2 * [True] + 4 * [False]


def test_only_particles_in_a_volume_have_a_size() -> None:
    rng = np.random.default_rng(6)
    diameter, density, n_frames = 30.0, 1350.0, 180
    d = 1.380649e-23 * 298.15 / (3 * math.pi * 0.89e-3 * diameter * 1e-9) * 1e12
    mass = sphere_mass_kda(diameter, density)
    table = fits_of(
        [walk(rng, n_frames, d, start_nm=(5e5, 5e5))], rng, mass_kda=(mass,), sigma_kda=0.02 * mass,
        z_nm=800.0,
    )  # fmt: skip
    wide = (1e6, 1e6)
    row = describe_tracks(table, setup(volume=True, field_nm=wide)).iloc[0]
    assert abs(row["diameter_nm"] - diameter) < SIGMAS * row["sigma_diameter_nm"]
    assert row["sigma_diameter_nm"] < 0.15 * diameter
    assert abs(row["refractive_index"] - 1.46) < SIGMAS * row["sigma_refractive_index"]
    metal = describe_tracks(table, setup(volume=True, index=None, field_nm=wide)).iloc[0]
    assert np.isnan(metal["refractive_index"])
    near = describe_tracks(table.assign(z_nm=40.0), setup(volume=True, field_nm=wide)).iloc[0]
    assert near["status"] == TrackStatus.NEAR_WALL
    bound = describe_tracks(table.assign(z_nm=5.0), setup(volume=True, field_nm=wide)).iloc[0]
    assert np.isnan(bound["diameter_nm"])  # its middle cannot be nearer to the wall than its radius
    assert np.isnan(describe_tracks(table, setup(field_nm=wide)).iloc[0]["diameter_nm"])


def test_particles_that_leave_the_field_have_the_right_d() -> None:
    """At the border only those steps are seen that stay or come back, and they make D too small."""
    rng, d, rate = np.random.default_rng(16), 0.8, 331.0
    step = 1e3 * math.sqrt(2 * d / rate)
    start, field = np.array([100.0, 100.0]), (1e5, 1e5)
    times = {"frame_rate_hz": rate, "exposure_ms": 0.0}
    all_steps, far_from_it, described = [], [], []
    for number in range(500):
        places = np.cumsum(step * rng.standard_normal((60, 2)), axis=0) + start
        frames = np.flatnonzero((places > 0).all(axis=1))
        noisy = places[frames] + 5 * rng.standard_normal((frames.size, 2))
        gone = step * np.sqrt(np.diff(frames))
        counted = (noisy[:-1] > 3 * gone[:, None]).all(axis=1)
        if counted.sum() < 10:
            continue
        for off, chosen in ((all_steps, None), (far_from_it, counted)):
            found = fit_diffusion(frames, noisy, 5.0, counted=chosen, **times)
            off.append(found.d_um2_s / d - 1)
        if number < 20:
            table = fits_of([places[frames]], rng).assign(frame=frames)
            row = describe_tracks(table, setup(field_nm=field, exposure_ms=0.0)).iloc[0]
            described.append(row["n_d_frames"] / frames.size)
    assert np.mean(all_steps) < -SIGMAS * np.std(all_steps) / math.sqrt(len(all_steps))
    assert abs(np.mean(far_from_it)) < SIGMAS * np.std(far_from_it) / math.sqrt(len(far_from_it))
    assert 0.1 < np.mean(described) < 0.98


def test_what_does_not_move_is_flagged_and_has_no_size() -> None:
    rng = np.random.default_rng(7)
    still = np.tile([5000.0, 5000.0], (80, 1))
    found = describe_tracks(fits_of([still] * 1, rng), setup(volume=True)).iloc[0]
    assert found["status"] == TrackStatus.STANDS_STILL
    assert found["d_low_um2_s"] == 0
    assert found["d_high_um2_s"] > found["d_um2_s"]
    assert np.isnan(found["diameter_nm"])


def test_a_slow_particle_that_is_lost_is_flagged_where_the_background_may_have_it() -> None:
    rng = np.random.default_rng(9)
    slow, fast = walk(rng, 60, 0.01), walk(rng, 60, 0.8)

    def statuses(**changes: float) -> list[str]:
        both = describe_tracks(fits_of([slow, fast], rng, first=(100,)), setup(**changes))
        return both["status"].tolist()

    assert statuses(hidden_nm=370.0) == [TrackStatus.PARTLY_SEEN, TrackStatus.OK]
    assert statuses() == [TrackStatus.OK] * 2
    whole = describe_tracks(fits_of([walk(rng, 200, 0.01)], rng), setup(hidden_nm=370.0))
    assert whole["status"].tolist() == [TrackStatus.OK]


def test_few_frames_are_those_that_tell_how_a_track_moves() -> None:
    """They have a mass and no D; of 40 positions at the border none tells, which is said."""
    rng = np.random.default_rng(8)
    found = describe_tracks(fits_of([walk(rng, 6, 0.3)], rng), SETUP).iloc[0]
    assert found["status"] == TrackStatus.FEW_FRAMES
    assert np.isnan(found["d_um2_s"])
    assert abs(found["mass_kda"] - 400) < SIGMAS * found["sigma_mass_kda"]
    path = walk(rng, 40, 0.8, start_nm=(0.0, 5000.0))
    path[:, 0] = 30.0  # [nm] from the border, along which it goes 100 nm from frame to frame
    found = describe_tracks(fits_of([path], rng), SETUP).iloc[0]
    assert (found["n_frames"], found["n_d_frames"]) == (40, 0)
    assert found["flags"] == TrackStatus.FEW_FRAMES
    assert "border" in TrackStatus.FEW_FRAMES.advice


def test_fits_that_ended_at_no_mass_have_no_contrast_for_it() -> None:
    """Their ratio is not known, and is left out without a warning."""
    rng = np.random.default_rng(8)
    fits = fits_of([walk(rng, 30, 0.3)], rng)
    fits.loc[:3, ["mass_kda", "contrast"]] = 0.0
    found = describe_tracks(fits, SETUP).iloc[0]
    assert found["contrast"] == pytest.approx(-3.1e-5 * found["mass_kda"])


def test_confined_motion_is_remarked_on_with_the_size_of_the_well() -> None:
    rng = np.random.default_rng(9)
    found = describe_tracks(fits_of([walk(rng, 200, 0.8, side_nm=500.0)], rng), SETUP).iloc[0]
    assert found["status"] == TrackStatus.NOT_FREE
    assert found["p_confinement"] == 1 / 200
    assert abs(found["confinement_nm"] / (500 / math.sqrt(12)) - 1) < 0.35


def test_tracks_that_meet_are_marked_and_keep_their_verdict() -> None:
    rng, n = np.random.default_rng(10), 100
    apart = np.linspace(-2000, 2000, n)[:, None] * [1.0, 0.0]
    paths = [walk(rng, n, 0.1), walk(rng, n, 0.1) + apart]
    found = describe_tracks(fits_of([*paths, walk(rng, n, 0.1, start_nm=(9000, 9000))], rng), SETUP)
    assert ["crosses" in flags for flags in found["flags"]] == [True, True, False]
    assert found["nearest_nm"].iloc[:2].lt(500).all()
    assert found["status"].iloc[0] == TrackStatus.OK


def test_ends_tell_the_border_from_the_inside() -> None:
    rng, n = np.random.default_rng(11), 60
    leaving = np.linspace(3000, 10_600, n)[:, None] * [1.0, 0.0] + [0.0, 5000.0]
    fits = fits_of([leaving, walk(rng, n, 0.05)], rng, first=(140, 20))
    found = describe_tracks(fits, SETUP)
    assert found[["begins", "ends"]].to_numpy().tolist() == [["inside", "movie"], ["inside"] * 2]
    early = fits_of([leaving], rng, first=(0,))
    assert describe_tracks(early, SETUP)[["begins", "ends"]].to_numpy().tolist() == [
        ["movie", "border"]
    ]


def test_without_a_frame_rate_there_are_masses_and_places_and_no_d() -> None:
    rng = np.random.default_rng(12)
    found = describe_tracks(fits_of([walk(rng, 50, 0.3)], rng), setup(frame_rate_hz=None)).iloc[0]
    assert found["status"] == TrackStatus.OK
    assert np.isnan(found["d_um2_s"])
    assert np.isfinite(found["mass_kda"])


def test_frames_that_are_flagged_do_not_make_the_mass_but_the_path() -> None:
    rng = np.random.default_rng(13)
    fits = fits_of([walk(rng, 100, 0.3)], rng)
    fits.loc[fits.index[::3], ["status", "mass_kda"]] = ["poor_fit", 1000.0]
    found = describe_tracks(fits, SETUP).iloc[0]
    assert abs(found["mass_kda"] - 400) < SIGMAS * found["sigma_mass_kda"]
    assert (found["n_mass_frames"], found["n_d_frames"]) == (66, 100)
    fits.loc[fits.index[:60], "status"] = "poor_fit"
    assert describe_tracks(fits, SETUP).iloc[0]["status"] == TrackStatus.POOR_FITS


@pytest.mark.parametrize(("understated", "rejected"), [(1.0, True), (2.5, True), (2.5, False)])
def test_a_track_whose_fits_are_rejected_states_the_errors_that_its_frames_show(
    understated: float, rejected: bool
) -> None:
    """Without the factor masses of 100 tracks scatter by 2.5 times their errors."""
    rng, tracks = np.random.default_rng(14), 60
    fits = fits_of([walk(rng, 30, 0.05) for _ in range(tracks)], rng, sigma_nm=40.0)
    columns = [
        f"{kind}_{name}" for kind in ("sigma", "crb") for name in ("x_nm", "y_nm", "mass_kda")
    ]
    fits[columns] /= understated
    if rejected:  # three of four, whatever they are wrong by
        fits.loc[rng.uniform(size=len(fits)) < 0.75, "status"] = "poor_fit"
    exact = pd.DataFrame(
        {"mass_kda": 400.0, "sigma_mass_kda": 2.0, "crb_mass_kda": 1.9}, index=range(1)
    )
    found = describe_tracks(fits, SETUP, masses=exact)
    widened = found["mass_scatter"].clip(lower=1.0) if rejected else 0 * found["mass_scatter"] + 1.0
    assert found["sigma_mass_kda"].iloc[0] == pytest.approx(2.0 * widened.iloc[0])
    rest = found.iloc[1:]
    assert ((rest["status"] == TrackStatus.POOR_FITS) == rejected).all()
    assert (rest["n_mass_frames"] == 30).all()
    pulls = (rest["mass_kda"] - 400.0) / rest["sigma_mass_kda"]
    right = understated == 1 or rejected
    assert (abs(pulls.std() - 1) < SIGMAS / np.sqrt(2 * len(rest))) == right
    assert rest["mass_scatter"].median() == pytest.approx(understated, rel=0.05)
    d = rest["d_um2_s"] / 0.05 - 1  # which errors of places that are too small make too large
    assert (abs(d.mean()) < SIGMAS * d.std() / np.sqrt(len(rest))) == right


def test_masses_of_the_exact_likelihood_take_the_place_of_means() -> None:
    rng = np.random.default_rng(15)
    fits = fits_of([walk(rng, 30, 0.3), walk(rng, 30, 0.3, start_nm=(9e3, 9e3))], rng)
    exact = pd.DataFrame(
        {"mass_kda": [390.0, np.nan], "sigma_mass_kda": [2.0, 2.0], "crb_mass_kda": [1.9, 1.9]},
        index=[0, 1],
    )
    found, mean = describe_tracks(fits, SETUP, masses=exact), describe_tracks(fits, SETUP)
    assert found[list(exact)].iloc[0].tolist() == [390.0, 2.0, 1.9]
    assert "other_particle" not in found["flags"].iloc[0]
    exact["log_odds_particle"] = -7.0  # 1 : 1097
    other = describe_tracks(fits, SETUP, masses=exact).iloc[0]
    assert other["log_odds_particle"] == -7.0
    assert "other_particle" in other["flags"]
    assert abs(found["contrast"].iloc[0] + 3.1e-5 * 390) < 1e-12
    assert found["mass_kda"].iloc[1] == mean["mass_kda"].iloc[1]


def test_no_rows_make_an_empty_table_with_its_columns() -> None:
    fits = fits_of([np.zeros((1, 2))], np.random.default_rng(1)).iloc[:0]
    found = describe_tracks(fits, SETUP)
    assert found.empty
    assert tuple(found.columns) == TRACK_COLUMNS


def test_rows_without_a_track_belong_to_none() -> None:
    rng = np.random.default_rng(14)
    fits = fits_of([walk(rng, 30, 0.3), walk(rng, 30, 0.3, start_nm=(9e3, 9e3))], rng)
    fits["track"] = fits["event"].astype("Int64")
    fits.loc[fits["event"] == 0, "track"] = pd.NA
    assert describe_tracks(fits, SETUP)["track"].tolist() == [1]


def _timed(
    frames: int = 100, *, track: int = 10, learnt: bool = False, **camera: float
) -> list[str]:
    """Judge the times of a movie, whose camera is that of 331 frames a second."""
    config = parse_config({
        "camera": {"pixel_size_nm": PIXEL_NM, **camera}, "fit": {"mode": "track"},
        "background": {"method": "tracks"} if learnt else {"frames": [0, 10]},
        "track": {"min_frames": track},
    })  # fmt: skip
    return [found.text for found in judge_times(config, frames, "movie.tif")]


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        ({"frame_rate_hz": 331.0, "exposure_ms": 2.5e-3}, "in seconds, write 2.5,"),
        ({"frame_rate_hz": 331.0, "exposure_ms": 1 / 331.0}, f"in seconds, write {1e3 / 331:g},"),
        ({"frame_rate_hz": 331.0, "exposure_ms": 0.01}, None),
        ({"frame_rate_hz": 331.0, "exposure_ms": 2.5}, None),
        ({"exposure_ms": 2.5}, "camera.frame_rate_hz = 331.0"),
        ({"frame_rate_hz": 331.0}, "camera.exposure_ms"),
    ],
)
def test_a_wrong_or_missing_time_is_said_with_its_key(
    camera: dict[str, float], words: str | None
) -> None:
    said = _timed(**camera)
    assert len(said) == (words is not None)
    assert words is None or words in said[0]


def test_times_that_cannot_be_are_refused() -> None:
    """Of a track longer than its movie it was said that nothing stands out of the noise."""
    with pytest.raises(ConfigError, match=r"exposure_ms = 4 is longer than the 3\.021 ms"):
        _timed(frame_rate_hz=331.0, exposure_ms=4.0)
    assert not _timed(60, track=60, learnt=True, frame_rate_hz=331.0, exposure_ms=2.0)
    with pytest.raises(ConfigError, match=r"track\.min_frames = 60 is more than the 59 frames of"):
        _timed(59, track=60, learnt=True, frame_rate_hz=331.0, exposure_ms=2.0)


def test_a_short_movie_is_said_with_what_it_can_tell() -> None:
    camera = {"frame_rate_hz": 331.0, "exposure_ms": 2.0}
    assert not _timed(SHORT_MOVIE, **camera)
    (said,) = _timed(10, **camera)
    assert said.startswith("movie.tif: 10 frames tell no diffusion coefficient better than to 33 %")
    (said,) = _timed(5, **camera)
    assert "track.min_frames = 10" in said


def test_steps_that_are_not_linked_are_told() -> None:
    """Of steps of 181 nm along each axis 0.4 % exceed 600 nm, and with them 2.2 % of D is lost."""
    told = pd.DataFrame({"status": ["ok"], "d_um2_s": [16.36]})
    found = cut_steps(told, setup(frame_rate_hz=1000.0), 600.0)
    assert found is not None
    assert "0.41 % of steps are longer than track.max_step_nm = 600" in found.text
    assert found.remedy == "set it to 904"
    assert cut_steps(told, setup(frame_rate_hz=1000.0), 904.0) is None
    rng = np.random.default_rng(2)
    steps = rng.normal(0, 180.9, (400_000, 2))
    kept = steps[np.hypot(*steps.T) < 600]
    ratio = 600**2 / (2 * 180.9**2)
    lost = ratio * math.exp(-ratio) / (1 - math.exp(-ratio))
    assert 1 - np.mean(kept**2) / 180.9**2 == pytest.approx(lost, abs=4 / math.sqrt(400_000))
