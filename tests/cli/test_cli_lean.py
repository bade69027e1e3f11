"""What no command uses of a library is not loaded, and is there for who asks for it."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from iscat_cli.lean import without


def _said(text: str) -> list[str]:
    command = [sys.executable, "-c", text]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()


def test_scipy_loads_no_compiler_of_fortran_and_who_asks_for_one_has_it() -> None:
    found = _said(
        "import sys\n"
        "from iscat_cli.lean import load_numpy\n"
        "load_numpy(); load_numpy()\n"
        "import scipy.special, scipy.ndimage, scipy.optimize\n"
        "inner = 'numpy.f2py.crackfortran', 'numpy.testing._private'\n"
        "print(*(name in sys.modules for name in inner))\n"
        "import numpy\n"
        "from numpy.testing import assert_allclose\n"
        "assert_allclose(scipy.special.ndtr(0.0), 0.5)\n"
        "print(numpy.testing.assert_allclose is assert_allclose, bool(numpy.f2py.get_include()))\n"
        "print(*(name in sys.modules for name in inner))\n"
    )
    assert found == ["False", "False", "True", "True", "True", "True"]


def test_an_optional_library_is_missing_for_a_while(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "optional_one.py").write_text("here = True\n")
    monkeypatch.syspath_prepend(tmp_path)
    with without("optional_one"), pytest.raises(ImportError):
        importlib.import_module("optional_one")
    module = importlib.import_module("optional_one")
    with without("optional_one"):  # somebody has loaded it
        assert importlib.import_module("optional_one") is module
    monkeypatch.delitem(sys.modules, "optional_one")
