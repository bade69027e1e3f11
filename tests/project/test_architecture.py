"""The house rules that a linter does not know, checked on the syntax tree."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted(
    p
    for room in ("iscat_analysis", "app", "cli", "contest", "viewer")
    for p in (ROOT / room).rglob("*.py")
)
TREES = {path: ast.parse(path.read_text(encoding="utf-8"), str(path)) for path in SOURCES}

# The generator interface of numpy.random is its only part without hidden state.
STATELESS = {"default_rng", "Generator", "SeedSequence", "BitGenerator", "PCG64", "Philox"}
STATELESS |= {"RandomState"}  # a seeded one of its own: emcee takes no Generator


def _where(path: Path, node: ast.AST) -> str:
    return f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}"


def _nodes(*kinds: type[ast.AST]) -> Iterator[tuple[Path, ast.AST]]:
    for path, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, kinds):
                yield path, node


def _public_functions() -> Iterator[tuple[Path, ast.FunctionDef]]:
    """Functions of modules and methods of classes whose whole path is public."""

    def inside(body: list[ast.stmt]) -> Iterator[ast.FunctionDef]:
        for node in body:
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
                yield node
            elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                yield from inside(node.body)

    for path, tree in TREES.items():
        for function in inside(tree.body):
            yield path, function


def _dotted(node: ast.AST) -> str:
    if isinstance(node, ast.Attribute):
        return f"{_dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def test_no_assert_guards_the_user() -> None:
    assert [_where(*found) for found in _nodes(ast.Assert)] == []


def test_no_bare_except() -> None:
    handlers = _nodes(ast.ExceptHandler)
    assert [_where(p, n) for p, n in handlers if getattr(n, "type", None) is None] == []


def test_no_catch_all_keywords() -> None:
    """Keywords may stand in a group that names and types each of them (`typing.Unpack`)."""
    open_ended = [
        _where(path, function)
        for path, function in _public_functions()
        if (rest := function.args.kwarg) is not None
        and not (rest.annotation and ast.unparse(rest.annotation).startswith("Unpack["))
    ]
    assert open_ended == []


def test_no_global_random_state() -> None:
    offenders = [
        _where(path, node)
        for path, node in _nodes(ast.Attribute)
        if (match := re.fullmatch(r"(?:np|numpy)\.random\.(\w+)", _dotted(node)))
        and match[1] not in STATELESS
    ]
    offenders += [
        _where(path, node)
        for path, node in _nodes(ast.Import)
        if any(name.name == "random" for name in getattr(node, "names", []))
    ]
    assert offenders == []


def test_every_public_function_says_what_it_does() -> None:
    assert [_where(p, f) for p, f in _public_functions() if not ast.get_docstring(f)] == []


def test_no_print_in_the_library() -> None:
    offenders = [
        _where(path, node)
        for path, node in _nodes(ast.Call)
        if _dotted(getattr(node, "func", node)) == "print" and path.is_relative_to(ROOT)
    ]
    assert offenders == []


def test_every_module_has_a_place_in_the_layers() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    layers = " ".join(project["tool"]["importlinter"]["contracts"][0]["layers"])
    placed = set(re.findall(r"iscat_analysis\.(\w+)", layers))
    present = {
        path.stem if path.is_file() else path.name
        for path in (ROOT / "iscat_analysis").iterdir()
        if (path.suffix == ".py" and path.stem != "__init__") or (path / "__init__.py").is_file()
    }
    assert present - placed == set()


def _tracked_text() -> Iterator[tuple[Path, str]]:
    listing = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, capture_output=True, check=False,
    )  # fmt: skip
    if listing.returncode:
        pytest.skip("not a git checkout: there is no list of the files that belong to it")
    for name in listing.stdout.decode().split("\0"):
        path = ROOT / name
        if name and path.is_file() and path.stat().st_size < 1_000_000:
            try:
                yield path, path.read_text(encoding="utf-8")
            except UnicodeDecodeError:
                continue


def test_no_file_names_a_machine_or_a_registry() -> None:
    # Written in pieces, so that this file does not match itself.
    homes = "|".join(("work", "root", "farm", "home", "Users"))
    hosts = "|".join(
        ("py" + r"pi\.org", "python" + "hosted", "npm" + r"js\.org", "deb" + r"ian\.org")
    )
    forbidden = re.compile(
        rf"(?:^|[^A-Za-z0-9_.])/(?:{homes})/[a-z]|{hosts}|index" + "-url|/sim" + "ple/", re.M
    )
    offenders = [
        f"{path.relative_to(ROOT)}: {match[0].strip()}"
        for path, text in _tracked_text()
        if (match := forbidden.search(text))
    ]
    assert offenders == []


def test_golden_copies_are_the_originals(shared_dir: Path, golden_dir: Path) -> None:
    originals = shared_dir / "golden"
    if not originals.is_dir():
        pytest.skip(f"no golden data beside the checkout: {originals} is absent")
    for copy in golden_dir.glob("*.json"):
        assert copy.read_bytes() == (originals / copy.name).read_bytes(), copy.name


def test_a_movie_is_prepared_at_one_door() -> None:
    steps = {"resolve_metadata", "with_camera", "find_stretches", "judge_light", "survey_noise"}
    door = {
        ROOT / "iscat_analysis" / "diagnosis" / f"{name}.py" for name in ("calibrated", "noise")
    }
    calls = [
        (path, node)
        for path, node in _nodes(ast.Call)
        if isinstance(node, ast.Call) and _dotted(node.func).rpartition(".")[2] in steps
    ]
    assert {_dotted(node.func).rpartition(".")[2] for _, node in calls} == steps
    assert [_where(path, node) for path, node in calls if path not in door] == []


ROOT_HOLDS = {
    ".ci", ".github", ".gitignore", ".typing", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md",
    "LICENSE", "Makefile", "README.md", "SECURITY.md", "app", "benchmarks", "cli", "contest",
    "docs", "iscat_analysis", "pyproject.toml", "sample_configs", "tests", "viewer",
}  # fmt: skip


def test_nothing_lies_about_in_the_root() -> None:
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip("no checkout of git")
    assert {line.split("/")[0] for line in listed.stdout.splitlines()} == ROOT_HOLDS


def test_the_contest_uses_public_names_of_the_library() -> None:
    """A name is public in a module above the rooms, or where a room exports it."""
    hidden = []
    for path in sorted((ROOT / "contest").glob("*.py")):
        for node in ast.walk(TREES[path]):
            if not isinstance(node, ast.ImportFrom) or not node.module:
                continue
            package, *inside = node.module.split(".")
            if package != "iscat_analysis":
                continue
            room = importlib.import_module(node.module)
            names = [alias.name for alias in node.names]
            offered = [n for n in names if len(inside) < 2 and n[0] != "_" and hasattr(room, n)]
            hidden += [f"{_where(path, node)} {n}" for n in names if n not in offered]
    assert hidden == []
