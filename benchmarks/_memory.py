"""Memory of a process and of those it has made."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from pathlib import Path

LOOK_S = 0.1
"""Between two looks at how much memory a job has."""


class Memory(threading.Thread):
    """Looks at the memory of a process and of those it has made, until it ends.

    What several of them share is divided among them.  Pages of the movie are left out: they are the
    system's, which keeps them for whoever reads the file, and does not charge for them a group of
    processes that finds them there.
    """

    def __init__(self, pid: int, movie: Path) -> None:
        super().__init__(daemon=True)
        self._pid = pid
        self._movie = str(movie)
        self.peak_mb = 0.0

    def run(self) -> None:
        """Keep the largest sum."""
        while Path(f"/proc/{self._pid}/status").exists():
            held = sum(_memory_mb(pid, self._movie) for pid in _family(self._pid))
            self.peak_mb = max(self.peak_mb, held)
            time.sleep(LOOK_S)


def _family(pid: int) -> list[int]:
    found = [pid]
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                found += _family(int(child))
    return found


def _memory_mb(pid: int, movie: str) -> float:
    total, counted = 0.0, True
    with suppress(OSError):
        for line in Path(f"/proc/{pid}/smaps").read_text().splitlines():
            name, *rest = line.split()
            if not name.endswith(":"):  # of the next mapping, which ends with its file
                counted = not line.endswith(movie)
            elif name == "Pss:" and counted:
                total += float(rest[0]) * 1024 / 1e6
    return total
