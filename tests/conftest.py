"""What every test may use."""

from __future__ import annotations

import gc
import math
import os
import signal
from collections.abc import Callable, Generator
from pathlib import Path

import pytest
from hypothesis import settings

ROOT = Path(__file__).resolve().parent.parent
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("PYTHONFAULTHANDLER", "1")  # a crash of a command says where
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of workers and commands

# A shell starts what runs in its background with Ctrl-C ignored, and so would be every command that
# the tests interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Compilation and a loaded machine make single examples slow without anything being wrong.
settings.register_profile("here", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "here")


LONGEST_FIRST = (
    "test_app_browser", "test_report_browser", "test_report", "test_learning", "test_day",
    "test_output", "test_optics_calibration", "test_pipeline", "test_landing", "test_cli_help",
    "test_cluster", "test_movers", "test_contrast_sign", "test_benchmark", "test_equilibrium",
    "test_cli_benchmark", "test_public", "test_uneven", "test_napari", "test_cli_init",
    "test_camera_laws", "test_fuzz", "test_cli_contract", "test_breaks", "test_floating_optics",
    "test_doors", "test_preview", "test_tracked_optics", "test_cause", "test_challenge",
    "test_bounds", "test_contrast_regions", "test_reach", "test_cli_optics", "test_true_zero",
    "test_distribution_spread", "test_noise_judged", "test_photon_transfer", "test_compilation",
    "test_crowded", "test_posterior", "test_bad_input", "test_blocks", "test_hostile_files",
)  # fmt: skip
"""Modules that take longest; they are begun first, so that no worker is left with one."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--share",
        type=float,
        default=0.0,
        help="how much of the tests marked 'large' to run: 0 leaves them out, 1 is all of them",
    )


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Leave out what is imported, a million objects that stay to the end, where cycles are sought.

    That takes a third of the time of collecting the tests, and some percent of running them.  So
    does looking for cycles after every 700 objects.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(50_000)
        gc.enable()


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out large tests, or all but a share of the parameters of each; order the rest."""
    share = config.getoption("--share")
    large: dict[str, list[pytest.Item]] = {}
    for item in sorted(items, key=lambda item: item.nodeid):
        if item.get_closest_marker("large"):
            large.setdefault(item.nodeid.partition("[")[0], []).append(item)
    left_out = {item for same in large.values() for item in same[math.ceil(share * len(same)) :]}
    if left_out:
        items[:] = [item for item in items if item not in left_out]
        config.hook.pytest_deselected(items=list(left_out))

    def rank(item: pytest.Item) -> int:
        name = item.path.stem
        return LONGEST_FIRST.index(name) if name in LONGEST_FIRST else len(LONGEST_FIRST)

    items.sort(key=rank)


@pytest.fixture(scope="session")
def share(request: pytest.FixtureRequest) -> float:
    """Return the share of a large test's repetitions that is wanted, up to 1."""
    return float(request.config.getoption("--share"))


@pytest.fixture(scope="session")
def repetitions(share: float) -> Callable[[int, int], int]:
    """Return how often to repeat: a few times by default, up to all where large tests are run."""

    def count(few: int, all_of_them: int) -> int:
        return max(few, round(share * all_of_them))

    return count


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
