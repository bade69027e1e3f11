"""What a maintainer must know, in numbers that may fall and not rise.

    size.py             table by room, and the totals
    size.py --check     status 1 if a room, or the whole, is above .ci/budget.json
    size.py --write     write .ci/budget.json; a rise needs a reason in the commit

Code is every line with a token that is neither comment nor docstring; tokens cannot be lowered by
longer lines.  A room is a folder of the library, or a package beside it.
"""

from __future__ import annotations

import ast
import io
import json
import re
import sys
import tokenize
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BUDGET = ROOT / ".ci" / "budget.json"
PACKAGES = {
    "iscat_analysis": "iscat_analysis",
    "cli": "iscat_cli",
    "app": "iscat_app",
    "viewer": "iscat_napari",
    "contest": "iscat_contest",
}
"""Folders, and the names under which they are installed."""

NUMBERS = (
    "files", "code", "tokens", "many parameters", "long functions", "constants", "one importer",
    "kind tests", "warn calls", "fmt: skip",
)  # fmt: skip
MANY_PARAMETERS, LONG = 8, 80

_LAYOUT = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
    tokenize.ENDMARKER, tokenize.ENCODING,
}  # fmt: skip
_KIND = re.compile(
    r"(mode|scheme|heading|background_mode|\.method|tracked|is_sized|is_measured|is_sphere|additive)\b"
    r"\s*(==|!=|in \(|in \{|not in)|\bif (not )?[\w.]*(tracked|is_sized|is_measured|is_sphere)\b"
)
_WARN = re.compile(r"\b(run\.)?(warn|notify)\(")
_NUMERIC = (ast.Constant, ast.BinOp, ast.UnaryOp, ast.operator, ast.unaryop)


class Module:
    """One file of the packages, as source, tree and name."""

    def __init__(self, package: str, path: Path) -> None:
        self.path, self.text = path, path.read_text(encoding="utf-8")
        self.tree = ast.parse(self.text)
        parts = path.relative_to(ROOT / package).with_suffix("").parts
        self.is_package = parts[-1] == "__init__"
        self.name = ".".join((PACKAGES[package], *parts)).removesuffix(".__init__")
        self.room = parts[0] if package == "iscat_analysis" and len(parts) > 1 else package

    def numbers(self) -> Counter[str]:
        """Count everything that one file says alone."""
        docstrings = {
            line
            for node in ast.walk(self.tree)
            if isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
            for line in range(node.lineno, (node.end_lineno or 0) + 1)
        }
        found, code = Counter(files=1), set()
        for token in tokenize.generate_tokens(io.StringIO(self.text).readline):
            if token.type not in _LAYOUT and token.start[0] not in docstrings:
                found["tokens"] += 1
                code.update(range(token.start[0], token.end[0] + 1))
            found["fmt: skip"] += token.type == tokenize.COMMENT and "fmt: skip" in token.string
        source = "\n".join(
            line for number, line in enumerate(self.text.splitlines(), 1) if number in code
        )
        found["code"] = len(code)
        found["kind tests"] = len(_KIND.findall(source))
        found["warn calls"] = len(_WARN.findall(source))
        for node in ast.walk(self.tree):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                found["many parameters"] += _parameters(node) >= MANY_PARAMETERS
                found["long functions"] += (node.end_lineno or 0) - node.lineno > LONG
        found["constants"] = sum(_is_constant(node) for node in self.tree.body)
        return found

    def imported(self) -> Iterator[str]:
        """Give the names that the file imports, modules and what is in them."""
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module:
                yield node.module
                yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Count the parameters of a function but for `self`."""
    places = [*function.args.posonlyargs, *function.args.args]
    bound = bool(places) and places[0].arg in ("self", "cls")
    return len(places) + len(function.args.kwonlyargs) - bound


def _is_constant(node: ast.stmt) -> bool:
    """Tell whether a statement of a module gives a capital name to numbers alone."""
    targets = getattr(node, "targets", [getattr(node, "target", None)])
    value = getattr(node, "value", None)
    if not isinstance(node, (ast.Assign, ast.AnnAssign)) or value is None:
        return False
    parts = list(ast.walk(value))
    numeric = all(isinstance(part, _NUMERIC) for part in parts) and any(
        isinstance(part, ast.Constant) and type(part.value) in (int, float) for part in parts
    )
    return numeric and any(isinstance(t, ast.Name) and t.id.isupper() for t in targets)


def measured() -> dict[str, Counter[str]]:
    """Count the numbers of every room."""
    modules = [
        Module(package, path)
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
    ]
    names = {module.name for module in modules}
    importers: dict[str, set[str]] = defaultdict(set)
    rooms: dict[str, Counter[str]] = defaultdict(Counter)
    for module in modules:
        rooms[module.room].update(module.numbers())
        for name in names.intersection(module.imported()) - {module.name}:
            importers[name].add(module.name)
    for module in modules:
        rooms[module.room]["one importer"] += (
            len(importers[module.name]) == 1 and not module.is_package
        )
    return dict(rooms)


def main() -> int:
    """Print, check or write the numbers."""
    rooms = measured()
    rooms["ALL"] = sum(rooms.values(), Counter())
    if "--write" in sys.argv:
        ordered = {room: {n: rooms[room][n] for n in NUMBERS} for room in sorted(rooms)}
        lines = (f"  {json.dumps(room)}: {json.dumps(ordered[room])}" for room in ordered)
        BUDGET.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    if "--check" not in sys.argv:
        print(f"{'room':16}" + "".join(f"{name:>16}" for name in NUMBERS))
        for room in sorted(rooms, key=lambda room: rooms[room]["code"]):
            print(f"{room:16}" + "".join(f"{rooms[room][name]:16}" for name in NUMBERS))
        return 0
    budget = json.loads(BUDGET.read_text(encoding="utf-8"))
    risen = [
        f"{room}: {name} {budget.get(room, {}).get(name, 0)} → {numbers[name]}"
        for room, numbers in rooms.items()
        for name in NUMBERS
        if numbers[name] > budget.get(room, {}).get(name, 0)
    ]
    if risen:
        print("Above .ci/budget.json; take out as much, or `.ci/size.py --write` and say why:")
        print("\n".join(risen))
    return bool(risen)


if __name__ == "__main__":
    sys.exit(main())
