"""What is installed, and under which names."""

from __future__ import annotations

import email
import json
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

FRONT_ENDS = {
    "app": "iscat_app",
    "cli": "iscat_cli",
    "contest": "iscat_contest",
    "viewer": "iscat_napari",
}
"""Folder → the name it is installed under."""


@pytest.fixture(scope="module")
def project(repo_root: Path) -> dict:
    return tomllib.loads((repo_root / "pyproject.toml").read_text(encoding="utf-8"))


def test_packages_match_the_folders(repo_root: Path, project: dict) -> None:
    inits = (repo_root / "iscat_analysis").rglob("__init__.py")
    folders = {".".join(p.parent.relative_to(repo_root).parts) for p in inits}
    ours = folders | {*FRONT_ENDS.values()}
    assert set(project["tool"]["setuptools"]["packages"]) == ours


@pytest.mark.parametrize("name", [*FRONT_ENDS])
def test_a_front_end_has_no_packages_of_its_own(repo_root: Path, name: str) -> None:
    assert [p.parent.name for p in (repo_root / name).rglob("__init__.py")] == [name]


def test_every_non_python_file_is_package_data(repo_root: Path, project: dict) -> None:
    declared = project["tool"]["setuptools"]["package-data"]
    covered = {
        path
        for package, patterns in declared.items()
        for pattern in patterns
        for path in (repo_root / package.replace(".", "/")).glob(pattern)
    }
    found = {
        path
        for path in (repo_root / "iscat_analysis").rglob("*")
        if path.is_file() and path.suffix != ".py" and path.parent.name != "__pycache__"
    }
    assert found <= covered


def test_programs_point_at_functions(project: dict) -> None:
    import iscat_cli

    for target in project["project"]["scripts"].values():
        module, _, function = target.partition(":")
        assert module == "iscat_cli"
        assert callable(getattr(iscat_cli, function))


def test_the_name_cli_is_not_claimed(tmp_path: Path) -> None:
    code = (
        "import importlib.util as u, json; "
        "print(json.dumps([u.find_spec(n) is not None for n in ('cli', 'tests', 'iscat_cli')]))"
    )
    answer = subprocess.run(
        [sys.executable, "-I", "-c", code], cwd=tmp_path, capture_output=True, check=True
    )
    assert json.loads(answer.stdout) == [False, False, True]


def test_the_wheel_holds_what_the_folders_hold(repo_root: Path, tmp_path: Path) -> None:
    # setuptools litters the folder it builds in, so a copy is built.
    source = tmp_path / "source"
    source.mkdir()
    for name in ("iscat_analysis", *FRONT_ENDS):
        shutil.copytree(
            repo_root / name, source / name, ignore=shutil.ignore_patterns("__pycache__")
        )
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(repo_root / name, source)
    code = f"from setuptools.build_meta import build_wheel; print(build_wheel({str(tmp_path)!r}))"
    subprocess.run([sys.executable, "-c", code], cwd=source, capture_output=True, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        metadata = next(name for name in names if name.endswith("/METADATA"))
        described = email.message_from_bytes(archive.read(metadata))
    expected = {
        (Path(FRONT_ENDS.get(name, name)) / path.relative_to(repo_root / name)).as_posix()
        for name in ("iscat_analysis", *FRONT_ENDS)
        for path in (repo_root / name).rglob("*.py")
    }
    assert expected == {name for name in names if name.endswith(".py")}
    assert {"iscat_analysis/py.typed", "iscat_napari/napari.yaml"} <= names
    assert described["License-Expression"] == "BSD-3-Clause"
