"""What a page is about: a folder, a movie in it, and the movie's result."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, TypeVar
from urllib.parse import urlencode

import panel as pn
import param

from iscat_analysis.errors import DataError, IscatError
from iscat_analysis.movie import path_beside, setup_beside

T = TypeVar("T")

_THREADS = ThreadPoolExecutor(4, thread_name_prefix="page")


class Chosen(param.Parameterized):
    """The movie that all parts of a page show."""

    movie = param.ClassSelector(class_=Path, default=None, doc="File or folder of a movie.")
    result = param.ClassSelector(class_=Path, default=None, doc="Output folder of a movie.")
    span = param.Tuple(default=None, length=2, doc="Frames to analyse, half-open.")
    excluded = param.Tuple(default=None, length=2, doc="Frames to leave out, half-open.")
    frame = param.Integer(default=None, allow_None=True, doc="Frame of the event that is shown.")
    view = param.Integer(default=None, allow_None=True, doc="Frame that Look shows.")
    event = param.Integer(default=None, allow_None=True, doc="Its number, for a ring of its own.")
    changed = param.Integer(default=0, doc="Counts what changes on the disk.")

    def choose(self, movie: Path | None, result: Path | None = None) -> None:
        """Show a movie, with the result that lies beside it unless another is given."""
        if result is None and movie is not None:
            result = path_beside(movie, ".iscat")
        found = result if result is not None and (result / "summary.json").is_file() else None
        view = self.view if movie == self.movie else None
        self.param.update(movie=movie, result=found, frame=None, event=None, view=view)

    def look_again(self) -> None:
        """See whether there is a result by now."""
        self.choose(self.movie, self.result)
        self.changed += 1

    @property
    def setup(self) -> Path | None:
        """Where the configuration of the movie is, or would be."""
        return None if self.movie is None else setup_beside(self.movie)

    @property
    def wanted_movie(self) -> Path:
        """The movie, which somebody has to choose first."""
        if self.movie is None:
            raise DataError("Choose a movie under Open.")
        return Path(self.movie)

    @property
    def config(self) -> Path | None:
        """The configuration of the movie, where there is one."""
        return self.setup if self.setup is not None and self.setup.is_file() else None


class Part(Protocol):
    """One tab of a page."""

    title: str
    body: pn.viewable.Viewable

    def refresh(self) -> None:
        """Show what is chosen now; called when the tab is opened, and when the choice changes."""


class Notice:
    """A line that says what went wrong, what is going on, or what to do."""

    def __init__(self) -> None:
        self.pane = pn.pane.HTML("", sizing_mode="stretch_width", visible=False)
        self.text, self.busy = "", False
        self._newest: Callable[[], None] | None = None
        self._is_at_it = False

    def say(self, text: str, kind: str = "info") -> None:
        """Show a text, as text whatever is in it; an empty one hides the line."""
        self.text, self.busy = text, kind == "busy"
        role = "alert" if kind == "error" else "status"
        self.pane.object = f'<div class="notice {kind}" role="{role}">{html.escape(text)}</div>'
        self.pane.visible = bool(text)

    @contextmanager
    def told(self) -> Iterator[None]:
        """Show what the library refuses; everything else that fails is a fault of ours."""
        try:
            yield
        except IscatError as error:
            self.say(str(error), "error")
        except (OSError, MemoryError) as error:
            self.say(f"{type(error).__name__}: {error}", "error")

    def button(
        self, text: str, width: int, action: Callable[[], Any], *, main: bool = False
    ) -> Any:
        """Make a button that does something when it is clicked, and shows what is refused."""
        made = pn.widgets.Button(label=text, width=width, color="primary" if main else "default")
        made.on_click(lambda _: self.tried(action))
        return made

    def watch(self, action: Callable[[], Any], *widgets: Any, what: str = "value") -> None:
        """Do something whenever the value of a widget changes, and show what is refused."""
        for widget in widgets:
            widget.param.watch(lambda _: self.tried(action), what)

    def tried(self, action: Callable[[], Any]) -> None:
        """Do something, and show what is refused."""
        with self.told():
            action()

    def latest(self, what: str, job: Callable[[], T], then: Callable[[T], None]) -> None:
        """Do the newest of jobs that are asked for faster than they can be done."""
        self._newest = lambda: self.work(what, job, then, self._go_on)
        if not self._is_at_it:
            self._go_on()

    def _go_on(self) -> None:
        newest, self._newest = self._newest, None
        self._is_at_it = newest is not None
        if newest is not None:
            newest()

    def work(
        self,
        what: str,
        job: Callable[[], T],
        then: Callable[[T], None],
        after: Callable[[], None] = lambda: None,
    ) -> None:
        """Do something that takes long in a thread, as the page goes on, and then show it."""
        document = pn.state.curdoc
        if what:
            self.say(f"{what} …", "busy")

        def finished(future: Future[T]) -> None:
            if document.session_context is not None and not document.session_context.destroyed:
                document.add_next_tick_callback(lambda: self._show(future, then, after))

        _THREADS.submit(job).add_done_callback(finished)

    def _show(
        self, future: Future[T], then: Callable[[T], None], after: Callable[[], None]
    ) -> None:
        """Show what a thread has made, as one change of the page."""
        try:
            with self.told():
                try:
                    found = future.result()
                    if self.busy:
                        self.say("")
                    then(found)
                except Exception as error:
                    self.say(f"{type(error).__name__}: {error}", "error")
                    raise
        finally:
            after()


def numbers_in(text: str) -> list[float]:
    """Read numbers that somebody wrote, as in 66, 146."""
    try:
        return [float(part) for part in text.replace(";", ",").split(",") if part.strip()]
    except ValueError:
        raise DataError(f"{text}: write numbers, as in 66, 146") from None


def link_to(page: Path, text: str) -> str:
    """Link to a page that the commands wrote."""
    address = html.escape("page?" + urlencode({"path": str(page)}))
    how = 'target="_blank" rel="noreferrer noopener" style="color: inherit"'
    return f'<a href="{address}" {how}>{html.escape(text)}</a>'
