"""Run: the queue, what it says, and what can be done about it."""

from __future__ import annotations

import html
from dataclasses import replace
from pathlib import Path
from typing import Any

import panel as pn

from iscat_analysis.movie import path_beside
from iscat_app.chosen import Chosen, Notice
from iscat_app.files import listed
from iscat_app.runs import Job, Queue, Run
from iscat_app.widgets import in_line


class RunTab:
    """Shows the queue, which belongs to all pages."""

    title = "Run"

    def __init__(self, chosen: Chosen, queue: Queue) -> None:
        self._chosen, self._queue = chosen, queue
        self._version, self._ended = -1, set[int]()
        self._notice = Notice()
        self._overwrite = pn.widgets.Checkbox(label="Replace an earlier result")
        where = "Where: threads, or the address of a Dask scheduler"
        self._scheduler = pn.widgets.TextInput(label=where, value="threads", width=330)
        button = self._notice.button
        start = button("Analyse this movie", 170, self._start, main=True)
        every = button("Analyse all movies of the folder", 240, self._start_all)
        self._which = pn.widgets.Select(label="Run", options=[], width=420)
        stop = button("Stop", 90, lambda: self._do(self._queue.stop))
        again = button(
            "Go on or try again", 160, lambda: self._do(lambda r: self._queue.add(r.job))
        )
        self._notice.watch(self._show, self._which)
        self._bar = pn.indicators.Progress(value=0, max=100, width=420)
        self._state = pn.pane.HTML("")
        self._log = pn.pane.Str("", sizing_mode="stretch_width")
        self.body = pn.Column(
            self._notice.pane,
            in_line(start, every),
            in_line(self._scheduler, self._overwrite),
            in_line(self._which, stop, again),
            self._bar,
            self._state,
            self._log,
            sizing_mode="stretch_width",
        )

    def watch(self) -> None:
        """Look at the queue now and then, whichever tab is open."""
        self._ended = {run.number for run in self._queue.runs if run.ended}
        pn.state.add_periodic_callback(self._look, period=500)  # between two looks at the queue

    def refresh(self) -> None:
        """Show the queue as it is."""
        self._version = -1
        self._look()

    def _look(self) -> None:
        running = any(run.state == "running" for run in self._queue.runs)
        if self._version == self._queue.version and not running:
            return
        self._version = self._queue.version
        options = {f"{r.number}: {r.job.title}, {r.state}": r.number for r in self._queue.runs}
        if options != self._which.options:
            is_new = len(options) != len(self._which.options)
            value = self._queue.runs[-1].number if is_new else self._which.value
            self._which.param.update(options=options, value=value)
        self._show()
        for run in self._queue.runs:
            if run.ended and run.number not in self._ended:
                self._ended.add(run.number)
                if run.job.kind != "fit" or run.job.movie == self._chosen.movie:
                    self._chosen.look_again()

    def _chosen_run(self) -> Run | None:
        return next((r for r in self._queue.runs if r.number == self._which.value), None)

    def _show(self) -> None:
        run = self._chosen_run()
        if run is None:
            self._state.object, self._log.object = "<p>Nothing was run yet.</p>", ""
            self._bar.value = 0
            return
        share = 100 * run.done / run.total if run.total else 0
        self._bar.value = 100 if run.state == "done" else int(share)
        left = run.seconds_left
        parts = [f"<b>{html.escape(run.job.title)}</b>: {run.state}"]
        if run.state in ("running", "stopping"):
            parts.append(f"{run.stage or 'starting'} {run.done} of {run.total}")
            parts += [] if left is None else [f"about {_time(left)} left in this stage"]
        self._state.object = f"<p role='status'>{', '.join(parts)}</p>"
        self._log.object = "\n".join([f"$ {run.job.command}", *run.log])

    def _start(self) -> None:
        movie = self._chosen.wanted_movie
        self._notice.say("")
        run = self._queue.add(self._job(movie))
        self.refresh()
        self._which.value = run.number

    def _job(self, movie: Path) -> Job:
        job = Job(movie, self._chosen.config, path_beside(movie, ".iscat"))
        scheduler = self._scheduler.value.strip() or "threads"
        return replace(job, overwrite=self._overwrite.value, scheduler=scheduler)

    def _start_all(self) -> None:
        """Put all movies of the folder into the queue, but those that have a result."""
        put = 0
        for entry in listed(self._chosen.wanted_movie.parent):
            done = (path_beside(entry.path, ".iscat") / "summary.json").is_file()
            if entry.kind == "movie" and (self._overwrite.value or not done):
                self._queue.add(self._job(entry.path))
                put += 1
        self._notice.say(f"{put} movies are in the queue; those with a result were left alone")
        self.refresh()

    def _do(self, what: Any) -> None:
        run = self._chosen_run()
        if run is not None:
            made = what(run)
            self.refresh()
            if made is not None:
                self._which.value = made.number


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
