"""Memory of a process and of those it has made."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from pathlib import Path

LOOK_S = 0.1
"""Between two looks at how much memory a job has."""

_LOOKS_PER_MAP = 30
"""Looks for each at the maps of files, which takes a tenth of a second of a processor."""


class Memory(threading.Thread):
    """Looks at the memory of a process and of those it has made, until it ends.

    What several of them share is divided among them.  Pages of the movie are left out: they are the
    system's, which keeps them for whoever reads the file, and does not charge for them a group of
    processes that finds them there.  Other files, as of libraries, hardly change.
    """

    def __init__(self, pid: int, movie: Path) -> None:
        super().__init__(daemon=True)
        self._pid = pid
        self._movie = movie
        self._of_files_mb: dict[int, float] = {}
        self.peak_mb = 0.0

    def run(self) -> None:
        """Keep the largest sum."""
        looks = 0
        while Path(f"/proc/{self._pid}/status").exists():
            family = _family(self._pid)
            for pid in family:
                if looks % _LOOKS_PER_MAP == 0 or pid not in self._of_files_mb:
                    self._of_files_mb[pid] = _of_files_mb(pid, self._movie)
            held = sum(_own_mb(pid) + self._of_files_mb[pid] for pid in family)
            self.peak_mb = max(self.peak_mb, held)
            looks += 1
            time.sleep(LOOK_S)


def _family(pid: int) -> list[int]:
    found = [pid]
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                found += _family(int(child))
    return found


def _own_mb(pid: int) -> float:
    """Memory that is of no file."""
    with suppress(OSError):
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
        named = dict(line.split()[:2] for line in lines[1:])
        return (float(named["Pss_Anon:"]) + float(named["Pss_Shmem:"])) * 1024 / 1e6
    return 0.0


def _of_files_mb(pid: int, movie: Path) -> float:
    """Pages of files, but for those of the movie's folder."""
    total, counted = 0.0, False
    with suppress(OSError):
        for line in Path(f"/proc/{pid}/smaps").read_text().splitlines():
            name, *rest = line.split()
            if not name.endswith(":"):  # of the next mapping, which ends with its file
                counted = len(rest) > 4 and not rest[-1].startswith(str(movie.resolve().parent))
            elif name == "Pss:" and counted:
                total += float(rest[0]) * 1024 / 1e6
            elif name == "Anonymous:" and counted:
                total -= float(rest[0]) * 1024 / 1e6
    return total
