"""The server, for this machine and who knows the token, and the page that it shows.

The parts of the page are tabs, all about the one movie that is chosen.
"""

from __future__ import annotations

import html
import logging
import os
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
from urllib.parse import parse_qsl, urlencode

import panel as pn
from bokeh.util.token import check_token_signature
from tornado.httputil import HTTPHeaders, HTTPServerRequest
from tornado.iostream import StreamClosedError
from tornado.routing import Matcher, Rule
from tornado.web import OutputTransform, RequestHandler
from tornado.websocket import WebSocketClosedError

from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.reading import read_bytes
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

_DRAWN = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; "
_AROUND = f"{_DRAWN}frame-src 'self'; frame-ancestors 'none'"
_INSIDE = (
    f"sandbox allow-scripts allow-downloads; {_DRAWN}script-src 'unsafe-inline'; "
    "img-src data: blob:; frame-ancestors 'self'"
)
_FRAME = """<!doctype html><html lang="en"><meta charset="utf-8"><title>{name}</title>
<iframe title="{name}" sandbox="allow-scripts allow-downloads" src="{inside}"
style="position: fixed; inset: 0; width: 100%; height: 100%; border: 0"></iframe>"""
"""A page that somebody else may have made draws itself, and can neither send nor go anywhere."""


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
    strangers = _Strangers(number)
    queue = Queue()
    root = folder.resolve()
    for name in _UNHEARD:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    server = pn.io.server.get_server(
        {"/": lambda: page_of(root, queue)},
        address=HOST,
        port=number,
        websocket_origin=strangers.hosts,
        title="iSCAT analysis",
        show=False,
        start=False,
        verbose=False,
        extra_patterns=[("/page", _Page)],
        **strangers.sessions,
    )
    application = server._tornado  # Bokeh has no public name for it
    application.add_handlers(".*", [Rule(strangers, _Locked, {"strangers": strangers})])
    application.add_transform(_Headers)
    address = f"http://{HOST}:{number}/?token={strangers.token}"

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


_NEVER = frozenset({"token", "bokeh-token", "bokeh-session-id", "Bokeh-Session-Id"})
"""What no page of ours says once it is open; Bokeh would take sessions from it."""


def is_sent(request: HTTPServerRequest) -> bool:
    """Tell whether a page of somebody else has sent the browser here."""
    return request.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin")


class _Strangers(Matcher):
    """Every request but those of the window itself; it is asked before anything else is."""

    def __init__(self, port: int) -> None:
        self.token, self._secret = secrets.token_urlsafe(24), secrets.token_bytes(32)
        self.hosts = [f"{name}:{port}" for name in (HOST, "localhost")]
        self._origins = {None, *(f"http://{host}" for host in self.hosts)}
        self.cookie = f"iscat_app_{port}"
        self.sessions: dict[str, Any] = {"secret_key": self._secret, "sign_sessions": True}
        # What a session knows is written into its page
        self.sessions |= {"include_headers": [], "include_cookies": []}

    def match(self, request: HTTPServerRequest) -> dict[str, Any] | None:
        """Tell whom to stop: an empty answer means that the request goes no further."""
        cookie = request.cookies.get(self.cookie)
        is_ours = cookie is not None and self.is_token(cookie.value) and self.is_here(request)
        named = _NEVER.isdisjoint([*request.query_arguments, *request.headers])
        goes_on = is_ours and named and not is_sent(request) and self._has_session(request)
        return None if goes_on else {}

    def is_token(self, given: str) -> bool:
        """Compare in a time that tells nothing."""
        return secrets.compare_digest(given.encode(errors="replace"), self.token.encode())

    def is_here(self, request: HTTPServerRequest) -> bool:
        """Tell whether it came by a name of this server, and from no other page."""
        return request.host in self.hosts and request.headers.get("Origin") in self._origins

    def _has_session(self, request: HTTPServerRequest) -> bool:
        """Tell whether a websocket, if it is one, names a session of this server."""
        if request.path != "/ws":
            return True
        _, _, session = request.headers.get("Sec-WebSocket-Protocol", "").partition(",")
        try:
            return bool(check_token_signature(session.strip(), self._secret, signed=True))
        except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
            return False  # it is not even a token


class _Locked(RequestHandler):
    """Answers strangers, and gives the cookie to who has the token of the address."""

    def initialize(self, strangers: _Strangers) -> None:
        self._strangers = strangers

    def prepare(self) -> None:
        """Open the same page without the token, or say what is missing."""
        strangers = self._strangers
        token = self.get_query_argument("token", "")
        if not (strangers.is_here(self.request) and strangers.is_token(token)):
            self.set_status(403)
            self.finish(_LOCKED)
            return
        self.set_cookie(strangers.cookie, token, httponly=True, samesite="Strict")
        rest = urlencode([pair for pair in parse_qsl(self.request.query) if pair[0] != "token"])
        place = f"?{rest}" if rest else "."
        if is_sent(self.request):  # where a redirection would come without the cookie
            self.set_header("Refresh", f"0; url={place}")
            self.finish()
        else:
            self.redirect(place)


class _Headers(OutputTransform):
    """Says with every answer that nobody learns its address and no page frames it."""

    def transform_first_chunk(self, status_code: int, headers: HTTPHeaders, *rest: Any) -> Any:
        """Add to the headers of an answer."""
        headers["Referrer-Policy"] = "no-referrer"
        headers.setdefault("Content-Security-Policy", "frame-ancestors 'none'")
        return status_code, headers, rest[0]


class _Page(RequestHandler):
    """Shows a page that the commands, or somebody else, wrote: in a frame that it cannot leave."""

    def get(self) -> None:
        """Answer with the frame, and with what is inside; where it is no such page, say so."""
        path = Path(self.get_query_argument("path", ""))
        try:
            page = read_bytes(path, 2**28) if path.name in PAGES else None
        except OSError:
            page = None
        if page is None:
            self.set_status(404)
            self.finish("<!doctype html><title>iSCAT analysis</title><p>There is no such page.")
        elif self.get_query_argument("inside", ""):
            self.set_header("Content-Security-Policy", _INSIDE)
            self.finish(page)
        else:
            self.set_header("Content-Security-Policy", _AROUND)
            inside = html.escape("page?" + urlencode({"path": str(path), "inside": "yes"}))
            self.finish(_FRAME.format(name=html.escape(path.parent.name), inside=inside))


def _free_port(wanted: int | None) -> int:
    """Find a port that nothing listens at, or make sure of the one that is asked for."""
    ports = range(FIRST_PORT, FIRST_PORT + PORTS) if wanted is None else [wanted]
    for port in ports:
        with socket.socket() as probe, suppress(OSError, OverflowError):
            # Or a server that ended a minute ago would be in the way; Windows means another thing
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, os.name != "nt")
            probe.bind((HOST, port))
            return int(probe.getsockname()[1])
    if wanted is not None:
        raise ConfigError(f"--port {wanted}: is in use, or not allowed; leave it out")
    raise ConfigError(f"none of the ports {FIRST_PORT} to {ports[-1]} is free: give --port")
