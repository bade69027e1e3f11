"""Movies over which somebody writes while they are read."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

PROGRAM = """
import os, sys
from concurrent.futures import ThreadPoolExecutor
from iscat_analysis.movie import open_stack
from iscat_cli.shrunk import explain_bus_errors

explain_bus_errors("iscat fit")
path, where = sys.argv[1:]
stack = open_stack(path)
counts = stack.in_place(0, 200).counts
print(counts[0, 0, 0], flush=True)
os.truncate(path, 4096)
if where == "thread":
    with ThreadPoolExecutor(1) as pool:
        pool.submit(counts.copy).result()
elif where == "copy" and (pid := os.fork()):
    print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
else:
    counts.sum()
"""


@pytest.mark.skipif(not hasattr(signal, "SIGBUS"), reason="the system has no bus errors")
@pytest.mark.parametrize("where", ["main", "thread", "copy"])
def test_who_touches_what_is_no_longer_there_says_why_it_ends(tmp_path: Path, where: str) -> None:
    path = tmp_path / "movie.npy"
    np.save(path, np.full((200, 64, 64), 7, dtype="<u2"))
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(path), where],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    if where == "copy":  # the first process goes on, and does the copy's work
        assert (ended.returncode, ended.stdout, ended.stderr) == (0, "7\n1\n", "")
        return
    assert (ended.returncode, ended.stdout) == (1, "7\n")
    assert ended.stderr == (
        "iscat fit: error: a file that is read became shorter; wait until it is written, then "
        "start again\n"
    )
