"""The report in a real browser: it runs without errors, reacts, fits the screen and can be read."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import tifffile

from iscat_analysis.bounds import paper
from iscat_analysis.records import EVENT_COLUMNS
from iscat_analysis.report import render_page, render_report
from iscat_cli import main

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from report_factory import make_analysis, without_events

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")
DRIVER = shutil.which("chromedriver")

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
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = str(BROWSER)
    for argument in (
        "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
        "--disable-background-networking", "--disable-component-update", "--disable-sync",
        "--hide-scrollbars", "--disable-dev-shm-usage",
        f"--user-data-dir={tmp_path_factory.mktemp('profile')}",
    ):  # fmt: skip
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(str(DRIVER)))
    yield driver
    driver.quit()


@pytest.fixture(scope="module")
def written(
    tmp_path_factory: pytest.TempPathFactory, sample_configs: dict[str, Path]
) -> dict[str, Path]:
    """Let the commands write every kind of page, from small jobs."""
    folder = tmp_path_factory.mktemp("written")
    movie, shade, landing = (folder / f"{name}.tif" for name in ("movie", "dark", "landing"))
    few = ["--config", str(sample_configs["landing"]), "--set", "simulation.count=40"]
    dark = 4 * np.random.default_rng(1).standard_normal((60, 128, 128))
    tifffile.imwrite(shade, np.rint(100 + dark).astype("uint16"))
    mass = np.random.default_rng(1).normal(np.repeat([66.0, 146.0, 480.0], 60), 8.0)
    table = pd.DataFrame(0.0, index=range(mass.size), columns=list(EVENT_COLUMNS))
    table = table.assign(mass_kda=mass, sigma_mass_kda=8.0, contrast=-3.1e-5 * mass, status="ok")
    table.to_csv(folder / "fits.csv", index=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper, "HEIGHTS_NM", np.linspace(0.0, 1000.0, 5))
        patch.setattr(paper, "FOCI_NM", np.linspace(-1000.0, 1000.0, 5))
        for arguments in (
            ["simulate", *few, "--out", str(landing)],
            ["fit", str(landing), *few, "--inject", "4", "--out", str(folder / "landing")],
            ["calibrate", "mass", str(folder / "fits.csv"),
             "--standards", "66,146,480", "--out", str(folder / "line")],
            ["simulate", "--config", str(sample_configs["mass"]), "--out", str(movie),
             "--set", "camera.offset_adu=100"],
            ["calibrate", "camera", str(movie), "--dark", str(shade),
             "--out", str(folder / "camera")],
            ["benchmark", "--config", str(sample_configs["joint"]), "--trials", "20",
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
    texts["document"] = render_page("document.html", DOCUMENT)
    found = dict(written)
    for name, text in texts.items():
        found[name] = folder / f"{name}.html"
        found[name].write_text(text, encoding="utf-8")
    return found


DOCUMENT = {
    "title": "Bounds along z",
    "sections": [
        {
            "id": "scan",
            "title": "Scan",
            "lead": "Every kind of chart on one page.",
            "facts": [{"label": "trials", "value": "1000", "note": "per mode"}],
            "charts": [
                {"id": "lines", "title": "Lines", "wide": True, "spec": {
                    "x": {"label": "z [nm]"}, "y": {"label": "σ [nm]", "scale": "log"},
                    "series": [
                        {"kind": "line", "name": "CRB", "color": "crb", "x": [0, 100, 200],
                         "y": [3.0, None, 5.0]},
                        {"kind": "line", "name": "QCRB", "color": "qcrb", "dash": True,
                         "x": [0, 100, 200], "y": [1.0, 1.1, 1.2]}]}},
                {"id": "spread", "title": "Spread", "spec": {
                    "x": {"label": "", "categories": ["x", "y", "z", "mass"]},
                    "y": {"label": "spread / CRB"},
                    "series": [
                        {"kind": "rule", "name": "CRB", "color": "crb", "axis": "y", "value": 1},
                        {"kind": "interval", "name": "spread", "color": "sigma", "along": "y",
                         "at": [0, 1, 2, 3], "mid": [1.0, 1.02, 0.99, 1.05],
                         "lo": [0.98, 1.0, 0.97, 1.0], "hi": [1.02, 1.04, 1.01, 1.1]}]}},
            ],
            "tables": [{"caption": "Numbers", "columns": ["of", {"label": "σ", "numeric": True}],
                        "rows": [["x", 3.0], ["y", 10.0], ["z", float("nan")], ["mass", 2.0]]}],
        }
    ],
}  # fmt: skip


def show(browser: Any, page: Path, *, width: int = 1440, scheme: str = "light") -> None:
    feature = {"name": "prefers-color-scheme", "value": scheme}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
    metrics = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    browser.get_log("browser")
    browser.get(page.as_uri())


def errors(browser: Any) -> list[str]:
    return [entry["message"] for entry in browser.get_log("browser")]


def first_cells(browser: Any, column: int) -> list[str]:
    script = (
        "return [...document.querySelectorAll('#table tbody tr.row')]"
        ".map((row) => row.cells[arguments[0]].textContent)"
    )
    return list(browser.execute_script(script, column))


def click(browser: Any, selector: str) -> None:
    browser.execute_script("document.querySelector(arguments[0]).click()", selector)


REPORTS = ("mass", "joint", "localize", "track", "darkfield", "one", "landing")
DOCUMENTS = ("document", "calibration", "camera", "benchmark", "comparison")
NAMES = (*REPORTS, "none", *DOCUMENTS)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("width", [390, 1440])
def test_fits_the_screen_without_errors(
    browser: Any, pages: dict[str, Path], name: str, width: int
) -> None:
    show(browser, pages[name], width=width)
    browser.execute_script(
        "for (const id of ['row-0', 'row-1']) {"
        "  const row = document.getElementById(id); if (row) row.click(); }"
    )
    widths = browser.execute_script(
        "return [document.documentElement.scrollWidth, document.documentElement.clientWidth]"
    )
    assert widths[0] <= widths[1] == width
    assert browser.execute_script(OVERLAPS) == []
    assert errors(browser) == []


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_text_has_enough_contrast(
    browser: Any, pages: dict[str, Path], name: str, scheme: str
) -> None:
    show(browser, pages[name], scheme=scheme)
    if name in REPORTS:
        click(browser, "#row-0")
    seen, poor = browser.execute_script(POOR_CONTRAST, AA_NORMAL, AA_LARGE)
    assert seen > 20
    assert poor == []


def test_the_toggle_overrides_the_system(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["one"], scheme="light")
    ground = "return getComputedStyle(document.body).backgroundColor"
    before = browser.execute_script(ground)
    click(browser, "[data-theme-toggle]")
    assert browser.execute_script(ground) != before
    click(browser, "[data-theme-toggle]")
    assert browser.execute_script(ground) == before


def test_columns_sort_both_ways(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["mass"])
    click(browser, "[data-key='snr']")
    rising = [float(text) for text in first_cells(browser, 11)]
    assert rising == sorted(rising)
    click(browser, "[data-key='snr']")
    falling = [float(text) for text in first_cells(browser, 11)]
    assert falling == sorted(falling, reverse=True)
    assert falling[0] > rising[-1]


@pytest.mark.parametrize("name", ["mass", "joint", "landing"])
def test_the_numbers_of_a_column_line_up(browser: Any, pages: dict[str, Path], name: str) -> None:
    show(browser, pages[name])
    heads = browser.execute_script(
        "return [...document.querySelectorAll('#table th')].map((h) => h.textContent)"
    )
    for column, head in list(enumerate(heads))[2:-1]:
        cells = [text.removesuffix(" %") for text in first_cells(browser, column)]
        decimals = {
            len(text.partition(".")[2]) for text in cells if text != "—" and "×" not in text
        }
        assert len(decimals) == 1, (head, cells)


def test_a_landing_movie_shows_its_noise_curve(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["landing"])
    text = browser.execute_script("return document.getElementById('noise').textContent")
    assert "variance over shot noise" in text
    assert "measured" in text
    text = browser.execute_script("return document.getElementById('diagnostics').textContent")
    for said in ("Windows of", "Drift of the fixed pattern", "added to the movie"):
        assert said in text


@pytest.mark.parametrize("name", ["mass", "joint", "landing", "benchmark", "camera"])
def test_every_axis_has_two_ticks(browser: Any, pages: dict[str, Path], name: str) -> None:
    show(browser, pages[name])
    axes = browser.execute_script(
        "const axes = new Map();"
        "for (const t of document.querySelectorAll('.plot svg:not(:has(image)) text')) {"
        "  if (!/^[−\\d.,]+$/.test(t.textContent)) continue;"
        "  if (!axes.has(t.parentNode)) axes.set(t.parentNode, {});"
        "  const numbers = axes.get(t.parentNode), side = t.getAttribute('text-anchor');"
        "  numbers[side] = [...(numbers[side] || []), t.textContent];"
        "} return [...axes.values()].flatMap((numbers) => Object.values(numbers));"
    )
    assert len(axes) > 3
    assert [numbers for numbers in axes if len(numbers) < 2] == []


def test_filters_narrow_the_table_and_clear(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["mass"])
    set_value = (
        "const n = document.querySelector(arguments[0]); n.value = arguments[1];"
        "n.dispatchEvent(new Event('input')); n.dispatchEvent(new Event('change'));"
    )
    count = "return document.getElementById('count').textContent"
    browser.execute_script(set_value, "#filter-status", "poor_fit")
    assert set(first_cells(browser, 13)) == {"poor_fit"}
    click(browser, "#filter-clear")
    assert browser.execute_script(count) == "60 events"
    browser.execute_script(set_value, "#filter-low", "300")
    assert all(float(text) >= 300 for text in first_cells(browser, 4))
    browser.execute_script(set_value, "#filter-text", "no such flag")
    assert browser.execute_script(count) == "0 of 60 events"


def test_brushing_the_histogram_filters(browser: Any, pages: dict[str, Path]) -> None:
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.by import By

    show(browser, pages["mass"])
    area = browser.find_element(By.CSS_SELECTOR, "#histogram-mass_kda .hit")
    browser.execute_script(
        "arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", area
    )
    width = area.size["width"]
    drag = ActionChains(browser).move_to_element_with_offset(area, int(width * 0.2), 0)
    drag.click_and_hold().move_by_offset(int(width * 0.25), 0).release().perform()
    low = float(browser.execute_script("return document.getElementById('filter-low').value"))
    masses = [float(text.replace("−", "-")) for text in first_cells(browser, 4)]
    assert masses
    assert all(mass > low - 1 for mass in masses)
    assert " of 60 events" in browser.execute_script(
        "return document.getElementById('count').textContent"
    )


def test_a_row_opens_its_images_and_its_posterior(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["mass"])
    click(browser, "#row-1 .toggle")
    detail = "return document.querySelectorAll('#detail-1 ' + arguments[0]).length"
    assert browser.execute_script(detail, "figure") == 2
    assert browser.execute_script(detail, "svg image") == 6  # three pictures, three colour bars
    text = browser.execute_script("return document.getElementById('detail-1').textContent")
    assert "µm" in text
    assert "The fit converged" in text
    click(browser, "#row-1 .toggle")
    assert browser.execute_script(detail, "figure") == 0


def test_a_refused_posterior_shows_why_and_no_plot(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["mass"])
    click(browser, "#row-0")
    text = browser.execute_script("return document.getElementById('detail-0').textContent")
    assert "Posterior refused" in text
    figures = "return document.querySelectorAll('#detail-0 figure').length"
    assert browser.execute_script(figures) == 1


def test_a_point_tells_its_values_and_opens_its_event(browser: Any, pages: dict[str, Path]) -> None:
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.by import By

    show(browser, pages["one"])
    area = browser.find_element(By.CSS_SELECTOR, "#field .hit")
    browser.execute_script(
        "arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", area
    )
    x, y, size = browser.execute_script(
        "const d = JSON.parse(document.getElementById('analysis').textContent);"
        "return [d.columns.x_px[0], d.columns.y_px[0], d.field.columns]"
    )
    dx, dy = ((v + 0.5) / size - 0.5 for v in (x, y))
    place = (int(dx * area.size["width"]), int(dy * area.size["height"]))
    ActionChains(browser).move_to_element_with_offset(area, *place).perform()
    assert "Event 0" in browser.execute_script("return document.getElementById('tip').textContent")
    ActionChains(browser).click().perform()
    assert browser.execute_script("return document.getElementById('detail-0') !== null")


def test_a_saved_figure_stands_alone(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["one"], scheme="dark")
    browser.execute_script(
        "window.saved = []; URL.createObjectURL = (blob) => { saved.push(blob); return '#'; };"
    )
    click(browser, "#ladder figcaption button")
    text = browser.execute_async_script("saved[0].text().then(arguments[0])")
    assert text.startswith("<svg")
    assert "var(" not in text
    assert 'xmlns="http://www.w3.org/2000/svg"' in text


def test_tables_of_documents_sort(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["document"])
    click(browser, "table.sortable th:nth-child(2) button")
    script = "return [...document.querySelectorAll('tbody tr')].map((r) => r.cells[0].textContent)"
    assert browser.execute_script(script) == ["mass", "x", "y", "z"]


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
