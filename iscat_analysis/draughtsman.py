"""A process that draws figures, started before they are wanted so that it is ready then.

Loading Matplotlib and drawing take as long as the rest of a small run.  The process loads it while
a movie is analysed, and then draws while tables are written.  What it has loaded is 100 MB, so that
it is started for a large movie when most of the work is done.  It is started from a file of this
package, never from the user's script, and ends when the process that started it does.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from concurrent.futures import Future
from pathlib import Path
from typing import TYPE_CHECKING

from iscat_analysis.threads import beside, processors

if TYPE_CHECKING:
    from iscat_analysis.records import Analysis


class Draughtsman:
    """The process, which is still to be started, and is ended by `close`."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._answer: Future[tuple[bytes, bytes | None]] | None = None

    def start(self) -> None:
        """Start it, once; not where this process has Matplotlib loaded, or none can be started."""
        if self._process is None and "matplotlib" not in sys.modules:
            self._process = _started()

    def begin(self, analysis: Analysis, folder: Path, most: int) -> bool:
        """Let it draw what `iscat_analysis.report.drawing.draw` would, once.

        Parameters
        ----------
        analysis : Analysis
            What was found.
        folder : Path
            An existing folder.
        most : int
            Events whose images are drawn, at most.

        Returns
        -------
        bool
            Whether it does.
        """
        if self._answer is not None or self._process is None or self._process.poll() is not None:
            return False
        order = pickle.dumps((analysis, folder, most), pickle.HIGHEST_PROTOCOL)
        self._answer = beside(self._process.communicate, order)
        return True

    def page(self) -> str | None:
        """Wait until all is drawn.

        Returns
        -------
        str or None
            The page; None where the process failed, and another has to draw.
        """
        if self._answer is None or self._process is None:
            return None
        page, _ = self._answer.result()
        return None if self._process.returncode else page.decode("utf-8")

    def close(self) -> None:
        """End the process, and its copy, whatever they are at."""
        if self._process is None:
            return
        if self._process.poll() is None:
            if sys.platform == "win32":
                self._process.kill()
            else:
                os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None and self._answer is None:
                pipe.close()


def _started() -> subprocess.Popen[bytes] | None:
    """Start the process, where there is a processor for it."""
    if processors() < 2 or not sys.executable or getattr(sys, "frozen", False):
        return None
    try:
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "iscat_analysis.report.drawing"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},  # a process with threads has no copies
            start_new_session=True,  # Ctrl-C is for the process that started it
        )  # fmt: skip
    except OSError:
        return None
