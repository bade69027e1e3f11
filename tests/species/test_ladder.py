"""Numbers, given masses and ladders of species, and the tables they are found in."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from event_tables import draw_table
from scipy.optimize import approx_fprime

import iscat_analysis as ia
from iscat_analysis.report.vega import figures_in
from iscat_analysis.species import Efficiency, Given, Ladder, Number, describe
from iscat_analysis.species.choices import Chosen
from iscat_analysis.species.events import Events
from iscat_analysis.species.structure import joint_problem, log_likelihood, parameters
from iscat_analysis.species.tables import UNKNOWN_SIGMA_KDA, event_table, sentences

EFFICIENCY = Efficiency(5.0, 13.0)
OLIGOMERS = {66.0: 500, 132.0: 300, 264.0: 200}


@pytest.fixture(scope="module")
def oligomers() -> pd.DataFrame:
    return draw_table(np.random.default_rng(3), OLIGOMERS, background=40, efficiency=EFFICIENCY)


def events_of(table: pd.DataFrame) -> Events:
    return Events(np.abs(table["mass_kda"]).to_numpy(), table["sigma_mass_kda"].to_numpy(),
                  EFFICIENCY)  # fmt: skip


@pytest.mark.parametrize(
    "choice", [Ladder(66.0, (1, 2, 4), offset=True), Ladder(66.0, (1, 2), widths="free"),
               Given((66.0, 132.0), background=False)],
)  # fmt: skip
def test_shared_parameters_have_the_slope_that_differences_give(
    choice: Ladder | Given, oligomers: pd.DataFrame
) -> None:
    events = events_of(oligomers)
    found = choice.choose(events)
    sample, limits = [(events, found.structure)], found.structure
    theta = parameters(sample, [found.best]) + 0.3 * limits.scale
    theta = np.minimum(theta, limits.high - limits.scale)
    value, slope = log_likelihood(sample, theta)
    numerical = approx_fprime(theta, lambda t: log_likelihood(sample, t)[0], 1e-5)
    assert np.isfinite(value)
    assert np.allclose(slope, numerical, rtol=1e-3, atol=1e-2)
    curved = joint_problem(sample).curvature(theta)
    for shift, bends in zip(np.diag(1e-4 * limits.scale), curved, strict=True):
        above, below = (log_likelihood(sample, theta + s * shift)[1] for s in (1, -1))
        size = bends[shift > 0].item()
        rises = (below - above) / (2 * shift.max())
        assert np.allclose(rises, bends, rtol=0.02, atol=0.02 * abs(size))


def test_a_maximum_is_flat_inside_its_range(oligomers: pd.DataFrame) -> None:
    events = events_of(oligomers)
    found = Ladder(66.0, (1, 2, 4)).choose(events)
    sample = [(events, found.structure)]
    theta = parameters(sample, [found.best])
    _, slope = log_likelihood(sample, theta)
    step = np.linalg.solve(joint_problem(sample).curvature(theta), slope)
    error = np.sqrt(np.diag(np.linalg.inv(joint_problem(sample).curvature(theta))))
    assert np.all(np.abs(step) < 0.05 * error)


@pytest.mark.parametrize("monomer", [60.0, 72.0, "auto"])
def test_steps_and_monomer_are_found(monomer: float, oligomers: pd.DataFrame) -> None:
    found = ia.find_species(oligomers, ladder=monomer, draws=0)
    assert found.ladder is not None
    assert found.ladder.steps == (1, 2, 4)
    assert found.ladder.monomer_kda == pytest.approx(66.0, abs=0.6)
    assert found.ladder.p_value > 0.01
    assert found.species["n"].tolist() == [1, 2, 4, 0]
    fractions = found.species["fraction"].to_numpy()
    assert fractions[:3] == pytest.approx([0.5, 0.3, 0.2], abs=0.06)
    assert np.isnan(fractions[3])
    assert np.nansum(fractions) == pytest.approx(1)
    assert found.species["background"].tolist() == [False, False, False, True]


def test_a_ladder_may_be_offset_and_says_where_it_is_none() -> None:
    table = draw_table(np.random.default_rng(4), {76.0: 400, 142.0: 300, 274.0: 300})
    bent = ia.find_species(table, ladder=70.0, steps=(1, 2, 4), draws=0)
    right = ia.find_species(table, ladder=70.0, steps=(1, 2, 4), offset=True, draws=0)
    assert bent.ladder is not None
    assert right.ladder is not None
    assert bent.ladder.p_value < 1e-6
    assert any("multiples" in note for note in bent.notes)
    assert right.ladder.p_value > 0.01
    assert right.ladder.offset_kda == pytest.approx(10.0, abs=2.5)
    assert right.ladder.monomer_kda == pytest.approx(66.0, abs=1.0)


def test_what_is_held_stays_and_its_intervals_say_so(oligomers: pd.DataFrame) -> None:
    found = ia.find_species(oligomers, ladder=65.0, steps=(1, 2, 4), hold=True, draws=4)
    assert found.ladder is not None
    assert found.ladder.held
    assert found.ladder.monomer_kda == found.ladder.monomer_low == 65.0
    given = ia.find_species(oligomers, masses_kda=(132.0, 66.0), widths="free", draws=0)
    assert given.species["mass_kda"].tolist()[:2] == [66.0, 132.0]
    assert given.species["mass_kda"].isna().tolist() == [False, False, True]
    wide = oligomers[oligomers["mass_kda"] < 170].assign(sigma_mass_kda=3.0)
    for widths, number in (("free", 2), ("common", 1)):
        given = ia.find_species(wide, masses_kda=(132.0, 66.0), widths=widths, draws=0)  # type: ignore[arg-type]
        assert given.species["width_kda"][:2].nunique() == number


def test_as_many_species_as_asked_for(oligomers: pd.DataFrame) -> None:
    found = ia.find_species(oligomers, k=2, draws=3)
    assert len(found.species) == 2
    assert "background" not in found.species
    assert np.isnan(found.support)
    more = Number(5).choose(events_of(oligomers))
    assert isinstance(more, Chosen)
    assert more.best.weight.size == 5


def test_species_begin_where_somebody_says(oligomers: pd.DataFrame) -> None:
    free = ia.find_species(oligomers, k=3, draws=0)
    found = ia.find_species(oligomers, start_kda=(240.0, 60.0, 140.0), draws=0)
    assert found.selection["log_likelihood"].iloc[-1] == pytest.approx(
        free.selection["log_likelihood"].iloc[-1], abs=0.05
    )
    assert found.species["mass_kda"].to_numpy() == pytest.approx(
        free.species["mass_kda"].to_numpy(), rel=0.01
    )
    alone = ia.find_species(oligomers, start_kda=[66.0], draws=0)  # the number is the user's
    assert len(alone.species) == 1
    assert alone.species["mass_kda"].iloc[0] != pytest.approx(66.0, rel=0.1)


def test_a_cut_tells_as_much_as_the_detector_does() -> None:
    table = draw_table(np.random.default_rng(5), {66.0: 6000, 132.0: 2000}, efficiency=EFFICIENCY)
    plain = table.drop(columns="snr")
    # Measured masses above 100 kDa are all detected (10 of the extra σ above the threshold).
    seen = describe(table["mass_kda"], table["sigma_mass_kda"], efficiency=EFFICIENCY, seed=1,
                    draws=0, choice=Ladder(66.0, (1, 2), background=False))  # fmt: skip
    cut = ia.find_species(plain, ladder=66.0, steps=(1, 2), above_kda=70.0, background=False,
                          limit_kda=None, draws=0)  # fmt: skip
    blind = ia.find_species(plain, ladder=66.0, steps=(1, 2), limit_kda=1.0, background=False,
                            draws=0)  # fmt: skip
    assert seen.species["fraction"][0] == pytest.approx(0.75, abs=0.02)
    assert abs(cut.species["fraction"][0] - 0.75) < 0.06
    assert blind.species["fraction"][0] < 0.65


def test_tables_of_all_kinds_give_the_same_events(tmp_path: Path, oligomers: pd.DataFrame) -> None:
    ours = oligomers.assign(status="ok", frame=np.arange(len(oligomers)), n_after=10)
    ours.loc[3, "status"] = "poor_fit"
    ours.to_csv(tmp_path / "fits.csv", index=False)
    (tmp_path / "p").mkdir()
    ours.to_parquet(tmp_path / "p" / "fits.parquet")
    (tmp_path / "summary.json").write_text(json.dumps({"detection_threshold_snr": 5.0}))
    from_csv, folder, parquet = (
        event_table(path) for path in (tmp_path / "fits.csv", tmp_path, tmp_path / "p")
    )
    assert len(from_csv.mass_kda) == len(ours) - 1
    assert from_csv.window_frames == 10
    assert np.array_equal(from_csv.mass_kda, folder.mass_kda)
    assert np.allclose(from_csv.mass_kda, parquet.mass_kda)
    assert from_csv.efficiency is not None
    assert from_csv.efficiency.threshold_snr == 5.0
    assert from_csv.efficiency.sigma_kda == pytest.approx(13.0, rel=0.05)
    assert parquet.efficiency is not None
    assert parquet.efficiency.threshold_snr == pytest.approx(5.0, abs=0.02)


def test_a_table_without_errors_or_snr_says_what_it_takes(oligomers: pd.DataFrame) -> None:
    bare = event_table(oligomers[["mass_kda"]])
    assert np.all(bare.sigma_kda == UNKNOWN_SIGMA_KDA)
    assert bare.efficiency is not None
    assert bare.efficiency.threshold_kda == pytest.approx(
        oligomers["mass_kda"].abs().min(), rel=1e-4
    )
    assert bare.efficiency(oligomers["mass_kda"].abs()).min() == pytest.approx(1.0)
    said = sentences(bare.remarks)
    assert [any(word in line for line in said) for word in ("error", "lightest")] == [True, True]
    assert np.all(event_table(oligomers, sigma_kda=9.0).sigma_kda == 9.0)
    limited = event_table(oligomers, limit_kda=65.0, limit_sigma_kda=13.0).efficiency
    assert limited == EFFICIENCY


def test_refeyns_table_is_read(data_dir: Path) -> None:
    path = data_dir / "refeyn_events_2.4.2.h5"
    if not path.exists():
        pytest.skip(f"no measured table: {path} is absent")
    found = ia.find_species(path, masses_kda=(66, 146, 480), widths="free", draws=0)
    assert found.events == 2069
    assert found.species["count"].sum() == pytest.approx(2069)
    assert np.all(found.species["count"].to_numpy()[:3] > 150)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"k": 2, "ladder": 66.0}, "give one of them"),
        ({"steps": (1, 2)}, "give `ladder`"),
        ({"k": 0}, "`k` = 0: give one whole number of at least 1"),
        ({"masses_kda": (66.0, -1.0)}, "above 0"),
        ({"masses_kda": (66.0, 66.0)}, "twice"),
        ({"start_kda": (66.0, 66.0)}, "`start_kda`: names a mass twice"),
        ({"start_kda": (66.0,), "k": 2}, "`k` and `start_kda`"),
        ({"ladder": -3.0}, "mass of a monomer"),
        ({"ladder": 66.0, "steps": (0, 1)}, "`steps` = 0: give one whole number"),
        ({"ladder": "auto", "hold": True}, "whose mass is given"),
        ({"widths": "both"}, "choose one of common, free"),
        ({"branch": "up"}, "magnitude, landing, leaving"),
        ({"draws": -1}, "at least 0"),
        ({"sigma_kda": 0.0}, "above 0"),
        ({"limit_kda": 30.0, "above_kda": 20.0}, "give one of them"),
        ({"limit_sigma_kda": 3.0}, "give `limit_kda`"),
    ],
)
def test_impossible_options_are_refused(options: dict, said: str, oligomers) -> None:
    with pytest.raises(ia.ConfigError, match=said):
        ia.find_species(oligomers, **options)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is no table of events"),
        ("a,b\n1,2\n", "column mass_kda"),
        ("mass_kda\nx\n", "no number"),
        ("mass_kda,status\n66,poor_fit\n", "status ok"),
        ("mass_kda\n66\n67\n", "too few"),
        ("mass_kda,sigma_mass_kda\n66,0\n", "too few"),
    ],
)
def test_wrong_tables_are_refused_with_what_to_do(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "events.csv"
    path.write_text(text)
    with pytest.raises(ia.DataError, match=said):
        ia.find_species(path)


@pytest.mark.parametrize(
    "options",
    [{"ladder": 66.0}, {"ladder": 66.0, "steps": (1, 2, 4), "hold": True},
     {"masses_kda": (66.0, 132.0)}],
)  # fmt: skip
@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_masses_in_another_unit_are_refused(
    options: dict, factor: float, oligomers: pd.DataFrame
) -> None:
    scaled = oligomers.assign(
        mass_kda=factor * oligomers["mass_kda"], sigma_mass_kda=factor * oligomers["sigma_mass_kda"]
    )
    with pytest.raises(ia.DataError, match="no event is near the masses"):
        ia.find_species(scaled, **options, draws=0)


def test_results_are_written(tmp_path: Path, oligomers: pd.DataFrame) -> None:
    out = tmp_path / "answer"
    notes: list[str] = []
    found = ia.find_species(oligomers, ladder=66.0, draws=2, out=out, notify=notes.append)
    assert sorted(path.name for path in out.iterdir()) == [
        ".iscat-files", "species.csv", "species.html", "species.json",
    ]  # fmt: skip
    written = json.loads((out / "species.json").read_text())
    assert written["ladder"]["steps"] == [1, 2, 4]
    assert written["notes"] == notes
    table = pd.read_csv(out / "species.csv")
    assert table["mass_kda"].tolist() == pytest.approx(
        found.species["mass_kda"].tolist(), nan_ok=True
    )
    drawn = pd.DataFrame(figures_in(out / "species.html")["species"].data["rows"])
    assert drawn[drawn["kind"] == "bar"]["y"].sum() == found.histogram["count"].sum()
    with pytest.raises(ia.DataError, match="earlier result"):
        ia.find_species(oligomers, ladder=66.0, draws=0, out=out)
