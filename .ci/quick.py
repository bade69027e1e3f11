"""Judge a change soon: style, types, and the tests of the rooms that changed or import such a room.

    quick.py [COMMIT]       default: what is not committed

A room is a folder of the library, or a package beside it; its tests are in ``tests/<room>``.  Of
other rooms those tests are run that import a room that changed.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = {
    "cli": "iscat_cli",
    "app": "iscat_app",
    "contest": "iscat_contest",
    "viewer": "iscat_napari",
}


def room_of(path: Path) -> str:
    """Name the room of a file of the library, of a package or of the tests; empty elsewhere."""
    parts = path.parts
    if parts[0] in ("iscat_analysis", "tests"):
        return parts[1] if len(parts) > 2 else "project"
    return parts[0] if parts[0] in PACKAGES else ""


def rooms_imported(path: Path) -> set[str]:
    """Name the rooms that a file imports."""
    names = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            names += [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
    found = {name.split(".")[1] for name in names if name.startswith("iscat_analysis.")}
    return found | {room for room, package in PACKAGES.items() if f"{package}." in " ".join(names)}


def main() -> int:
    """Judge what changed; the status of the first step that fails."""
    commit = sys.argv[1] if len(sys.argv) > 1 else "HEAD"
    listed = ["git", "diff", "--name-only", commit], ["git", "ls-files", "-o", "--exclude-standard"]
    changed = {
        Path(line)
        for command in listed
        for line in subprocess.check_output(command, cwd=ROOT, text=True).splitlines()
    }
    rooms = {room_of(path) for path in changed if path.suffix == ".py"} - {""}
    tests = {test for test in (ROOT / "tests").rglob("test_*.py") if test.parent.name in rooms}
    for test in (ROOT / "tests").rglob("test_*.py"):
        if rooms & rooms_imported(test):
            tests.add(test)
    steps = [["ruff", "check", "."], ["ruff", "format", "--check", "."], ["mypy"], ["lint-imports"]]
    if tests:
        names = sorted(str(test.relative_to(ROOT)) for test in tests)
        steps.append(["pytest", "-q", "-n", "auto", "--dist", "loadfile", *names])
    for step in steps:
        if status := subprocess.run(
            [str(Path(sys.executable).parent / step[0]), *step[1:]], cwd=ROOT
        ).returncode:
            return status
    return 0


if __name__ == "__main__":
    sys.exit(main())
