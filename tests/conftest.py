"""What every test may use."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from hypothesis import settings

ROOT = Path(__file__).resolve().parent.parent

os.environ.setdefault("MPLBACKEND", "Agg")

# A shell starts what runs in its background with Ctrl-C ignored, and so would be every command that
# the tests interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Compilation and a loaded machine make single examples slow without anything being wrong.
settings.register_profile("here", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "here")


@pytest.fixture(scope="session")
def repo_root() -> Path:
    """Return the checkout."""
    return ROOT


@pytest.fixture(scope="session")
def golden_dir() -> Path:
    """Return the folder of the independent numbers, exact.json and dong2021_curves.json."""
    return ROOT / "tests" / "data" / "golden"


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """Return the folder beside the checkout (or $ISCAT_SHARED) that holds larger measured data."""
    folder = Path(os.environ.get("ISCAT_SHARED", ROOT.parent / "shared"))
    if not folder.is_dir():
        pytest.skip(f"no shared data: {folder} is absent (set ISCAT_SHARED to its place)")
    return folder


@pytest.fixture(scope="session")
def data_dir(shared_dir: Path) -> Path:
    """Return the folder of measured data."""
    folder = shared_dir / "data"
    if not folder.is_dir():
        pytest.skip(f"no measured data: {folder} is absent")
    return folder


@pytest.fixture(scope="session")
def sample_configs() -> dict[str, Path]:
    """Return the sample configurations by name."""
    return {path.stem: path for path in sorted((ROOT / "sample_configs").glob("*.toml"))}
