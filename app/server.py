"""The server, for this machine and who knows the token, and the page that it shows.

The parts of the page are tabs, all about the one movie that is chosen.
"""

from __future__ import annotations

import html
import logging
import secrets
import socket
import threading
import traceback
import warnings
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import urlencode

import panel as pn
from bokeh.server.auth_provider import AuthProvider
from tornado.iostream import StreamClosedError
from tornado.web import RequestHandler
from tornado.websocket import WebSocketClosedError

from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.report.output import PAGES
from iscat_app.bounds import Bounds
from iscat_app.calibrate import Calibrate
from iscat_app.chosen import Chosen, Part
from iscat_app.compare import Compare
from iscat_app.export import Export
from iscat_app.files import Files
from iscat_app.film import Film
from iscat_app.form import Form
from iscat_app.results import Results
from iscat_app.run_tab import RunTab
from iscat_app.runs import Queue
from iscat_app.widgets import given

STYLE = """
.notice { padding: 6px 10px; border-left: 4px solid #0072B2; }
.notice.error { border-left-color: #D55E00; font-weight: 600; }
table { border-collapse: collapse; }
h2 { margin: 0; font-size: 1.2rem; overflow-wrap: anywhere; }
td, th { padding: 3px 10px 3px 0; text-align: left; vertical-align: top; }
td:last-child { overflow-wrap: anywhere; }
"""
"""Beside what Panel brings."""

_TABS = """
.bk-tab.bk-active { color: inherit; font-weight: 700; }  /* readable on a dark ground */
[style*="visibility: hidden"] { display: none; }  /* or every tab is as high as the highest */
:host > .bk-header, .bk-headers { flex-wrap: wrap; }
"""

_KEYS = """<script>
document.addEventListener("keydown", (event) => {
  const at = event.composedPath()[0];
  if (event.key === "Enter" && at.matches?.(".bk-tab")) at.click();
});
</script>"""
"""Bokeh's tabs can be reached with the keyboard, but answer to clicks alone."""

pn.extension("vega", notifications=False, raw_css=[STYLE], sizing_mode=None, throttled=False)


class _Template(pn.template.VanillaTemplate):
    """Panel's plain page, without the font that it would fetch from another server."""

    _resources: ClassVar[dict[str, Any]] = {}


def page_of(folder: Path, queue: Queue) -> Any:
    """Make the page of one browser tab; each has its own."""
    chosen = Chosen()
    if movie := given("movie"):
        chosen.choose(Path(movie))
    start = folder if chosen.movie is None else chosen.movie.parent
    results, runs, compare = Results(chosen), RunTab(chosen, queue), Compare(chosen, queue)
    first: list[Part] = [Files(chosen, start), Film(chosen), Form(chosen), runs, results, compare]
    last: list[Part] = [Calibrate(chosen, queue), Bounds(chosen), Export(chosen, results, compare)]
    parts = first + last
    # Filled when first opened, for speed, and kept: what the browser says of a list that the server
    # has taken away is lost without a word, as it would be of `dynamic` tabs.
    places = [pn.Column(sizing_mode="stretch_width") for _ in parts]
    tabs = pn.Tabs(
        *[(part.title, place) for part, place in zip(parts, places, strict=True)],
        sizing_mode="stretch_width",
        stylesheets=[_TABS],
    )

    def show(*_: Any) -> None:
        named = chosen.movie or chosen.result
        name = "Choose a movie" if named is None else named.name
        heading.object = f"<h2>{html.escape(name)}</h2>"
        colours.object = _colours(chosen)
        part, place = parts[tabs.active], places[tabs.active]
        if not len(place):
            place.append(part.body)
        part.refresh()

    def remember(*_: Any) -> None:
        if pn.state.location is not None:
            pn.state.location.update_query(movie=chosen.movie and str(chosen.movie))

    colours = pn.pane.HTML("")
    heading = pn.pane.HTML("", sizing_mode="stretch_width")
    tabs.param.watch(show, "active")
    chosen.param.watch(show, ["movie", "result", "changed"])
    chosen.param.watch(remember, ["movie"])
    template = _Template(
        title="iSCAT analysis",
        main=[heading, tabs],
        header=[colours, pn.pane.HTML(_KEYS)],
        header_background="#1B1D21",
        theme="dark" if given("theme") == "dark" else "default",
        busy_indicator=None,
    )
    show()
    runs.watch()
    return template


def _colours(chosen: Chosen) -> str:
    """Link to the same page in other colours."""
    same = {} if chosen.movie is None else {"movie": str(chosen.movie)}
    links = []
    for name, theme in (("dark", "dark"), ("light", "default")):
        query = html.escape(urlencode(same | {"theme": theme}))
        links.append(f'<a style="color: white" href="?{query}">{name}</a>')
    return f'<nav aria-label="colours">{" · ".join(links)}</nav>'


HOST = "127.0.0.1"
FIRST_PORT, PORTS = 5006, 50
"""Where a free port is looked for, if none is asked for."""

_UNHEARD = (
    "tornado.access",  # who was not let in
    "bokeh.server.views.ws",  # that a page was closed
    "tifffile",  # what is wrong with a file, which the page says in words
)
"""Logs that nobody needs to read."""

_LOCKED = (
    "<!doctype html><html lang=en><title>iSCAT analysis</title>"
    "<p>This address needs the token: open the whole address that <code>iscat app</code> printed."
)


def serve(
    folder: Path,
    *,
    port: int | None,
    say: Callable[[str], None],
    warn: Callable[[str], None],
    debug: bool = False,
) -> None:
    """Show a folder in the browser until Ctrl-C.

    `say` is told the address, and `warn` what went wrong, with `debug` with its traceback.
    """
    if not folder.is_dir():
        raise DataError(f"{folder}: is no folder; give the folder that holds the movies")
    number = _free_port(port)
    logging.basicConfig(level=logging.WARNING, handlers=[_Log(warn, debug=debug)], force=True)
    token = secrets.token_urlsafe(24)
    auth = _Token(token, number)
    queue = Queue()
    root = folder.resolve()
    for name in _UNHEARD:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    server = pn.io.server.get_server(
        {"/": lambda: page_of(root, queue)},
        address=HOST,
        port=number,
        websocket_origin=[f"{HOST}:{number}", f"localhost:{number}"],
        auth_provider=auth,
        title="iSCAT analysis",
        show=False,
        start=False,
        verbose=False,
        extra_patterns=[("/page", _Page, {"auth": auth})],
    )
    address = f"http://{HOST}:{number}/?token={token}"

    # What the browser says first of a figure that was added to the page names it in full.
    warnings.filterwarnings("ignore", "reference already known")
    server.start()
    say(address)
    threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
    try:
        server.io_loop.start()
    except KeyboardInterrupt:  # which is how one ends it
        pass
    finally:
        queue.close()


class _Log(logging.Handler):
    """Says in a line what libraries log, but not that a page was closed while it was written to."""

    def __init__(self, warn: Callable[[str], None], *, debug: bool) -> None:
        super().__init__()
        self._warn, self._debug = warn, debug

    def emit(self, record: logging.LogRecord) -> None:
        """Say one record."""
        error = record.exc_info[1] if record.exc_info else None
        if isinstance(error, (WebSocketClosedError, StreamClosedError)):
            return
        if error is None:
            self._warn(record.getMessage())
        elif self._debug:
            self._warn("".join(traceback.format_exception(error)))
        else:
            self._warn(f"unexpected {type(error).__name__}: {error}; --debug gives the traceback")


class _Locked(RequestHandler):
    """Says what is missing."""

    def get(self, *_: Any) -> None:
        """Answer whoever has no token."""
        self.set_status(403)
        self.finish(_LOCKED)


class _Token(AuthProvider):
    """Lets in who has the token, in the address or, from then on, in a cookie."""

    def __init__(self, token: str, port: int) -> None:
        self._token, self._cookie = token, f"iscat_app_{port}"
        super().__init__()

    @property
    def get_user(self) -> Callable[[RequestHandler], str | None]:
        def user(request: RequestHandler) -> str | None:
            given = request.get_argument("token", "")
            if given and self._is_token(given):
                request.set_cookie(self._cookie, given, httponly=True, samesite="Strict")
                return "owner"
            return "owner" if self._is_token(request.get_cookie(self._cookie) or "") else None

        return user

    def _is_token(self, given: str) -> bool:
        return secrets.compare_digest(given.encode(), self._token.encode())

    login_url, login_handler = "/locked", _Locked
    get_user_async = get_login_url = logout_url = logout_handler = None


class _Page(RequestHandler):
    """Shows a page that the commands wrote, whose scripts cannot touch the window."""

    def initialize(self, auth: _Token) -> None:
        self._auth = auth

    def get(self) -> None:
        """Answer with the page, if it is one of those."""
        path = Path(self.get_argument("path", ""))
        if self._auth.get_user(self) is None:
            self.set_status(403)
            self.finish(_LOCKED)
        elif path.name not in PAGES or not path.is_file():
            self.set_status(404)
            self.finish("<!doctype html><title>iSCAT analysis</title><p>There is no such page.")
        else:
            self.set_header("Content-Security-Policy", "sandbox allow-scripts allow-downloads")
            self.finish(path.read_bytes())


def _free_port(wanted: int | None) -> int:
    """Find a port that nothing listens at, or make sure of the one that is asked for."""
    ports = range(FIRST_PORT, FIRST_PORT + PORTS) if wanted is None else [wanted]
    for port in ports:
        with socket.socket() as probe, suppress(OSError, OverflowError):
            probe.bind((HOST, port))
            return int(probe.getsockname()[1])
    if wanted is not None:
        raise ConfigError(f"--port {wanted}: is in use, or not allowed; leave it out")
    raise ConfigError(f"none of the ports {FIRST_PORT} to {ports[-1]} is free: give --port")
