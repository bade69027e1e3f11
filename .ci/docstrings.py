"""Check that every name of `iscat_analysis.__all__` has a whole numpydoc docstring.

So have the methods of public classes.  Names inside have a sentence; Ruff asks for that.
"""

from __future__ import annotations

import inspect
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

from numpydoc.validate import validate

import iscat_analysis

PROJECT = Path(__file__).resolve().parent.parent / "pyproject.toml"


def public_names() -> Iterator[tuple[str, set[str]]]:
    """Give the dotted names of what is public, and the checks that do not apply to it.

    A class describes its attributes, which are not always the parameters that make it.
    """
    for name in iscat_analysis.__all__:
        value = getattr(iscat_analysis, name)
        if inspect.isfunction(value):
            yield f"{value.__module__}.{value.__qualname__}", set()
        elif inspect.isclass(value):
            yield f"{value.__module__}.{value.__qualname__}", {"PR01", "PR02"}
            for own, member in vars(value).items():
                if inspect.isfunction(member) and not own.startswith("_"):
                    yield f"{value.__module__}.{member.__qualname__}", set()


def main() -> int:
    """Print what is missing; 1 where anything is."""
    settings = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["tool"]["numpydoc_validation"]
    not_asked = set(settings["checks"]) - {"all"}
    missing = [
        f"{name}: {code} {text}"
        for name, does_not_apply in public_names()
        for code, text in validate(name)["errors"]
        if code not in not_asked | does_not_apply
    ]
    print("\n".join(missing) or "public docstrings are whole")
    return bool(missing)


if __name__ == "__main__":
    sys.exit(main())
