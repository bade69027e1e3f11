"""The report in a real browser: it runs without errors, reacts, fits the screen and can be read."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import tifffile
from matplotlib.figure import Figure

from iscat_analysis.bounds import paper
from iscat_analysis.records import EVENT_COLUMNS
from iscat_analysis.report import render_report
from iscat_analysis.report.numbers import Fact, numeric, tabulate, worded
from iscat_analysis.report.page import Chart, Section, render_document
from iscat_analysis.report.style import BLUE, VERMILLION, new_figure, publish
from iscat_cli import main

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from batch_factory import make_batch_page
from browsers import BROWSER, DRIVER, open_browser
from report_factory import make_analysis, without_events
from sketches import PAGES

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
    if (w > 1 && h > 4) poor.push([svg.getAttribute("aria-label"), text, other]);
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
        for module in PAGES:  # no files of figures, which no page shows
            patch.setattr(module, "publish", lambda figures, *_, **__: publish(figures))
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


def lines() -> Iterator[tuple[str, Figure]]:
    """Draw a figure for a page, with a gap where a value is missing."""
    figure = new_figure(6.0, 3.0)
    axes = figure.add_subplot()
    axes.plot([0, 100, 200], [3.0, np.nan, 5.0], "o", color=VERMILLION, label="achieved")
    axes.plot([0, 100, 200], [1.0, 1.1, 1.2], color=BLUE, label="bound")
    axes.legend()
    yield "lines", figure


SCAN = Section(
    "scan",
    "Scan",
    "A figure and a table.",
    [Fact("trials", "1000", note="per mode")],
    [Chart("lines", "Lines", publish(lines())["lines"])],
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


def first_cells(browser: Any, column: int) -> list[str]:
    return texts(browser, f"#table tbody tr[id]:not([hidden]) > :nth-child({column + 1})")


def click(browser: Any, selector: str) -> None:
    browser.execute_script("document.querySelector(arguments[0]).click()", selector)


def shown_rows(browser: Any, least: int = 0) -> int:
    """Rows of the table that take room, once there are so many, or twenty seconds have gone by."""
    script = """
    const [least, done] = arguments;
    const begun = performance.now();
    const look = () => {
      const rows = [...document.querySelectorAll("#table tbody tr[id]")];
      const shown = rows.filter((row) => row.getClientRects().length).length;
      if (shown >= least || performance.now() - begun > 20000) return done(shown);
      setTimeout(look, 20);
    };
    look();
    """
    return int(browser.execute_async_script(script, least))


REPORTS = ("mass", "joint", "localize", "track", "darkfield", "one", "none", "landing")
WRITTEN = ("document", "calibration", "camera", "benchmark", "comparison")
NAMES = (*REPORTS, *WRITTEN, "batch_1", "batch_3", "batch_60")


@pytest.mark.parametrize("name", NAMES)
def test_fits_the_screen_without_errors_and_can_be_read(
    browser: Any, pages: dict[str, Path], name: str
) -> None:
    for width in (390, 1440):
        show(browser, pages[name], width=width)
        browser.execute_script(
            "for (const row of document.querySelectorAll('#row-0, #row-1')) {"
            "  row.querySelector('.toggle').click(); }"
        )
        widths = browser.execute_script(
            "return [document.documentElement.scrollWidth, document.documentElement.clientWidth]"
        )
        assert widths[0] <= widths[1] == width
        assert browser.execute_script(OVERLAPS) == []
        assert errors(browser) == []
    for scheme in ("light", "dark"):
        prefer(browser, scheme)
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


def test_the_keyboard_sorts_filters_and_opens(browser: Any, pages: dict[str, Path]) -> None:
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    show(browser, pages["mass"])
    browser.find_element(By.CSS_SELECTOR, "#table th:nth-child(2) button").send_keys(Keys.ENTER)
    frames = [value(text) for text in first_cells(browser, 1)]
    assert frames == sorted(frames)
    browser.find_element(By.CSS_SELECTOR, "#row-1 .toggle").send_keys(Keys.SPACE)
    assert browser.execute_script("return document.querySelectorAll('.detail img').length") == 1
    for plot in browser.find_elements(By.CSS_SELECTOR, ".plot"):
        assert plot.get_attribute("tabindex") == "0"  # wide figures scroll with the arrow keys


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
    (figure,), (text,) = (texts(browser, f"#diagnostics{end}") for end in ("-figure", ""))
    assert "variance over shot noise" in figure
    for said in ("Windows of", "Drift of the fixed pattern", "added to the movie"):
        assert said in text


def test_the_filter_narrows_the_table_and_clears(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["mass"])
    set_value = (
        "const n = document.getElementById('filter'); n.value = arguments[0];"
        "n.dispatchEvent(new Event('input'));"
    )
    count = "return document.getElementById('count').textContent"
    browser.execute_script(set_value, "poor_fit")
    kept = first_cells(browser, column(browser, "status"))
    assert kept
    assert all(text.startswith("poor_fit") for text in kept)
    assert browser.execute_script(count) == f"{len(kept)} of 60 rows"
    browser.execute_script(set_value, "no such flag")
    assert browser.execute_script(count) == "0 of 60 rows"
    browser.execute_script(set_value, "")
    assert browser.execute_script(count) == "60 rows"


def test_a_row_opens_its_images(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["mass"])
    detail = "return document.querySelectorAll('#row-1 + .detail img').length"
    click(browser, "#row-1 .toggle")
    assert browser.execute_script(detail) == 1
    width = "return document.querySelector('.detail img').decode().then(() => "
    width += "document.querySelector('.detail img').naturalWidth)"
    assert browser.execute_script(width) == 3 * 32 + 4
    text = browser.execute_script("return document.querySelector('.detail').textContent")
    assert "residual ±" in text
    assert "The fit converged" in text
    click(browser, "#row-1 .toggle")
    assert browser.execute_script(detail) == 0


@pytest.mark.parametrize("width", [390, 1440])
def test_a_landing_shows_its_trace_and_its_clip(
    browser: Any, pages: dict[str, Path], width: int
) -> None:
    show(browser, pages["landing"], width=width)
    click(browser, "#row-1 .toggle")
    inside = (
        "const box = document.querySelector('.detail .trace').getBoundingClientRect();"
        "return [...document.querySelectorAll('.trace .step, .trace .means, .trace text')]"
        ".map((n) => n.getBoundingClientRect()).filter((b) => b.left < box.left - 1 ||"
        " b.right > box.right + 1 || b.top < box.top - 1 || b.bottom > box.bottom + 1).length"
    )
    assert browser.execute_script(inside) == 0
    font = (
        "const t = document.querySelector('.trace text');"
        "return parseFloat(getComputedStyle(t).fontSize) * t.getScreenCTM().a"
    )
    assert browser.execute_script(font) > 9
    film = (
        "const box = document.querySelector('.clip'), image = box.firstElementChild;"
        "return image.decode().then(() => [image.naturalWidth, image.naturalHeight % 21,"
        " Math.round(image.getBoundingClientRect().height / box.getBoundingClientRect().height),"
        " getComputedStyle(image).animationName, image.getAnimations()[0].playState])"
    )
    images = browser.execute_script(film)
    assert images[:2] == [21, 0]
    assert images[2] > 6
    assert images[3:] == ["slide", "running"]
    text = browser.execute_script("return document.querySelector('.story').textContent")
    assert "the fitted step, at frame" in text
    assert "frames over the" in text


def test_who_wants_no_motion_sees_the_step_alone(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["landing"])
    feature = {"name": "prefers-reduced-motion", "value": "reduce"}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
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
    drawn = "return [...document.querySelectorAll('#posterior figure')].map((f) => f.id)"
    assert browser.execute_script(drawn) == ["corner_0001", "corner_0002"]


@pytest.mark.parametrize("figure", ["overview", "timeline", "precision-figure"])
def test_every_point_tells_its_own_event(browser: Any, pages: dict[str, Path], figure: str) -> None:
    """Points and rows are matched by order alone, so every one of them is asked."""
    show(browser, pages["joint"])
    told = browser.execute_script(
        "return [...document.querySelectorAll(`#${arguments[0]} [id*='rows-'] use`)].map((use) => {"
        "  use.dispatchEvent(new MouseEvent('mouseover', {bubbles: true}));"
        "  const group = use.closest('[id*=rows-]');"
        "  return [group.id, [...group.querySelectorAll('use')].indexOf(use),"
        "          document.getElementById('tip').textContent, Number(use.getAttribute('x'))]; })",
        figure,
    )
    assert len(told) >= 30
    table = make_analysis(30, "joint", posteriors=1).table
    by_group: dict[str, list[tuple[float, int]]] = {}
    for group, place, text, x in told:
        rows = group.split("rows-")[1].split("_")
        assert text.startswith(f"event {rows[place]}\n")
        by_group.setdefault(group, []).append((x, int(rows[place])))
    if figure != "precision-figure":
        along = {"overview": "x_px", "timeline": "frame"}[figure]
        for pairs in by_group.values():
            place, row = (np.array(values) for values in zip(*pairs, strict=True))
            slope, start = np.polyfit(table[along].to_numpy(float)[row.astype(int)], place, 1)
            left = place - start - slope * table[along].to_numpy(float)[row.astype(int)]
            assert slope > 0
            assert np.abs(left).max() < 1e-3


def test_a_click_on_a_point_opens_its_event(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["one"])
    browser.execute_script(
        "document.querySelector('#overview [id*=rows-] use')"
        ".dispatchEvent(new MouseEvent('click', {bubbles: true}))"
    )
    assert (
        browser.execute_script("return document.querySelectorAll('#row-0 + .detail').length") == 1
    )


def test_figures_follow_the_theme(browser: Any, pages: dict[str, Path]) -> None:
    colors = []
    for scheme in ("light", "dark"):
        show(browser, pages["document"], scheme=scheme)
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


@pytest.mark.usefixtures("sketched")
def test_rows_beyond_the_first_200_are_laid_out_when_they_are_looked_for(
    browser: Any, tmp_path: Path
) -> None:
    page = tmp_path / "many.html"
    few = make_analysis(10)
    table = pd.concat([few.table] * 26, ignore_index=True).assign(event=np.arange(260))
    page.write_text(render_report(replace(few, table=table)), encoding="utf-8")
    looks = {
        "document.getElementById('row-199').scrollIntoView()": 260,
        "document.querySelector('#table th:nth-child(2) button').click()": 260,
        "const f = document.getElementById('filter'); f.value = '259'; "
        " f.dispatchEvent(new Event('input'))": 1,
        "window.dispatchEvent(new KeyboardEvent('keydown', {key: 'f', ctrlKey: true}))": 260,
        "window.dispatchEvent(new Event('beforeprint'))": 260,
    }
    for look, rows in looks.items():
        show(browser, page)
        assert shown_rows(browser, 200) == 200, look
        browser.execute_script(look)
        assert shown_rows(browser, rows) >= rows, look
        assert browser.execute_script(
            "return document.getElementById('row-259').getClientRects().length"
        ), look
        assert not errors(browser), look
