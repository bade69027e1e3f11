"""The output folder: what is in it, that it appears whole, and that nothing foreign is lost."""

from __future__ import annotations

import json
import re
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd
import pytest

from iscat_analysis.config import load_config, parse_config
from iscat_analysis.errors import DataError
from iscat_analysis.findings.results import NOT_A_MASS
from iscat_analysis.notebook import Result
from iscat_analysis.pipeline.stored import open_result
from iscat_analysis.records import EVENT_COLUMNS, Analysis, Status, counted, tally
from iscat_analysis.report import check_output, render_page, render_report, write_report
from iscat_analysis.report.answer import answer_in, answers, precision_of, spoken
from iscat_analysis.report.movie_figures import (
    CREDIBLE_LEVELS,
    PICTURE_PX,
    Sample,
    bin_width,
    credible_shades,
    movie_figures,
)
from iscat_analysis.report.movie_page import measured_lines
from iscat_analysis.report.numbers import number, numeric, tabulate, worded
from iscat_analysis.report.output import OUTPUT_NAMES, atomic_folder
from iscat_analysis.report.page import Chart, Section, render_document
from iscat_analysis.report.tables import event_table
from iscat_analysis.report.vega import figure, figures_in, libraries
from iscat_analysis.schemas import jsonable
from iscat_analysis.species import describe

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from report_factory import HOSTILE, make_analysis, with_traces, without_events


def payload(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)
    assert found is not None
    return dict(json.loads(found.group(1)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    analysis = make_analysis(8, "joint", posteriors=2, refused=1)
    analysis = replace(analysis, views=analysis.views[:3])  # with chains, one of them refused
    return write_report(analysis, tmp_path_factory.mktemp("out") / "movie.iscat")


class TestFolder:
    def test_holds_exactly_what_is_promised_and_has_no_sibling(self, folder: Path) -> None:
        others = {"tracks.csv", "tracks.parquet", "response.csv", "figures"}
        assert {path.name for path in folder.iterdir()} == OUTPUT_NAMES - others
        assert [path.name for path in folder.parent.iterdir()] == [folder.name]

    def test_csv_has_the_columns_in_order_and_empty_cells_for_nan(self, folder: Path) -> None:
        lines = (folder / "fits.csv").read_text(encoding="utf-8").splitlines()
        assert lines[0] == ",".join(EVENT_COLUMNS)
        cells = dict(zip(EVENT_COLUMNS, lines[1 + 5].split(","), strict=True))
        assert cells["sigma_x_nm"] == ""
        assert all(len(cell) < 20 for line in lines[1:] for cell in line.split(",")[4:-2])

    def test_summary_is_strict_json_without_nan(self, folder: Path) -> None:
        def refuse(name: str) -> float:
            raise AssertionError(f"{name} is not JSON")

        text = (folder / "summary.json").read_text(encoding="utf-8")
        assert json.loads(text, parse_constant=refuse)["efficiency"] is None

    def test_config_reruns_the_job(self, folder: Path) -> None:
        expected = parse_config(
            {"fit": {"mode": "joint"}, "optics": {"scheme": "iscat", "attenuation": 0.1}}
        )
        assert load_config(folder / "config.toml") == expected

    def test_the_page_holds_its_figures_as_data(self, folder: Path) -> None:
        found = figures_in(folder / "report.html")
        again = movie_figures(make_analysis(8, "joint", posteriors=2, refused=1))
        assert {"masses", "field", "time", "limit", "precision", "budget", "chi2"} <= set(found)
        assert {name for name in found if "corner" in name} == {"corner_0001", "corner_0002"}
        for name in ("masses", "time", "limit"):
            assert found[name].to_dict()["datasets"] == again[name].to_dict()["datasets"]

    def test_the_budget_is_drawn_and_adds_up(self, folder: Path) -> None:
        page = (folder / "report.html").read_text(encoding="utf-8")
        assert "photon noise" in figures_in(folder / "report.html")["budget"].data["budget"]["name"]
        rows = re.findall(r"<tr>(.*?)</tr>", page[page.index('<details id="budget"') :], re.DOTALL)
        cells = [re.findall(r"<td[^>]*>(.*?)</td>", row, re.DOTALL) for row in rows[:6]]
        said = {row[0].strip(): row[3:5] for row in cells if row}
        assert said["photon noise"] == ["6.00", "1.2 %"]
        assert said["scale of the model"] == ["—", "—"]
        assert said["all that is shared"] == ["6.00", "1.2 %"]  # of 4.8 and 3.6

    def test_page_fetches_nothing_and_escapes_file_names(self, folder: Path) -> None:
        page = (folder / "report.html").read_text(encoding="utf-8")
        page = page.replace(libraries(), "")
        outside = set(re.findall(r"https?://[^\"' )]+", page))
        schema = "https://vega.github.io/schema/vega-lite/v6.json"  # a name, which nobody fetches
        assert outside == {"http://www.w3.org/2000/svg", schema}
        assert not re.search(r"@import|<link(?![^>]*data:)|src=\"(?!data:)", page)
        for text in (HOSTILE, "<script>alert", "<img"):
            assert text not in page
        assert page.count("</script>") == page.count("<script")


class TestPosterior:
    def test_only_converged_chains_are_written(self, folder: Path) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            import arviz
        data = arviz.from_netcdf(str(folder / "posterior.nc"))
        assert data.posterior["event"].values.tolist() == [1, 2]
        assert data.posterior["mass_kda"].dims == ("chain", "draw", "event")
        assert json.loads(data.posterior.attrs["events_not_converged"]) == [0]
        source = make_analysis(8, "joint", posteriors=2, refused=1).views[2].posterior
        assert source is not None
        draws = data.posterior.sizes["draw"]
        np.testing.assert_array_equal(
            data.posterior["z_nm"].sel(event=2).values, source.samples[:, -draws:, 2]
        )
        summary = arviz.summary(data.posterior.sel(event=2))
        assert set(summary.index) == {"x_nm", "y_nm", "z_nm", "mass_kda"}
        assert np.isfinite(summary["mean"]).all()
        assert data.posterior["z_nm"].attrs["units"] == "nm"
        data.close()

    def test_a_refused_chain_shows_its_message_and_no_number(self, tmp_path: Path) -> None:
        out = write_report(make_analysis(3, "joint", refused=1), tmp_path / "out")
        assert not (out / "posterior.nc").exists()
        page = (out / "report.html").read_text(encoding="utf-8")
        assert "split R-hat of z_nm is 1.31" in page
        assert "fit ± σ" not in page  # the table of posteriors


class TestOverwrite:
    def test_an_earlier_result_stays_without_permission(self, tmp_path: Path) -> None:
        out = write_report(without_events(make_analysis(1)), tmp_path / "out")
        before = (out / "fits.csv").stat().st_mtime_ns
        with pytest.raises(DataError, match="pass `overwrite`"):
            write_report(make_analysis(1), out)
        assert (out / "fits.csv").stat().st_mtime_ns == before

    def test_figures_of_an_earlier_version_are_replaced_and_those_of_somebody_stay(
        self, tmp_path: Path
    ) -> None:
        known = frozenset({"kd.csv", "kd.html"})
        with atomic_folder(tmp_path / "out", known=known) as building:  # as it once was written
            (building / "kd.csv").write_text("1")
            (building / "figures").mkdir()
            (building / "figures" / "kd.svg").write_text("<svg/>")
            (building / "scan.png").write_text("")
        with atomic_folder(tmp_path / "out", overwrite=True, known=known) as building:
            (building / "kd.html").write_text("")
        assert not (tmp_path / "out" / "figures").exists()
        (tmp_path / "out" / "mine.png").write_text("")
        with pytest.raises(DataError, match="holds 'mine"):
            check_output(tmp_path / "out", overwrite=True, known=known)

    def test_empty_and_absent_folders_are_fine_and_files_are_not(self, tmp_path: Path) -> None:
        check_output(tmp_path)
        check_output(tmp_path / "new" / "deeper")
        (tmp_path / "out").write_text("")
        with pytest.raises(DataError, match="is a file"):
            check_output(tmp_path / "out", overwrite=True)

    @pytest.mark.parametrize("trouble", [RuntimeError, KeyboardInterrupt])
    def test_a_failure_leaves_everything_as_it_was(
        self, tmp_path: Path, trouble: type[BaseException]
    ) -> None:
        out = write_report(without_events(make_analysis(1)), tmp_path / "out")

        def build() -> None:
            with atomic_folder(out, overwrite=True) as building:
                (building / "fits.csv").write_text("half a table")
                raise trouble

        with pytest.raises(trouble):
            build()
        assert [path.name for path in tmp_path.iterdir()] == ["out"]
        assert (out / "fits.csv").read_text().startswith("event,")


@pytest.mark.parametrize("mode", ["mass", "localize", "joint", "track"])
@pytest.mark.parametrize("scheme", ["iscat", "darkfield"])
def test_every_mode_and_scheme_makes_a_page(mode: str, scheme: str) -> None:
    analysis = make_analysis(60, mode, scheme=scheme, side=16)
    page = render_report(analysis)
    assert f"mode {mode}" in page
    shown = len(counted(analysis.table)) if analysis.tracks is None else len(analysis.tracks)
    assert len(payload(page)["images"]) == shown
    assert ">nan" not in page
    for status in set(analysis.table["status"]):
        assert Status(status).value in page


@pytest.mark.parametrize(("n", "mode"), [(0, "mass"), (0, "track"), (1, "joint"), (1, "track")])
def test_none_and_one_event_make_a_folder(tmp_path: Path, n: int, mode: str) -> None:
    analysis = make_analysis(1, mode)
    out = write_report(analysis if n else without_events(analysis), tmp_path / "out")
    page = (out / "report.html").read_text(encoding="utf-8")
    assert ("Nothing was found" in page) == (n == 0)


def test_everything_missing_still_makes_a_folder(tmp_path: Path) -> None:
    analysis = make_analysis(3)
    table = analysis.table.copy()
    table[list(EVENT_COLUMNS[4:-2])] = np.nan
    nothing = np.full((8, 8), np.nan)
    views = [replace(v, contrast=nothing, model=nothing, residual=nothing) for v in analysis.views]
    light = {"power": np.full(5, np.nan), "power_frames": np.arange(5)}
    bare = replace(analysis, table=table, ratio_image=nothing, views=tuple(views), **light)
    assert (write_report(bare, tmp_path / "out") / "report.html").exists()


def test_the_page_of_10000_events_stays_below_3_mb_and_says_what_it_leaves_out() -> None:
    small = with_traces(make_analysis(10))
    many = replace(
        small,
        table=pd.concat([small.table] * 1000, ignore_index=True).assign(event=np.arange(10_000)),
        views=tuple(replace(small.views[i % 10], event=i) for i in range(10_000)),
    )
    page = render_report(many)
    assert len(page.encode()) < 3_000_000
    held = payload(page)
    assert len(held["datasets"]["events"]["event"]) == 10_000
    assert len(held["images"]) > 20
    assert f"images of the first {len(held['images'])} of 10000 are in this page" in page


def with_flagged(analysis: Analysis, flagged: int) -> Analysis:
    """Flag the first rows, and give those alone absurd masses."""
    table = analysis.table.assign(status="ok", flags="")
    table.loc[table.index[:flagged], ["status", "mass_kda", "contrast"]] = ["poor_fit", 9e9, 9e9]
    return replace(analysis, table=table)


@pytest.mark.parametrize(("flagged", "silent"), [(0, False), (8, False), (9, True), (40, True)])
def test_no_headline_when_more_than_a_fifth_is_flagged(flagged: int, silent: bool) -> None:
    analysis = with_flagged(make_analysis(40), flagged)
    said = spoken(analysis)
    first = " ".join([*said.cautions, *said.facts])
    assert first.startswith(f"{flagged} of 40 events are flagged") == silent
    assert ("the rest is no fair sample" in first) == (silent and flagged < 40)
    assert ("Mass 6" in first) != silent
    page = render_report(analysis)
    assert ("not alike" in page) != silent
    assert ("No answer is given" in page) == silent
    assert (Status.POOR_FIT.advice in first) == silent
    assert "×10⁹" not in first
    alone = spoken(with_flagged(make_analysis(1), 1))
    assert alone.cautions[0].startswith("The only event is flagged. The")


def test_species_are_shown_for_fair_samples_only() -> None:
    table = make_analysis(40).table
    found = describe(
        table["mass_kda"].to_numpy(), table["sigma_mass_kda"].to_numpy(), seed=1
    ).to_dict()
    for flagged, scale in ((0, "calibration"), (0, "absolute model"), (20, "calibration")):
        analysis = with_flagged(make_analysis(40), flagged)
        summary = {**analysis.summary, "distribution": found, "mass_scale": scale}
        page = render_report(replace(analysis, summary=summary))
        assert ("<tr data-species" in page) == (flagged == 0)
        assert ("Not calibrated" in page) == (scale == "absolute model")


@pytest.mark.parametrize("scale", ["calibration", "absolute model"])
def test_several_species_are_one_answer_everywhere_and_have_no_median(
    tmp_path: Path, scale: str
) -> None:
    analysis = with_flagged(make_analysis(60), 0)
    found = describe(
        *(analysis.table[name].to_numpy() for name in ("mass_kda", "sigma_mass_kda")), seed=1
    ).to_dict()
    masses = [s["mass_kda"] for s in found["species"] if not s["outlier"]]
    assert len(masses) == 3
    summary = {**analysis.summary, "distribution": found, "mass_scale": scale}
    analysis = replace(analysis, summary=summary)
    out = write_report(analysis, tmp_path / "result.iscat")
    factor, quantity, unit = 1.0, "mass", " kDa"
    if scale != "calibration":
        factor, quantity, unit = 3.1e-5, "contrast", ""
    values = " · ".join(number(factor * mass) for mass in masses)
    answer = f"Species of {quantity} {values}{unit}"
    page = (out / "report.html").read_text(encoding="utf-8")
    shown = repr(Result(analysis)), repr(open_result(out))
    assert page.count("<tr data-species") == 3
    assert answer in answer_in(out)
    for text in shown:
        assert f"{quantity} ± σ{unit and ' [kDa]'}" in text
        listed = [float(line.split()[0]) for line in text.splitlines()[2:5]]
        assert listed == pytest.approx([factor * mass for mass in masses], rel=0.01)
    for text in (page, *shown):
        assert "Median mass" not in text
        assert "Median contrast" not in text
    one = {**found, "species": found["species"][:1]}
    alone = replace(analysis, summary={**summary, "distribution": one})
    (only,) = answers(alone, alone.table)
    assert only.label == f"Median {quantity}"


@pytest.mark.parametrize(("spread", "said"), [(0.5, "Mass 50.0 to 150"), (0.03, "Median mass 100")])
def test_few_events_that_are_not_alike_have_no_median(spread: float, said: str) -> None:
    analysis = make_analysis(5)
    mass = 100 * (1 + spread * np.array([-1, 1, 0, -1, 1]))
    table = analysis.table.assign(mass_kda=mass, sigma_mass_kda=2.0, status="ok")
    few = describe(mass, np.full(5, 2.0), seed=1).to_dict()
    summary = {**analysis.summary, "distribution": few, "mass_scale": "calibration"}
    (only,) = answers(replace(analysis, table=table, summary=summary), table)
    assert only.text.startswith(said)


def test_side_lobes_are_no_events() -> None:
    """Thirty of forty rows are side lobes with absurd masses: ten events remain, and all count."""
    analysis = with_flagged(make_analysis(40), 30)
    sides = analysis.table.replace({"status": {"poor_fit": "sidelobe"}})
    shown = repr(Result(replace(analysis, table=sides)))
    assert "×10⁹" not in shown
    assert shown.startswith("Result: 10 events in ")
    assert "10 events: 10 ok; further rows, which are no events: 30 sidelobe." in shown
    assert tally(sides) == (10, {"ok": 10}, {"sidelobe": 30})


def test_without_calibration_the_headline_is_a_contrast() -> None:
    analysis = make_analysis(40)
    bare = replace(analysis, summary={**analysis.summary, "mass_scale": "absolute model"})
    assert not spoken(analysis).cautions
    said = spoken(bare)
    assert said.cautions == [f"{NOT_A_MASS().text}."]
    assert said.facts[0].startswith("Contrast 0.00")
    assert "kDa" not in said.facts[0]
    page = render_report(bare)
    assert "kDa" not in re.sub(
        r"<script.*?</script>|<code>.*?</code>|<pre.*?</pre>", "", page, flags=re.S
    )
    assert "iscat calibrate mass" in page


def test_optional_columns_stand_beside_sigma() -> None:
    analysis = make_analysis(40)
    table = analysis.table.assign(systematic_mass_kda=7.0, repeat_mass_kda=np.nan, track=1)
    page = render_report(replace(analysis, table=table))
    heads = [column["heading"] for column in payload(page)["table"]]
    at = heads.index("σ [kDa]")
    assert heads[at + 1] == "systematic [kDa]"
    assert "repeats [kDa]" not in heads
    assert "systematic [kDa]" not in str(payload(render_report(analysis))["table"])
    shared = ", common to all events 7.00"
    assert shared in repr(Result(replace(analysis, table=table)))
    assert shared not in repr(Result(analysis))


def test_precision_counts_only_events_that_are_ok() -> None:
    analysis = make_analysis(40)
    table = event_table(analysis)
    table["sigma_mass_kda"], table["crb_mass_kda"], table["qcrb_mass_kda"] = 3.0, 2.0, 1.0
    table.loc[table["status"] != "ok", "sigma_mass_kda"] = 1e9
    found = precision_of(analysis, table, "mass_kda")
    assert found.events == (table["status"] == "ok").sum()
    assert (found.sigma, found.over_crb, found.information) == (3.0, 1.5, 0.25)


def test_a_table_has_flags_and_statuses_as_text_and_all_columns() -> None:
    analysis = make_analysis(2)
    table = analysis.table.copy()
    table["status"] = [Status.OK, Status.AT_BOUND]
    table["flags"] = [(), (Status.AT_BOUND, "masked_pixels")]
    out = event_table(replace(analysis, table=table))
    assert out["status"].tolist() == ["ok", "at_bound"]
    assert out["flags"].tolist() == ["", "at_bound;masked_pixels"]
    with pytest.raises(ValueError, match="snr"):
        event_table(replace(analysis, table=analysis.table.drop(columns="snr")))


def test_jsonable_has_no_numpy_and_no_nan() -> None:
    value = {"a": np.float32(1.5), 2: [np.nan, np.inf, np.bool_(True)], "p": Path("x"), "n": None}
    expected = {"a": 1.5, "2": [None, None, True], "p": "x", "n": None}
    assert jsonable(value) == expected


def test_shades_hold_the_probability_they_promise() -> None:
    counts = np.random.default_rng(8).poisson(3.0, (30, 30)).astype(float)
    shades = credible_shades(counts)
    for inside, level in enumerate(CREDIBLE_LEVELS, start=1):
        share = counts[shades >= inside].sum() / counts.sum()
        assert level <= share <= level + counts.max() / counts.sum()


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (1234.5, "1234"), (-0.01234, "−0.0123"), (2.5e-7, "2.50×10⁻⁷"), (None, "—")],
)
def test_numbers_are_written_for_people(value: float | None, text: str) -> None:
    assert number(value) == text


def test_documents_escape_what_they_are_given_and_need_a_title() -> None:
    columns = worded("a", 0), numeric("b", 1)
    hostile = {"noise": {"frames": [1], "ratio": ["</script><b>"]}}
    section = Section(
        "one",
        "One",
        notes=["a < b"],
        charts=[Chart("c", figure=figure("noise", hostile))],
        tables=[tabulate([["<i>", np.nan], ["x", -1.25]], columns, "t")],
    )
    page = render_document("Bounds & <friends>", "", [section])
    assert "Bounds &amp; &lt;friends&gt;" in page
    assert "<i>" not in page
    assert "−1.25" in page
    assert page.count("</script>") == page.count("<script")
    with pytest.raises(jinja2.UndefinedError, match="title"):
        render_page("document.html", {"sections": []})


@pytest.mark.parametrize("shape", [(64, 64), (128, 512), (20, 1000), (1000, 20)])
def test_no_field_is_drawn_as_a_line(shape: tuple[int, int]) -> None:
    analysis = replace(make_analysis(3), ratio_image=np.zeros(shape))
    spec = movie_figures(analysis)["field"].specification
    assert min(spec["width"], spec["height"]) >= 60
    assert max(spec["width"], spec["height"]) <= PICTURE_PX
    across = spec["layer"][0]["encoding"]["x"]["scale"]["domain"]
    assert across == [-0.5, shape[1] - 0.5]


def test_the_histogram_keeps_species_apart() -> None:
    """A bin is about two standard deviations wide, a round number, and holds every event."""
    spread, far = np.full(30, 6.0), np.linspace(0.0, 1000.0, 30)
    assert bin_width(far, spread) == 10.0
    assert bin_width(far / 200, spread) == 1.0  # a sixth of all
    assert bin_width(100 * far, spread) == 1000.0  # a ninetieth
    assert bin_width(far, np.array([])) == 100.0
    analysis = make_analysis(60)
    bars = movie_figures(analysis)["masses"].data["bars"]
    assert sum(bars["count"]) == len(counted(analysis.table)) < 60
    assert set(bars["part"]) == {"ok", "flagged"}


@pytest.mark.parametrize(
    ("further", "words"),
    [
        ((), "Too few are isolated"),
        (
            (-0.01, 0.02, 1.02, 0.1),
            "off by −1.0 ± 2.0 %, and their spread is 1.02 ± 0.10 times the bound",
        ),
    ],
)
def test_what_was_injected_is_told(further: tuple[float, ...], words: str) -> None:
    names = ("bias_rel", "bias_rel_se", "spread_over_crb", "spread_over_crb_se")
    added = {"stay_frames": 120, "added": 20, "recovered": 19}
    (line,) = measured_lines({"injection": {**added, **dict(zip(names, further, strict=False))}})
    assert line.startswith("Of 20 landings and leavings added to the movie, 19 were found again.")
    assert "Every particle stayed at least 120 frames." in line
    assert words in line


def test_bounds_of_a_diameter_have_its_unit() -> None:
    """Holevo's bound is known of the mass alone."""
    analysis = make_analysis(40, "joint")
    table = analysis.table.assign(status="ok")
    for kind in ("sigma", "crb", "qcrb"):
        table[f"{kind}_diameter_nm"] = table[f"{kind}_mass_kda"] / 50
    medians = {"holevo_median": 3.0, "information_fraction_median": 0.5}
    precision = {**analysis.summary.get("precision", {}), "mass_kda": medians}
    sized = replace(analysis, mode="size", table=table.assign(diameter_nm=100.0))
    sample = Sample(replace(sized, summary={**analysis.summary, "precision": precision}))
    whole, found = (one.precision_of("mass_kda") for one in (Sample(analysis), sample))
    assert sample.parameter("mass_kda") == "diameter [nm]"
    assert found.holevo == pytest.approx(3.0 / 50)
    assert found.crb == pytest.approx(whole.crb / 50, rel=0.05)


def test_an_interrupted_run_says_so_on_its_first_screen() -> None:
    analysis = make_analysis(20)
    page = render_report(replace(analysis, summary={**analysis.summary, "interrupted": True}))
    first = re.search(r'<ul class="trust".*?</ul>', page, re.DOTALL)
    assert first is not None
    assert "The analysis was interrupted" in first[0]
    assert "interrupted" not in render_report(analysis)
