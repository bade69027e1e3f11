"""The report in a real browser: it runs without errors, reacts, fits the screen and can be read."""

from __future__ import annotations

import base64
import json
import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import tifffile

from iscat_analysis.bounds import paper
from iscat_analysis.records import EVENT_COLUMNS
from iscat_analysis.report import render_report
from iscat_analysis.report.numbers import Fact, numeric, tabulate, worded
from iscat_analysis.report.page import Chart, Section, render_document
from iscat_analysis.report.vega import figure
from iscat_cli import main

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from batch_factory import make_batch_page
from browsers import BROWSER, DRIVER, open_browser
from report_factory import make_analysis, without_events

pytestmark = pytest.mark.skipif(
    BROWSER is None or DRIVER is None,
    reason="needs the programs chromium and chromedriver (Debian: chromium, chromium-driver)",
)
selenium = pytest.importorskip("selenium", reason="needs the Python package selenium")

AA_NORMAL, AA_LARGE = 4.5, 3.0
"""Least contrast of text and of large text (WCAG 2.1, criterion 1.4.3)."""

POOR_CONTRAST = """
const parse = (text) => {
  const v = text.match(/[\\d.]+/g).map(Number);
  return [v[0], v[1], v[2], v.length > 3 ? v[3] : 1];
};
const over = (top, below) => [0, 1, 2].map((i) => top[i] * top[3] + below[i] * (1 - top[3]));
const linear = (c) => (c / 255 <= 0.04045 ? c / 255 / 12.92 : ((c / 255 + 0.055) / 1.055) ** 2.4);
const luminance = (c) => 0.2126 * linear(c[0]) + 0.7152 * linear(c[1]) + 0.0722 * linear(c[2]);
const ground = (node) => {
  const layers = [];
  for (let n = node; n; n = n.parentElement) {
    layers.push(parse(getComputedStyle(n).backgroundColor));
  }
  return layers.reverse().reduce((below, layer) => over(layer, below), [255, 255, 255]);
};
const poor = [];
let seen = 0;
const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
while (walker.nextNode()) {
  const node = walker.currentNode.parentElement;
  const text = walker.currentNode.textContent.trim().slice(0, 40);
  if (!text || node.closest("script, style, noscript, .halo")) continue;
  if (!node.getClientRects().length) continue;
  const style = getComputedStyle(node);
  const back = ground(node);
  const ink = node instanceof SVGElement ? style.fill : style.color;
  const [a, b] = [luminance(over(parse(ink), back)), luminance(back)].sort((p, q) => q - p);
  const size = parseFloat(style.fontSize);
  const large = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700);
  const ratio = (a + 0.05) / (b + 0.05);
  seen += 1;
  const least = large ? arguments[1] : arguments[0];
  if (ratio < least) poor.push([ratio.toFixed(2), node.tagName, text]);
}
return [seen, poor];
"""

OVERLAPS = """
const poor = [];
for (const svg of document.querySelectorAll(".plot svg")) {
  const boxes = [...svg.querySelectorAll("text")].filter((t) => t.textContent.trim())
    .map((t) => [t.getBoundingClientRect(), t.textContent]);
  boxes.forEach(([a, text], i) => boxes.slice(i + 1).forEach(([b, other]) => {
    const w = Math.min(a.right, b.right) - Math.max(a.left, b.left);
    const h = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
    if (w > 1 && h > 4) poor.push([svg.closest("[data-figure]")?.dataset.figure, text, other]);
  }));
}
return poor;
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    profile = tmp_path_factory.mktemp("profile")
    with open_browser(profile, "--hide-scrollbars", logs={"browser": "ALL"}) as driver:
        yield driver


@pytest.fixture(scope="module")
def written(
    tmp_path_factory: pytest.TempPathFactory, sample_configs: dict[str, Path]
) -> dict[str, Path]:
    """Let the commands write every kind of page, from small jobs."""
    folder = tmp_path_factory.mktemp("written")
    movie, shade, landing = (folder / f"{name}.tif" for name in ("movie", "dark", "landing"))
    few = ["--config", str(sample_configs["landing"]), "--set", "simulation.count=6"]
    few += ["--set", "simulation.frames=300", "--set", "simulation.shape=[80, 80]"]
    dark = 4 * np.random.default_rng(1).standard_normal((60, 64, 64))
    tifffile.imwrite(shade, np.rint(100 + dark).astype("uint16"))
    mass = np.random.default_rng(1).normal(np.repeat([66.0, 146.0, 480.0], 60), 8.0)
    table = pd.DataFrame(0.0, index=range(mass.size), columns=list(EVENT_COLUMNS))
    table = table.assign(mass_kda=mass, sigma_mass_kda=8.0, contrast=-3.1e-5 * mass, status="ok")
    table.to_csv(folder / "fits.csv", index=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper, "HEIGHTS_NM", np.linspace(0.0, 1000.0, 3))
        patch.setattr(paper, "FOCI_NM", np.linspace(-1000.0, 1000.0, 3))
        for arguments in (
            ["simulate", *few, "--out", str(landing)],
            ["fit", str(landing), *few, "--inject", "2", "--out", str(folder / "landing")],
            ["calibrate", "mass", str(folder / "fits.csv"),
             "--standards", "66,146,480", "--out", str(folder / "line")],
            ["simulate", "--config", str(sample_configs["mass"]), "--out", str(movie),
             "--set", "camera.offset_adu=100", "--set", "simulation.shape=[64, 64]",
             "--set", "simulation.frames=200", "--set", "simulation.events=[]"],
            ["calibrate", "camera", str(movie), "--dark", str(shade),
             "--out", str(folder / "camera")],
            ["benchmark", "--config", str(sample_configs["joint"]), "--trials", "20",
             "--set", "fit.roi_nm=900", "--set", "fit.z_range_nm=[0,300]",
             "--no-posterior", "--out", str(folder / "study")],
            ["bounds", "--preset", "dong2021", "--out", str(folder / "paper")],
        ):  # fmt: skip
            assert main([*arguments, "--quiet"]) == 0, arguments
    return {
        "landing": folder / "landing" / "report.html",
        "calibration": folder / "line" / "calibration.html",
        "camera": folder / "camera" / "camera.html",
        "benchmark": folder / "study" / "benchmark.html",
        "comparison": folder / "paper" / "comparison.html",
    }


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory, written: dict[str, Path]) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    analyses = {
        "mass": make_analysis(60, "mass", posteriors=2, refused=1),
        "joint": make_analysis(30, "joint", posteriors=1),
        "localize": make_analysis(12, "localize"),
        "track": make_analysis(30, "track"),
        "darkfield": make_analysis(12, "mass", scheme="darkfield"),
        "none": without_events(make_analysis(1)),
        "one": make_analysis(1),
    }
    texts = {name: render_report(analysis) for name, analysis in analyses.items()}
    texts |= {f"batch_{n}": make_batch_page(n) for n in (1, 3, 60)}
    texts["document"] = render_document("Bounds along z", "", [SCAN])
    found = dict(written)
    for name, text in texts.items():
        found[name] = folder / f"{name}.html"
        found[name].write_text(text, encoding="utf-8")
    return found


SCAN = Section(
    "scan",
    "Scan",
    "A figure and a table.",
    [Fact("trials", "1000", note="per mode")],
    [
        Chart(
            "noise", figure=figure("noise", {"noise": {"frames": [1, 2, 4], "ratio": [1, 1.2, 2]}})
        )
    ],
    [
        tabulate(
            [("x", 3.0), ("y", 10.0), ("z", float("nan")), ("mass", 2.0)],
            (worded("of", 0), numeric("σ", 1)),
            "Numbers",
        )
    ],
)


READY = """
const [address, done] = arguments;
const look = () => {
  const there = location.href.startsWith(address) && document.readyState === "complete";
  return there ? done() : setTimeout(look, 20);
};
look();
"""
"""Waits for all of a page: a busy browser may still have the one before, or a part of it."""


def prefer(browser: Any, scheme: str) -> None:
    feature = {"name": "prefers-color-scheme", "value": scheme}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})


def show(browser: Any, page: Path, *, width: int = 1440, scheme: str = "light") -> None:
    prefer(browser, scheme)
    metrics = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    errors(browser)
    browser.get(page.as_uri())
    browser.execute_async_script(READY, page.as_uri())


def texts(browser: Any, selector: str) -> list[str]:
    """Texts of all that a selector finds."""
    script = "return [...document.querySelectorAll(arguments[0])].map((n) => n.textContent)"
    return list(browser.execute_script(script, selector))


def errors(browser: Any) -> list[str]:
    return [entry["message"] for entry in browser.get_log("browser")]


def drawn(browser: Any) -> dict[str, int]:
    """Open every part, draw each figure, and count its marks."""
    script = """
    const done = arguments[0];
    document.querySelectorAll("details").forEach((part) => { part.open = true; });
    const count = (node) => node.querySelector("canvas") ? 2
      : node.querySelectorAll("svg path, svg image").length;
    requestAnimationFrame(() => requestAnimationFrame(() => iscat.drawAll().then(() => done(
      Object.fromEntries([...document.querySelectorAll("[data-figure]")].map((node) =>
        [node.dataset.figure, count(node)]))))));
    """
    return dict(browser.execute_async_script(script))


def first_cells(browser: Any, column: int) -> list[str]:
    return texts(browser, f"#table tbody tr > :nth-child({column + 1})")


def click(browser: Any, selector: str) -> None:
    browser.execute_script("document.querySelector(arguments[0]).click()", selector)


REPORTS = ("mass", "joint", "localize", "track", "darkfield", "one", "none", "landing")
WRITTEN = ("document", "calibration", "camera", "benchmark", "comparison")
NAMES = (*REPORTS, *WRITTEN, "batch_1", "batch_3", "batch_60")


@pytest.mark.parametrize("name", NAMES)
def test_fits_the_screen_without_errors_and_can_be_read(
    browser: Any, pages: dict[str, Path], name: str
) -> None:
    for width in (390, 1440):
        show(browser, pages[name], width=width)
        assert all(marks > 1 for marks in drawn(browser).values())
        widths = browser.execute_script(
            "return [document.documentElement.scrollWidth, document.documentElement.clientWidth]"
        )
        assert widths[0] <= widths[1] == width
        assert browser.execute_script(OVERLAPS) == []
        assert errors(browser) == []
    for scheme in ("light", "dark"):
        prefer(browser, scheme)
        drawn(browser)
        seen, poor = browser.execute_script(POOR_CONTRAST, AA_NORMAL, AA_LARGE)
        assert seen > 20
        assert poor == [], scheme


def test_the_toggle_overrides_the_system(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["one"], scheme="light")
    ground = "return getComputedStyle(document.body).backgroundColor"
    before = browser.execute_script(ground)
    click(browser, "[data-theme-toggle]")
    assert browser.execute_script(ground) != before
    click(browser, "[data-theme-toggle]")
    assert browser.execute_script(ground) == before
    browser.execute_script("localStorage.clear()")  # what was chosen holds for other pages too


def column(browser: Any, heading: str) -> int:
    return texts(browser, "#table th").index(heading)


def value(text: str) -> float:
    return float(text.replace("−", "-"))


def test_columns_sort_both_ways(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["mass"])
    for heading in ("SNR", "mass [kDa]"):
        at = column(browser, heading)
        head = f"#table th:nth-child({at + 1})"
        seen = []
        for order in ("ascending", "descending"):
            click(browser, f"{head} button")
            sort = "return document.querySelector(arguments[0]).getAttribute('aria-sort')"
            assert browser.execute_script(sort, head) == order
            seen.append([value(text) for text in first_cells(browser, at)])
        rising, falling = seen
        assert rising == sorted(rising)
        assert falling == sorted(falling, reverse=True)
        assert falling[0] > rising[0]


def test_the_keyboard_sorts_opens_and_walks(browser: Any, pages: dict[str, Path]) -> None:
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    show(browser, pages["mass"])
    browser.find_element(By.CSS_SELECTOR, "#table th:nth-child(2) button").send_keys(Keys.ENTER)
    frames = [value(text) for text in first_cells(browser, 1)]
    assert frames == sorted(frames)
    seen = first_cells(browser, 0)
    browser.find_element(By.CSS_SELECTOR, "#table tbody tr:nth-child(2) .toggle").send_keys(
        Keys.SPACE
    )
    titles = []
    for key in (Keys.ARROW_RIGHT, Keys.ARROW_LEFT, Keys.ARROW_LEFT):
        titles += texts(browser, "#particle-title")
        browser.switch_to.active_element.send_keys(key)
    titles += texts(browser, "#particle-title")
    assert titles == [f"event {seen[k]}" for k in (1, 2, 1, 0)]
    browser.switch_to.active_element.send_keys(Keys.ESCAPE)
    assert browser.execute_script("return document.getElementById('particle').hidden")


@pytest.mark.parametrize("name", ["mass", "joint", "landing"])
def test_the_numbers_of_a_column_line_up(browser: Any, pages: dict[str, Path], name: str) -> None:
    show(browser, pages[name])
    for place, head in list(enumerate(texts(browser, "#table th")))[2:-1]:
        cells = first_cells(browser, place)
        decimals = {
            len(text.partition(".")[2]) for text in cells if text != "—" and "×" not in text
        }
        assert len(decimals) == 1, (head, cells)


def test_a_landing_movie_shows_its_noise_curve(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["landing"])
    assert "noise" in drawn(browser)
    (text,) = texts(browser, "#diagnostics")
    assert "variance over shot noise" in text
    for said in ("Windows of", "Drift of the fixed pattern", "added to the movie"):
        assert said in text


FILTER = """
const [text, done] = arguments, input = document.getElementById("filter");
input.value = text;
input.dispatchEvent(new Event("input"));
requestAnimationFrame(() => requestAnimationFrame(() =>
  done(document.getElementById("count").textContent)));
"""


def test_the_filter_marks_what_it_finds_and_clears(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["mass"])
    rows = browser.execute_script("return iscat.held.rows")
    said = browser.execute_async_script(FILTER, "poor_fit")
    kept = first_cells(browser, column(browser, "status"))
    assert kept
    assert all(text.startswith("poor_fit") for text in kept)
    assert said == f"· {len(kept)} of {rows}"
    marked = "return iscat.rows('events').filter((e) => e.marked).length"
    assert browser.execute_script(marked) == len(kept)
    assert browser.execute_async_script(FILTER, "no such flag") == f"· 0 of {rows}"
    assert browser.execute_async_script(FILTER, "") == f"· {rows}"


MARK = """
const [range, done] = arguments;
const view = iscat.views.get("masses");
view.signal("brush_x", range.map((x) => view.scale("x")(x))).runAsync()
  .then(() => setTimeout(() => done({
    said: document.getElementById("selected").textContent,
    field: iscat.views.get("field").data("events").filter((e) => e.marked).map((e) => e.event),
    time: iscat.views.get("time").data("events").filter((e) => e.marked).map((e) => e.event),
    bars: view.data("bars").filter((bar) => bar.part === "marked").map((bar) => bar.count),
  }), 300));
"""


def test_a_selection_marks_the_same_particles_everywhere(
    browser: Any, pages: dict[str, Path]
) -> None:
    show(browser, pages["mass"])
    drawn(browser)
    found = browser.execute_async_script(MARK, [100, 200])
    table = make_analysis(60, "mass", posteriors=2, refused=1).table
    inside = table[table["mass_kda"].abs().between(100, 200) & (table["status"] != "sidelobe")]
    expected = inside["event"].tolist()
    assert found["field"] == found["time"] == expected
    assert sum(found["bars"]) == len(expected)
    assert found["said"].startswith(f"{len(expected)} of ")
    assert sorted(map(int, first_cells(browser, 0))) == expected
    click(browser, "#clear")
    everything = browser.execute_async_script(
        "const done = arguments[0]; setTimeout(() => done("
        "iscat.views.get('field').data('events').every((e) => e.marked)), 300)"
    )
    assert everything


def test_gates_and_rejections_are_saved_as_a_selection(
    browser: Any, pages: dict[str, Path]
) -> None:
    show(browser, pages["mass"])
    drawn(browser)
    browser.execute_async_script(MARK, [100, 200])
    click(browser, "#gate")
    click(browser, "#table tbody tr .toggle")
    first = int(first_cells(browser, 0)[0])
    click(browser, "#reject")
    saved = browser.execute_async_script(
        "const done = arguments[0];"
        "URL.createObjectURL = (blob) => { blob.text().then(done); return '#'; };"
        "document.getElementById('save-selection').click();"
    )
    selection = json.loads(saved)
    assert selection["gates"][0] == pytest.approx([100, 200])
    assert [row["event"] for row in selection["rejected"]] == [first]


def test_the_bins_have_any_width_and_hold_every_particle(
    browser: Any, pages: dict[str, Path]
) -> None:
    show(browser, pages["mass"])
    drawn(browser)
    counts = browser.execute_async_script(
        "const done = arguments[0], slider = document.getElementById('bin'), found = [];"
        "const look = () => found.push(iscat.views.get('masses').data('bars')"
        ".reduce((sum, bar) => sum + bar.count, 0));"
        "const next = (place) => { if (place > 12) return done(found); slider.value = place;"
        "slider.dispatchEvent(new Event('input'));"
        "setTimeout(() => { look(); next(place + 3); }, 100); };"
        "next(0);"
    )
    assert set(counts) == {browser.execute_script("return iscat.held.rows")}


def test_a_row_opens_its_particle(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["landing"])
    click(browser, "#row-1 .toggle")
    width = "return document.querySelector('#particle img.strip').decode().then(() => "
    width += "document.querySelector('#particle img.strip').naturalWidth)"
    assert browser.execute_script(width) == 3 * 32 + 4
    marks = browser.execute_async_script(
        "const done = arguments[0]; const look = () => { const n = "
        "document.querySelectorAll('#particle svg path').length;"
        "n ? done(n) : setTimeout(look, 30); }; look();"
    )
    assert marks > 3
    (text,) = texts(browser, "#particle")
    for said in ("residual ±", "The fit converged", "the fitted step, at frame", "frames over the"):
        assert said in text
    film = browser.execute_script(
        "const box = document.querySelector('.clip'), image = box.firstElementChild;"
        "return image.decode().then(() => [image.naturalWidth, image.naturalHeight % 21,"
        " getComputedStyle(image).animationName, image.getAnimations()[0].playState])"
    )
    assert film == [21, 0, "slide", "running"]


def test_the_answer_is_on_the_first_screen(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["mass"])
    metrics = {"width": 1366, "height": 768, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    drawn(browser)
    bottoms = browser.execute_script(
        "scrollTo(0, 0); return ['[data-figure=masses]', '.trust', '.controls'].map("
        "(s) => document.querySelector(s).getBoundingClientRect().bottom)"
    )
    assert max(bottoms) <= 768
    assert 2 <= len(texts(browser, ".trust li")) <= 4


def test_who_wants_no_motion_sees_the_step_alone(browser: Any, pages: dict[str, Path]) -> None:
    feature = {"name": "prefers-reduced-motion", "value": "reduce"}
    show(browser, pages["landing"])
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
    browser.refresh()
    browser.execute_async_script(READY, pages["landing"].as_uri())
    click(browser, "#row-0 .toggle")
    seen = (
        "const image = document.querySelector('.clip img');"
        "return image.decode().then(() => [getComputedStyle(image).animationName,"
        " image.getBoundingClientRect().top < document.querySelector('.clip')"
        ".getBoundingClientRect().top - 1])"
    )
    assert browser.execute_script(seen) == ["none", True]


def test_posteriors_are_drawn_and_refused_ones_say_why(
    browser: Any, pages: dict[str, Path]
) -> None:
    show(browser, pages["mass"])
    assert "split R-hat of z_nm is 1.31" in texts(browser, "#posterior")[0]
    assert {"corner_0001", "corner_0002"} <= set(drawn(browser))


def test_figures_follow_the_theme(browser: Any, pages: dict[str, Path]) -> None:
    colors = []
    for scheme in ("light", "dark"):
        show(browser, pages["document"], scheme=scheme)
        drawn(browser)
        script = "return getComputedStyle(document.querySelector('.plot svg text')).fill"
        colors.append(browser.execute_script(script))
    assert colors[0] != colors[1]


def test_tables_of_documents_sort(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["document"])
    click(browser, "table.sortable th:nth-child(2) button")
    names = texts(browser, "tbody tr > :first-child")
    assert names == ["mass", "x", "y", "z"]  # the missing one last


@pytest.mark.parametrize("name", ["calibration", "benchmark", "comparison"])
def test_written_tables_sort(browser: Any, pages: dict[str, Path], name: str) -> None:
    show(browser, pages[name])
    found = browser.execute_script(
        "return [...document.querySelectorAll('table.sortable')].map((table) => {"
        "  const cells = (n) => [...table.tBodies[0].rows].map((row) => row.cells[n].textContent);"
        "  const last = table.tHead.rows[0].cells.length - 1;"
        "  const seen = [];"
        "  for (let n = 0; n < 2; n++) {"
        "    table.tHead.rows[0].cells[last].querySelector('button').click();"
        "    seen.push(cells(last));"
        "  } return seen; })"
    )
    assert found
    for rising, falling in found:
        assert sorted(rising) == sorted(falling)
        if len(set(rising)) > 1:
            assert rising != falling


def test_a_batch_sorts_narrows_and_links(browser: Any, pages: dict[str, Path]) -> None:
    def cells(column: int) -> list[str]:
        return texts(browser, f"#quality tbody tr:not([hidden]) > :nth-child({column + 1})")

    show(browser, pages["batch_60"])
    at = texts(browser, "#quality th").index("events")
    click(browser, f"#quality table th:nth-child({at + 1}) button")
    counts = [value(text) for text in cells(at)]
    assert counts == sorted(counts)
    assert len(counts) == 60
    browser.execute_script(
        "const input = document.querySelector('#quality .narrow input');"
        "input.value = 'cut short'; input.dispatchEvent(new Event('input'));"
    )
    assert cells(0) == ["day/pH 9/movie_59"]
    links, addresses = browser.execute_script(
        "return [[...document.querySelectorAll('#quality a')].map((a) => a.getAttribute('href')),"
        "[...document.querySelectorAll('[src], link')].map((e) => e.src || e.href)]"
    )
    assert len(links) == 59
    assert "movies/day/pH%206/movie_0.iscat/report.html" in links
    assert all(address.startswith("data:") for address in addresses)


def test_ten_thousand_particles_are_shown_in_pages(browser: Any, tmp_path: Path) -> None:
    page = tmp_path / "many.html"
    few = make_analysis(10)
    table = pd.concat([few.table] * 1000, ignore_index=True).assign(event=np.arange(10_000))
    page.write_text(render_report(replace(few, table=table)), encoding="utf-8")
    show(browser, page)
    assert drawn(browser)["field"] >= 1
    assert len(first_cells(browser, 0)) == 50
    click(browser, "[data-page='1']")
    assert first_cells(browser, 0)[0] == "50"
    browser.execute_async_script(FILTER, "9999")
    assert "9999" in first_cells(browser, 0)
    assert not errors(browser)


def test_the_answer_is_printed_on_two_sheets(browser: Any, pages: dict[str, Path]) -> None:
    for name in ("landing", "mass", "track"):
        show(browser, pages[name])
        browser.execute_async_script(
            "const done = arguments[0]; iscat.drawAll().then(() => done(1));"
        )
        printed = browser.execute_cdp_cmd(
            "Page.printToPDF", {"paperWidth": 8.27, "paperHeight": 11.69}
        )
        content = base64.b64decode(printed["data"])
        assert len(re.findall(rb"/Type\s*/Page[^s]", content)) == 2, name
