"""Find the code blocks of the manual, run them in order, and keep their output.

A page's ``console`` blocks (lines that begin with ``$``) and ``python`` blocks are run one after
the other in one folder, the Python blocks with names of their own in an interpreter that serves
page after page.  A line that is one `iscat` or `iscat-fit` command, perhaps with ``> FILE``, runs
there too, through the function that the installed program calls, so that the library is loaded
once.  Every other line runs in a shell.  Comments in the page control this:

``<!-- not run: REASON -->``
    before a block that cannot be run.
``<!-- first: COMMAND -->``
    before a block: a command that is run but not shown.
``<!-- keep: NAME -->``
    before a block whose output the manual shows, as ``_build/generated/PAGE/NAME.txt``.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

FENCE = re.compile(r"^(?P<indent> *)(?P<ticks>```+)(?P<language>[^`]*?)\s*$")
COMMENT = re.compile(r"^ *<!-- (?P<kind>not run|first|keep): (?P<text>.*?) -->$")
RUNNABLE = ("console", "python")
FUNCTIONS = {"iscat": "main", "iscat-fit": "main_fit"}
"""Functions of `iscat_cli` that the installed programs call."""
SHELL = set("|&;<>$`*?~")
"""Characters for which a line needs a shell, wherever they stand."""
SURROUNDINGS = {
    "MPLBACKEND": "Agg",
    "COLUMNS": "100",
    "PYTHONWARNINGS": "error",
    "OPENBLAS_NUM_THREADS": "1",
}
"""Variables of the environment in which blocks run."""


@dataclass(frozen=True)
class Block:
    """One fenced block of a page."""

    line: int
    language: str
    text: str
    first: tuple[str, ...] = ()
    not_run: str | None = None
    keep: str | None = None

    @property
    def commands(self) -> list[str]:
        """Commands for the shell: the lines after ``$``, continued if they end in a backslash."""
        found: list[str] = []
        going_on = False
        for line in self.text.splitlines():
            if going_on:
                found[-1] += "\n" + line
            elif line.startswith("$ "):
                found.append(line[2:])
            else:
                continue
            going_on = line.endswith("\\")
        return found


@dataclass
class Outcome:
    """Output of a block."""

    block: Block
    out: str = ""
    failed: str | None = None


def blocks_of(page: Path) -> Iterator[Block]:
    """Find the console and Python blocks of a page."""
    lines = iter(enumerate(page.read_text(encoding="utf-8").splitlines(), start=1))
    first: list[str] = []
    not_run: str | None = None
    keep: str | None = None
    for number, line in lines:
        comment, fence = COMMENT.match(line), FENCE.match(line)
        if comment and comment["kind"] == "first":
            first.append(comment["text"])
        elif comment and comment["kind"] == "keep":
            keep = comment["text"]
        elif comment:
            not_run = comment["text"]
        elif fence:
            body = []
            for _, inner in lines:
                if inner.strip() == fence["ticks"]:
                    break
                body.append(inner.removeprefix(fence["indent"]))
            if fence["language"] in RUNNABLE:
                text = "\n".join(body)
                yield Block(number, fence["language"], text, tuple(first), not_run, keep)
            first, not_run, keep = [], None, None


def run_page(page: Path, folder: Path, interpreter: Interpreter) -> list[Outcome]:
    """Run a page's blocks in a folder and stop at the first that fails.

    Parameters
    ----------
    page : Path
        Markdown.
    folder : Path
        Folder to run in; it should contain the files that `prepare` copies.
    interpreter : Interpreter
        Python to run in; it forgets the names of the page before.

    Returns
    -------
    list of Outcome
        One for each block that was run.
    """
    interpreter.run("begin", str(folder))
    outcomes = []
    for block in blocks_of(page):
        if block.not_run is not None:
            continue
        outcome = Outcome(block)
        outcomes.append(outcome)
        shown = block.commands if block.language == "console" else []
        for command in (*block.first, *shown):
            out, failed = _run_command(command, folder, interpreter)
            outcome.out += out if command in shown else ""
            if failed is not None:
                outcome.failed = f"{command}\n{out}{failed}"
                return outcomes
        if block.language == "python":
            outcome.out, outcome.failed = interpreter.run("python", block.text)
            if outcome.failed:
                return outcomes
    return outcomes


def _run_command(command: str, folder: Path, interpreter: Interpreter) -> tuple[str, str | None]:
    """Run a line; return its output, and what it said besides if it failed."""
    if found := _call_of(command):
        call, target = found
        out, failed = interpreter.run(*call)
        if target:
            (folder / target).write_text(out, encoding="utf-8")
            out = ""
        return out, failed
    done = subprocess.run(
        ["bash", "-e", "-o", "pipefail", "-c", command],
        cwd=folder, env=interpreter.environment, text=True, check=False,
        stdin=subprocess.DEVNULL, capture_output=True,
    )  # fmt: skip
    return done.stdout, done.stderr if done.returncode else None


def _call_of(command: str) -> tuple[list[str], str] | None:
    """Find function and arguments of a line that is one command, and the file for its output."""
    line, _, target = command.replace("\\\n", " ").partition(" > ")
    if SHELL & set(line + target):
        return None
    program, *arguments = shlex.split(line)
    return ([FUNCTIONS[program], *arguments], target) if program in FUNCTIONS else None


class Interpreter:
    """A Python process that runs blocks and commands of the package, one after the other.

    Parameters
    ----------
    bin_folder : Path
        Folder of `iscat` and `python`.
    """

    LOOP = """
import contextlib, gc, io, json, os, sys, traceback

gc.set_threshold(50_000)
names = {}
lines, sys.stdin = sys.stdin, open(os.devnull)

def run(kind, *given):
    if kind == "begin":
        os.chdir(*given)
        names.clear()
        names["__name__"] = "__main__"
    elif kind == "python":
        exec(compile(*given, "<block>", "exec"), names)
    else:
        import iscat_cli
        if status := getattr(iscat_cli, kind)(given):
            raise SystemExit(f"exit status {status}")

for line in lines:
    said, failed = io.StringIO(), None
    with contextlib.redirect_stdout(said):
        try:
            run(*json.loads(line))
        except BaseException:
            failed = traceback.format_exc()
    print(json.dumps([said.getvalue(), failed]), flush=True)
"""

    def __init__(self, bin_folder: Path) -> None:
        path = os.pathsep.join([str(bin_folder), os.environ["PATH"]])
        self.environment = os.environ | SURROUNDINGS | {"PATH": path}
        self._python = bin_folder / "python"

    def __enter__(self) -> Interpreter:
        self._errors = tempfile.TemporaryFile("w+")
        self._process = subprocess.Popen(
            [str(self._python), "-c", self.LOOP], env=self.environment, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors,
        )  # fmt: skip
        return self

    def run(self, kind: str, *given: str) -> tuple[str, str | None]:
        """Run a block (``"python"``), or a function of `iscat_cli` with its arguments.

        ``"begin"`` goes to the folder of another page.  Returns the output, and, if it failed, what
        was said on stderr with the traceback.
        """
        process = self._process
        if process.stdin is None or process.stdout is None:
            raise RuntimeError("the interpreter has no pipes")
        process.stdin.write(json.dumps([kind, *given]) + "\n")
        process.stdin.flush()
        answer = process.stdout.readline()
        out, failed = json.loads(answer) if answer else ("", "the interpreter ended")
        if failed is not None:
            self._errors.seek(0)
            failed = self._errors.read() + failed
        return out, failed

    def __exit__(self, *_: object) -> None:
        self._process.communicate(timeout=60)
        self._errors.close()


def main() -> None:
    """Run the pages named on the command line, each in its own folder, and print their output."""
    import shutil

    root = Path(__file__).resolve().parent.parent
    failures = 0
    with Interpreter(Path(sys.executable).parent) as interpreter:
        for name in sys.argv[1:]:
            with tempfile.TemporaryDirectory() as folder:
                prepare(root, Path(folder))
                for outcome in run_page(Path(name), Path(folder), interpreter):
                    head = f"{name}:{outcome.block.line}"
                    sys.stdout.write(f"== {head}\n{outcome.out}{outcome.failed or ''}\n")
                    failures += outcome.failed is not None
                if kept := os.environ.get("KEEP"):
                    shutil.copytree(folder, kept, dirs_exist_ok=True)
    raise SystemExit(failures)


def prepare(root: Path, folder: Path) -> None:
    """Copy the files that every page needs into a folder: the samples of the checkout."""
    for name in ("sample_configs", "docs/tutorial.toml"):
        source, target = root / name, folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            target.mkdir(exist_ok=True)
            for path in source.glob("*.toml"):
                (target / path.name).write_bytes(path.read_bytes())
        else:
            target.write_bytes(source.read_bytes())


if __name__ == "__main__":
    main()
