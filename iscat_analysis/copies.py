"""Copies of this process, which do what they are asked.

A copy shares the memory of the first process and has nothing to load.  It asks for no input, writes
nothing but its results, ignores interrupts, which are the first one's business, and ends with it.
On systems other than Linux a copy of a process with threads may not go on.
"""

from __future__ import annotations

import gc
import io
import os
import pickle
import queue
import signal
import struct
import sys
import threading
import warnings
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import IO, Any, NoReturn, TypeVar

T = TypeVar("T")

_LENGTH = struct.Struct("<Q")


class LostError(Exception):
    """The other process has ended."""


class Copy:
    """A copy of this process, which leads a group of processes with those that it starts."""

    def __init__(self, work: Callable[[Any], Any]) -> None:
        theirs, asking = os.pipe()
        telling, answers = os.pipe()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # that there are other threads
            try:
                self.pid = os.fork()
            except OSError:
                for pipe in (theirs, asking, telling, answers):
                    os.close(pipe)
                raise
        if not self.pid:
            _serve(work, theirs, answers, (asking, telling))
        with suppress(OSError):  # it has ended
            os.setpgid(self.pid, self.pid)
        os.close(theirs)
        os.close(answers)
        self._ended = False
        self._asking, self._telling = os.fdopen(asking, "wb"), os.fdopen(telling, "rb")

    def do(self, asked: Any) -> Any:
        """Have it do something, and wait for that."""
        self.ask(asked)
        try:
            failed, result = _received(self._telling)
        except (OSError, EOFError):
            raise LostError from None
        if failed:
            raise result
        return result

    def ask(self, asked: Any) -> None:
        """Have it do something, and do not wait for that; nothing can be had from it afterwards."""
        try:
            _send(self._asking, asked)
        except OSError:
            raise LostError from None

    def end(self) -> None:
        """End it and its group, whatever they are at; once, as its number may then be another's."""
        if self._ended:
            return
        self._ended = True
        with suppress(OSError):  # somebody else has buried it
            os.killpg(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)

    def close(self) -> None:
        """Close what led to it."""
        for pipe in (self._asking, self._telling):
            with suppress(OSError):
                pipe.close()


def aside(work: Callable[[], T]) -> Future[T]:
    """Begin work in a copy of this process, which then ends."""
    copy = Copy(lambda _: work())
    done: Future[T] = Future()

    def answer() -> None:
        try:
            done.set_result(copy.do(None))
        except Exception as error:  # noqa: BLE001  # raised where the result is asked for
            done.set_exception(error)
        copy.end()  # which takes 20 ms, and nothing waits for it
        copy.close()

    threading.Thread(target=answer, daemon=True, name="aside").start()
    return done


def _send(pipe: IO[bytes], value: Any) -> None:
    sent = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
    pipe.write(_LENGTH.pack(len(sent)))
    pipe.write(sent)
    pipe.flush()


def _received(pipe: IO[bytes]) -> Any:
    (length,) = _LENGTH.unpack(_exactly(pipe, _LENGTH.size))
    return pickle.loads(_exactly(pipe, length))


def _exactly(pipe: IO[bytes], length: int) -> bytes:
    part = pipe.read(length)
    if len(part) < length:
        raise EOFError
    return part


def _serve(
    work: Callable[[Any], Any], asked: int, answers: int, others: tuple[int, int]
) -> NoReturn:
    """Do what is asked for, as a copy, until nobody asks any more."""
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        gc.freeze()  # what belongs to the other process is not for this one to end
        sys.stdout = sys.stderr = io.StringIO()
        for pipe in others:
            os.close(pipe)
        waiting: queue.SimpleQueue[Any] = queue.SimpleQueue()

        def listen() -> None:
            try:
                with os.fdopen(asked, "rb") as pipe:
                    while True:
                        waiting.put(_received(pipe))
            finally:
                os._exit(0)  # in the middle of something, too: nobody waits for it

        threading.Thread(target=listen, daemon=True).start()
        with os.fdopen(answers, "wb") as out:
            while True:
                wanted = waiting.get()
                try:
                    result = False, work(wanted)
                except Exception as error:  # noqa: BLE001  # for the other process to raise
                    result = True, error
                _send(out, result)
    finally:
        os._exit(1)
