"""Where work runs: in this process, or on the workers of a Dask cluster.

A job is a function at module level whose arguments can be pickled.  Movies of a day are jobs, and
chunks of a landing movie.  A worker does one job at a time with all of its threads, so that its
memory is that of one job, whatever else waits for it; the jobs of a lost worker go to another.
"""

from __future__ import annotations

import logging
import pickle
import platform
import re
import socket
import threading
import uuid
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from iscat_analysis.errors import ConfigError, DataError, SchedulerError
from iscat_analysis.reading import read_json
from iscat_analysis.records import Progress, silent
from iscat_analysis.threads import allotted

if TYPE_CHECKING:
    from distributed import Client

THREADS = "threads"
"""The scheduler that is this process."""

_PACKAGES = "numpy scipy scikit-image numba tifffile emcee arviz-stats pandas pyarrow matplotlib"
DEPENDENCIES = tuple(_PACKAGES.split())
"""Packages whose versions are part of a result."""

CONNECT_S = 4.0
_ADDRESS = re.compile(r"(?:tcp://)?(\[[^\]/]+\]|[^:/\[]+):(\d{1,5})/?", flags=re.ASCII)
_LOOK_S = 1.0  # between two looks at how many workers there are
_BUSY_S = 1.0  # that a job waits where its worker is busy, before it goes to another
_MOST_AT_ONCE = 1000
_BASE_MB = 400  # of a process, beside the pixels
_LIBRARIES = "iscat-analysis[dask]"

_installed = cache(version)  # read from folders, which takes a twentieth of a small run

T = TypeVar("T")
R = TypeVar("R")


def versions() -> dict[str, str]:
    """Tell the versions that results depend on."""
    return {
        "iscat-analysis": _installed("iscat-analysis"),
        "python": platform.python_version(),
        **{name: _installed(name) for name in DEPENDENCIES},
    }


class Executor:
    """Runs jobs in this process, one after the other."""

    distant = False
    """Whether jobs run in other processes, which read movies by their paths."""

    def call(self, job: Callable[..., R], /, *arguments: Any, progress: Progress = silent) -> R:
        """Do a job and wait for it."""
        return job(*arguments, progress=progress)

    def each(self, work: Callable[[T], R], items: Sequence[T]) -> Generator[tuple[int, R]]:
        """Apply a function to every item, in parallel where jobs run elsewhere."""
        for number, item in enumerate(items):
            yield number, work(item)

    def warnings(self, memory_limit_mb: int) -> list[str]:
        """List what the user should know before work begins."""
        del memory_limit_mb
        return []


class DaskExecutor(Executor):
    """The workers of a Dask cluster; `open_executor` connects to one."""

    distant = True

    def __init__(self, client: Client, address: str) -> None:
        self._client = client
        self._address = address
        self._live: set[Any] = set()
        self._stopped = False
        self._lock = threading.Lock()
        self._versions = versions()
        self._memory: dict[str, int] = {}

        def look(dask_worker: Any) -> dict[str, Any]:  # sent by value: all may be missing there
            try:
                from iscat_analysis.executors import versions

                found = versions()
            except ImportError:
                found = {"iscat-analysis": "missing"}
            return {"versions": found, "memory": dask_worker.memory_manager.memory_limit or 0}

        for worker, found in self._client.run(look).items():
            _compare(self._versions, found["versions"], worker)
            self._memory[worker] = found["memory"]

    def warnings(self, memory_limit_mb: int) -> list[str]:
        """Say which workers are missing or have too little memory; see `Executor`."""
        services = self._client.scheduler_info().get("services", {})
        link = self._client.dashboard_link if "dashboard" in services else None
        shown = [f"the dashboard of the cluster is {link}"] if link else []
        if not self._memory:
            return [*shown, f"{self._address} has no workers yet; the work begins with the first"]
        needed = memory_limit_mb + _BASE_MB
        least = min(self._memory, key=lambda worker: self._memory[worker] or float("inf"))
        megabytes = self._memory[least] / 1e6
        if 0 < megabytes < needed:
            shown.append(
                f"worker {least} may use {megabytes:.0f} MB of memory, and "
                f"compute.memory_limit_mb = {memory_limit_mb} with the program itself may take "
                f"{needed}: start workers with more, or lower compute.memory_limit_mb"
            )
        return shown

    def call(self, job: Callable[..., R], /, *arguments: Any, progress: Progress = silent) -> R:
        """Do a job on a worker; see `Executor`."""
        from distributed import KilledWorker

        del progress
        sent = pickle.dumps((job, arguments))
        name = job.__name__.strip("_")
        with self._lock:
            if self._stopped:
                raise SchedulerError("the work was stopped")
            future = self._client.submit(
                _work, self._versions, sent, pure=False, key=f"{name}-{uuid.uuid4().hex}"
            )
            self._live.add(future)
        try:
            received: R = pickle.loads(future.result())
        except KilledWorker as error:
            raise DataError(
                f"{error.allowed_failures + 1} workers of {self._address} ended while they were "
                "at it, most likely because it takes more memory than they have: give workers "
                "more, or lower compute.memory_limit_mb"
            ) from None
        except CancelledError:
            why = "the work was stopped" if self._stopped else "the connection was lost"
            raise SchedulerError(
                f"{self._address}: {why}; what is finished is kept, and the same command goes on"
            ) from None
        finally:
            with self._lock:
                self._live.discard(future)
            future.release()
        return received

    def each(self, work: Callable[[T], R], items: Sequence[T]) -> Generator[tuple[int, R]]:
        """Do something with every item, one for each worker at a time; see `Executor`."""
        waiting = deque(enumerate(items))
        running: dict[Future[R], int] = {}
        pool = ThreadPoolExecutor(_MOST_AT_ONCE, thread_name_prefix="job")
        try:
            while waiting or running:
                room = max(1, self._workers()) - len(running) if waiting else 0
                for _ in range(min(room, len(waiting))):
                    number, item = waiting.popleft()
                    running[pool.submit(work, item)] = number
                done, _ = wait(running, timeout=_LOOK_S, return_when=FIRST_COMPLETED)
                for future in done:
                    yield running.pop(future), future.result()
        finally:
            if running:
                self._stop()
            pool.shutdown(cancel_futures=True)

    def _stop(self) -> None:
        """Cancel unfinished jobs; the cluster itself keeps running."""
        with self._lock:
            self._stopped = True
            live = list(self._live)
        self._client.cancel(live)

    def _workers(self) -> int:
        try:
            return len(self._client.nthreads())
        except (OSError, TimeoutError):  # the jobs that are under way will tell
            return 0


def _compare(ours: dict[str, str], theirs: dict[str, str], worker: str) -> None:
    """Refuse a worker whose results would differ."""
    has = {name: theirs.get(name, "missing") for name in ours}
    other = [f"{name} {has[name]} (here {ours[name]})" for name in ours if has[name] != ours[name]]
    if has["iscat-analysis"] == "missing":
        other = [f"no iscat-analysis (here {ours['iscat-analysis']})"]
    if other:
        raise ConfigError(
            f"worker {worker} has {', '.join(other)}, so that results would depend on where they "
            "are made: start the workers in an environment like the one of this command"
        )


_BUSY = threading.Lock()


def _work(expected: dict[str, str], sent: bytes) -> bytes:
    """Do a job on a worker."""
    from distributed import Reschedule, get_worker

    worker = get_worker()
    _compare(expected, versions(), worker.address)
    key = worker.get_current_task()

    def stop() -> None:
        task = worker.state.tasks.get(key)
        if task is None or task.state == "cancelled":
            raise KeyboardInterrupt

    if not _BUSY.acquire(timeout=_BUSY_S):
        raise Reschedule
    try:
        job, arguments = pickle.loads(sent)
        with allotted(worker.state.nthreads, stop):
            return pickle.dumps(job(*arguments, progress=lambda *_: stop()))
    except KeyboardInterrupt:  # which would end the worker
        raise RuntimeError("cancelled") from None
    finally:
        _BUSY.release()


@contextmanager
def open_executor(
    scheduler: str = THREADS, scheduler_file: str | Path | None = None
) -> Iterator[Executor]:
    """Connect to where work shall run."""
    for name, value in (("scheduler", scheduler), ("scheduler_file", scheduler_file)):
        if value is not None and not isinstance(value, (str, Path)):
            raise ConfigError(f"`{name}` = {value!r}: give a text or a path")
    if scheduler_file is not None:
        if scheduler != THREADS:
            raise ConfigError(
                f"`scheduler` = {scheduler} and `scheduler_file` = {scheduler_file} name two "
                "places: give one"
            )
        scheduler = _address_in(Path(scheduler_file))
    elif scheduler == THREADS:
        yield Executor()
        return
    elif ":" not in scheduler:
        raise ConfigError(
            f'`scheduler` = {scheduler} must be "{THREADS}", or the address of the scheduler of a '
            "Dask cluster, as in tcp://10.0.0.1:8786"
        )
    logger = logging.getLogger("distributed.client")  # what it says is said here in one line
    level = logger.level
    client = _connected(scheduler)
    try:
        logger.setLevel(logging.CRITICAL)
        yield DaskExecutor(client, scheduler)
    finally:
        client.close()
        logger.setLevel(level)


def _address_in(path: Path) -> str:
    """Read the address that a scheduler left in a file."""
    advice = "give the file that `dask scheduler --scheduler-file` writes"
    try:
        return str(read_json(path)["address"])
    except OSError as error:
        raise ConfigError(
            f"`scheduler_file` = {path}: cannot be read ({error.strerror}); {advice}"
        ) from None
    except (ValueError, KeyError, TypeError):
        raise ConfigError(f"`scheduler_file` = {path}: holds no address; {advice}") from None


def _connected(address: str) -> Client:
    try:
        from distributed import Client
    except ImportError:
        raise ConfigError(
            f'`scheduler` = {address} needs Dask; install it with: pip install "{_LIBRARIES}"'
        ) from None
    _refuse_silence(address)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of versions, which are compared here
            return Client(address, timeout=CONNECT_S, set_as_default=False, name="iscat")
    except (OSError, TimeoutError, ValueError):
        raise _unanswered(address) from None


def _refuse_silence(address: str) -> None:
    """Refuse an address without a Dask scheduler, for which Dask would wait without end."""
    match = _ADDRESS.fullmatch(address)
    if match is None:
        raise ConfigError(
            f"`scheduler` = {address[:80]}: give the address of the scheduler of a Dask cluster as "
            "tcp://10.0.0.1:8786; encrypted and other connections are not supported"
        )
    try:
        with socket.create_connection((match[1].strip("[]"), int(match[2])), CONNECT_S) as line:
            line.settimeout(CONNECT_S)
            greets = bool(line.recv(1))  # a scheduler speaks first
    except (OSError, OverflowError, UnicodeError):
        greets = False
    if not greets:
        raise _unanswered(address)


def _unanswered(address: str) -> ConfigError:
    return ConfigError(
        f"`scheduler` = {address}: no Dask scheduler answers there; start one with "
        "`dask scheduler`, and check address and firewall"
    )
