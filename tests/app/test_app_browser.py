"""`iscat app` in a real browser: who is let in, and the way from a movie to a figure."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pandas as pd
import pytest
from browsers import BROWSER, DRIVER, open_browser
from small_movies import LANDING

import iscat_analysis as ia
from iscat_cli import main

pytestmark = pytest.mark.skipif(
    BROWSER is None or DRIVER is None,
    reason="needs the programs chromium and chromedriver (Debian: chromium, chromium-driver)",
)
selenium = pytest.importorskip("selenium", reason="needs the Python package selenium")
pytest.importorskip("panel", reason="needs the Python package panel")

PATIENCE_S = 120.0
"""How long is waited for what should be seen; a loaded machine is slow."""

EVERYWHERE = """
const everywhere = (root, found = []) => {
  for (const node of root.querySelectorAll("*")) {
    found.push(node);
    if (node.shadowRoot) everywhere(node.shadowRoot, found);
  }
  return found;
};
const shown = (node) => node.getClientRects().length > 0;
const named = (tag, text) => everywhere(document).find(
  (node) => node.matches(tag) && shown(node) && node.textContent.trim() === text);
"""
"""Panel's widgets stand in shadow trees, which selectors do not enter."""


class Page:
    """One tab of the browser, used as a person does."""

    def __init__(self, driver: Any) -> None:
        self.driver = driver

    def script(self, code: str, *given: Any) -> Any:
        return self.driver.execute_script(EVERYWHERE + code, *given)

    def until(self, what: str, check: Callable[[], Any]) -> Any:
        """Wait until something is so."""
        end = time.monotonic() + PATIENCE_S
        while not (found := check()):
            assert time.monotonic() < end, f"{what}; the page says: {self.text()[:2000]}"
            time.sleep(0.1)
        return found

    def text(self) -> str:
        return str(
            self.script(
                "return everywhere(document).filter((n) => shown(n) && !n.matches('style, script'))"
                ".flatMap((n) => [...n.childNodes]).filter((n) => n.nodeType === 3)"
                ".map((n) => n.textContent.trim()).filter(Boolean).join('\\n')"
            )
        )

    def says(self, *words: str) -> None:
        self.until(f"{words} is said", lambda: all(word in self.text() for word in words))

    def click(self, text: str, tag: str = "button") -> None:
        node = self.until(
            f"{text} can be clicked",
            lambda: self.script("return named(arguments[0], arguments[1])", tag, text),
        )
        self.driver.execute_script("arguments[0].click()", node)

    def open(self, title: str) -> None:
        self.click(title, ".bk-tab")

    def choose(self, part: str) -> None:
        """Choose what has a text in it from a list that is shown."""
        self.until(
            f"{part} can be chosen",
            lambda: self.script(
                """
                for (const list of everywhere(document).filter((n) => n.matches("select"))) {
                  const option = [...list.options].find((o) => o.text.includes(arguments[0]));
                  if (!option || !shown(list)) continue;
                  list.value = option.value;
                  list.dispatchEvent(new Event("change", { bubbles: true }));
                  return true;
                }
                return false;
                """,
                part,
            ),
        )

    def bokeh(self, code: str, *given: Any) -> Any:
        """Ask the models of the figures."""
        return self.script(
            "const models = [...Bokeh.documents[0]._all_models.values()];" + code, *given
        )

    def drawn(self) -> int:
        """Count the pictures that were drawn of the film."""
        return int(
            self.bokeh("return models.find((m) => m.title === 'pictures drawn')?.value ?? 0")
        )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder with a movie, its configuration, and one that is damaged."""
    path = tmp_path_factory.mktemp("movies")
    small = LANDING.replace("frames = 480", "frames = 240")
    (path / "iscat.toml").write_text(small, encoding="utf-8")
    ia.simulate_movie(path / "iscat.toml", path / "landing.tif", seed=1)
    (path / "damaged.tif").write_bytes((path / "landing.tif").read_bytes()[:50_000])
    return path


@pytest.fixture(scope="module")
def address(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Start the command; Ctrl-C ends it, and it says nothing went wrong."""
    log = tmp_path_factory.mktemp("server") / "log"
    code = "import sys, iscat_cli; sys.argv = ['iscat', 'app', *sys.argv[1:]]; "
    code += "sys.exit(iscat_cli.main())"
    with log.open("w") as errors:
        server = subprocess.Popen(
            [sys.executable, "-c", code, str(folder), "--port", "0"],
            stdout=subprocess.PIPE, stderr=errors, text=True,
            env=os.environ | {"BROWSER": "true"},  # which opens nothing
        )  # fmt: skip
        assert server.stdout is not None
        with server.stdout as said_first:
            yield said_first.readline().strip()
            server.send_signal(signal.SIGINT)
            assert server.wait(PATIENCE_S) == 0
    said = log.read_text()
    assert "unexpected" not in said, said
    assert "Traceback" not in said, said


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    profile = tmp_path_factory.mktemp("profile")
    with open_browser(
        profile, "--window-size=1400,1200", logs={"browser": "ALL", "performance": "ALL"}
    ) as driver:
        yield driver


@pytest.fixture
def page(driver: Any, address: str) -> Iterator[Page]:
    """Open the page; afterwards nothing was fetched elsewhere, and no script failed."""
    driver.get(address)
    page = Page(driver)
    page.says("Choose a movie")
    yield page
    asked = set()
    for entry in driver.get_log("performance"):
        message = json.loads(entry["message"])["message"]
        if message["method"] == "Network.requestWillBeSent":
            asked.add(message["params"]["request"]["url"])
    here = address.partition("?")[0]
    assert [url for url in asked if not url.startswith((here, "data:", "blob:", "chrome:"))] == []
    failed = [entry for entry in driver.get_log("browser") if entry["level"] == "SEVERE"]
    assert [entry["message"] for entry in failed] == []


WEBSOCKET = {
    "Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Protocol": "bokeh, e30",
}  # fmt: skip
"""Headers with which a program would speak to the page past the page."""


@pytest.mark.parametrize(
    ("place", "headers"), [("", {}), ("?token=guessed", {}), ("ws", WEBSOCKET)]
)
def test_nobody_is_let_in_without_the_token(
    address: str, place: str, headers: dict[str, str]
) -> None:
    wanted = urllib.request.Request(address.partition("?")[0] + place, headers=headers)
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(wanted)
    with refused.value as answer:
        assert answer.code == 403


def test_from_a_movie_to_a_figure(page: Page, address: str, folder: Path) -> None:
    page.choose("landing.tif")
    page.says("240 of 64 × 64 pixels", "none yet: see Run")

    page.open("Look")
    page.until("the film is drawn", lambda: page.drawn() > 0)
    before = page.drawn()
    page.click("▶ Play")
    page.until("the film plays", lambda: page.drawn() > before + 5)
    page.click("⏸ Pause")

    page.open("Set up")
    page.says("camera.pixel_size_nm [nm]")
    page.click("Save iscat.toml")
    page.says("saved as")
    assert ia.load_config(folder / "iscat.toml").background.window_frames == 20

    page.open("Run")
    page.click("Analyse this movie")
    page.says("running")
    page.driver.refresh()  # in the middle of the run
    page.says("landing.tif")
    page.open("Run")
    page.says(": done", "results in")

    page.open("Results")
    page.until("bars are there", lambda: _bars(page))
    page.click("Add the gate")
    page.says("gate [kDa]", "0 to 100")
    page.bokeh(
        "models.find((m) => m.type === 'ColumnDataSource' && m.data.left?.length)"
        ".selected.indices = [...Array(500).keys()]"
    )
    page.says("SNR")
    page.choose(" kDa, ok")
    events = len(pd.read_parquet(folder / "landing.iscat" / "fits.parquet"))
    assert events > 0
    page.click("Reject the selected events")
    page.says("rejected by hand")
    rejected = pd.read_csv(folder / "landing.iscat.rejected.csv")
    assert 0 < len(rejected) <= events
    page.click("Take the event back")
    page.says(f"{len(rejected) - 1} rejected by hand")

    page.open("Export")
    page.says("iscat-fit", "iscat species", "Figure as SVG")
    again = page.driver.current_url
    page.driver.get(f"{address}&movie={quote(str(folder / 'landing.tif'))}&theme=dark")
    page.says("landing.tif")
    page.open("Results")
    page.says(f"{events - len(rejected) + 1}" if events > len(rejected) else "Rejected by hand")
    assert "movie=" in again


def _bars(page: Page) -> bool:
    return bool(
        page.bokeh(
            "return models.some((m) => m.type === 'ColumnDataSource' && m.data.left?.length)"
        )
    )


def test_a_damaged_movie_is_refused_in_words_and_the_page_goes_on(page: Page) -> None:
    page.choose("damaged.tif")
    page.says("is damaged")
    page.open("Look")
    page.says("is damaged")
    for movie, words in (("landing.tif", "240 of 64 × 64 pixels"), ("damaged.tif", "is damaged")):
        page.open("Open")
        page.choose(movie)  # at once, while the server may still be busy with the other tab
        page.says(movie, words)
        page.open("Look")
        page.says("Black and white at")


@pytest.mark.large
def test_two_tabs_show_two_movies_and_one_queue(page: Page, address: str, folder: Path) -> None:
    shutil.copy(folder / "landing.tif", folder / "second.tif")
    page.click("Look again")
    page.choose("second.tif")
    page.says("240 of 64 × 64 pixels")
    first = page.driver.current_window_handle
    page.driver.switch_to.new_window("tab")
    page.driver.get(f"{address}&movie={quote(str(folder / 'landing.tif'))}")
    page.says("landing.tif")
    page.driver.switch_to.window(first)
    page.open("Run")
    page.click("Analyse this movie")
    page.driver.switch_to.window(page.driver.window_handles[-1])
    page.open("Run")
    page.says("$ iscat-fit", "second.tif")
    page.click("Stop")
    page.says(": stopped")
    page.click("Go on or try again")
    page.says(": done")
    page.driver.close()
    page.driver.switch_to.window(first)
    page.says(": done")
    page.open("Compare")
    page.choose("second.iscat")


@pytest.mark.large
def test_bounds_follow_the_sliders(page: Page) -> None:
    page.open("Bounds")
    page.says("Computed in")
    before = page.text()
    page.bokeh(
        "const s = models.find((m) => m.type === 'Slider' && m.title === 'NA'); s.value = 1.2;"
    )
    page.until("the bounds change", lambda: page.text() != before and "QCRB" in page.text())


@pytest.mark.large
def test_a_folder_of_500_movies_is_listed(page: Page, folder: Path) -> None:
    many = folder / "many"
    many.mkdir()
    for number in range(500):
        (many / f"movie {number:03d}.tif").symlink_to(folder / "landing.tif")
    page.click("Look again")
    page.choose("many/")
    page.choose("movie 499.tif")
    page.says("240 of 64 × 64 pixels")


def test_the_port_that_is_asked_for_must_be_free(address: str, folder: Path, capsys) -> None:
    port = address.partition("?")[0].rstrip("/").rpartition(":")[2]
    assert main(["app", str(folder), "--port", port]) == 2
    assert "in use" in capsys.readouterr().err
    assert main(["app", str(folder / "landing.tif")]) == 1
    assert "no folder" in capsys.readouterr().err
