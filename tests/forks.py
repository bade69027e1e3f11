"""Processes of their own that have imported the package when they begin.

To import it takes two seconds of a processor.  A server does that once, in an interpreter that does
nothing else, and every process is a fork of it.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

IMPORTED = (
    "iscat_cli", "iscat_analysis.pipeline", "iscat_analysis.report.movie_page", "pytest",
    "distributed.cli.dask_scheduler", "distributed.cli.dask_worker",
)  # fmt: skip


def fork(
    work: Callable[..., Any], *arguments: Any, folder: Path, err: Path, out: Path = Path(os.devnull)
) -> BaseProcess:
    """Start a process that does some work in a folder and writes its streams into files.

    What the work returns is its status, ``exitcode``, which is negative where a signal ended it.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(IMPORTED))
    process = context.Process(target=_begin, args=(work, arguments, folder, out, err), daemon=True)
    process.start()
    return process


def _begin(
    work: Callable[..., Any], arguments: tuple[Any, ...], folder: Path, out: Path, err: Path
) -> None:
    """Do the work where and as it is to be done."""
    for number, path in ((1, out), (2, err)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    os.chdir(folder)
    sys.exit(work(*arguments))


def send(process: BaseProcess, number: int) -> None:
    """Send a signal, unless the process has ended."""
    if process.is_alive():
        assert process.pid is not None
        os.kill(process.pid, number)
