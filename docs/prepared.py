"""Commands of the manual as copies of one process that has everything loaded.

A command takes seconds to load libraries and kernels, and most of those in the manual less for what
they do.  `prepared` makes a folder of programs, `iscat`, `iscat-fit` and `interpreter`, that hand
their arguments, folder, environment and streams to that process, and end with its copy's status.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import pkgutil
import socket
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Iterator
from pathlib import Path

FAILED = 70
INTERPRETER = "interpreter"
PROGRAMS = ("iscat", "iscat-fit", INTERPRETER)


@contextlib.contextmanager
def prepared(*, loads: bool = True) -> Iterator[Path]:
    """Start the process and give the folder of programs, for as long as the block lasts.

    Parameters
    ----------
    loads : bool
        Whether it loads everything before it answers.

    Yields
    ------
    Path
        To be put in front of the search path.
    """
    from blocks import SURROUNDINGS

    with tempfile.TemporaryDirectory() as name, socket.socket(socket.AF_UNIX) as listener:
        folder = Path(name)
        programs = folder / "programs"
        programs.mkdir()
        for program in PROGRAMS:
            client = f'exec "{sys.executable}" -IS "{__file__}" ask "{folder}/door" {program} "$@"'
            (programs / program).write_text(f"#!/bin/sh\n{client}\n", encoding="utf-8")
            (programs / program).chmod(0o755)
        listener.bind(f"{folder}/door")
        listener.listen()
        arguments = ["serve", str(listener.fileno()), *(["loaded"] if loads else [])]
        process = subprocess.Popen(
            [sys.executable, __file__, *arguments], pass_fds=[listener.fileno()],
            cwd=folder, stdin=subprocess.DEVNULL, env=os.environ | SURROUNDINGS,
        )  # fmt: skip
        try:
            yield programs
        finally:
            process.terminate()
            process.wait()


def ask(door: str, program: str, arguments: list[str]) -> int:
    """Have a program run by a copy, and give its status."""
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(door)
        socket.send_fds(connection, [b"\0"], [0, 1, 2])
        order = [program, arguments, str(Path.cwd()), dict(os.environ)]
        connection.sendall(json.dumps(order).encode())
        connection.shutdown(socket.SHUT_WR)
        status = connection.recv(1)
    return status[0] if status else FAILED


def serve(number: int) -> None:
    """Copy this process for each that asks at a listening socket."""
    with socket.socket(fileno=number) as listener:
        while True:
            connection, _ = listener.accept()
            if os.fork() == 0:
                listener.close()
                status = FAILED
                try:
                    status = _run(connection)
                except BaseException:  # noqa: BLE001  # told here, and by the status
                    traceback.print_exc()
                finally:
                    connection.sendall(bytes([status]))
                    os._exit(status)
            connection.close()
            with contextlib.suppress(ChildProcessError):
                while os.waitpid(-1, os.WNOHANG)[0]:
                    pass


def load() -> None:
    """Import everything, and do what loads the kernels of most commands."""
    import iscat_analysis
    import iscat_cli

    for package in (iscat_analysis, iscat_cli):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            __import__(module.name)
    sample = str(Path(__file__).parent.parent / "sample_configs" / "landing.toml")
    small = ["--quiet", "--config", sample, "--set", "simulation.frames=200"]
    for arguments in (
        ["simulate", *small, "--out", "movie.tif"],
        ["fit", "movie.tif", *small],
        ["bounds", *small],
    ):
        with contextlib.redirect_stdout(io.StringIO()):
            if iscat_cli.main(arguments):
                raise RuntimeError(f"iscat {' '.join(arguments)} failed")


def _run(connection: socket.socket) -> int:
    _, streams, _, _ = socket.recv_fds(connection, 1, 3)
    order = b"".join(iter(lambda: connection.recv(65536), b""))
    program, arguments, folder, environment = json.loads(order)
    for target, stream in enumerate(streams):
        os.dup2(stream, target)
        os.close(stream)
    sys.stdin, sys.stdout = open(0), open(1, "w")  # noqa: SIM115 - to the end of the process
    sys.stderr = open(2, "w", buffering=1)  # noqa: SIM115
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    status = 0
    if program == INTERPRETER:
        exec(*arguments, {})
    else:
        import iscat_cli

        run = {"iscat": iscat_cli.main, "iscat-fit": iscat_cli.main_fit}[program]
        status = run(arguments)
    sys.stdout.flush()
    return status


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["ask", door, program, *arguments]:
            raise SystemExit(ask(door, program, arguments))
        case ["serve", number, *rest]:
            if rest:
                load()
            serve(int(number))
