"""The window in a browser: a folder of movies, the command that serves it, and its page."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from app_page import Page, serving
from app_results import SERIES_NM, dimers_result, standards_result
from browsers import open_browser
from small_movies import LANDING

import iscat_analysis as ia

OWN = ("data:", "blob:", "chrome:", "chrome-untrusted:")
"""Addresses within a browser, some of which it opens by itself."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder with a movie, its configuration, and one that is damaged."""
    path = tmp_path_factory.mktemp("movies")
    small = LANDING.replace("frames = 480", "frames = 240")
    (path / "iscat.toml").write_text(small, encoding="utf-8")
    ia.simulate_movie(path / "iscat.toml", path / "landing.tif", seed=1)
    (path / "damaged.tif").write_bytes((path / "landing.tif").read_bytes()[:50_000])
    random, series = np.random.default_rng(5), path / "series"
    series.mkdir()
    for concentration in SERIES_NM:
        dimers_result(series / f"{concentration:g} nM.iscat", random, concentration)
    standards_result(series / "standards.iscat", random)
    return path


@pytest.fixture(scope="module")
def server(
    folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[subprocess.Popen[str]]:
    """Start the command, and end it with Ctrl-C."""
    with serving(folder, "0", tmp_path_factory.mktemp("server") / "log") as server:
        yield server


@pytest.fixture(scope="module")
def address(server: subprocess.Popen[str]) -> str:
    """Read the address that the command prints."""
    assert server.stdout is not None
    return server.stdout.readline().strip()


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    profile = tmp_path_factory.mktemp("profile")
    with open_browser(
        profile, "--window-size=1400,1200", logs={"browser": "ALL", "performance": "ALL"}
    ) as driver:
        yield driver


@pytest.fixture
def page(driver: Any, address: str) -> Iterator[Page]:
    """Open the page; afterwards nothing was fetched elsewhere, and no script failed."""
    driver.get(address)
    page = Page(driver)
    page.says("Choose a movie")
    yield page
    asked = set()
    for entry in driver.get_log("performance"):
        message = json.loads(entry["message"])["message"]
        if message["method"] == "Network.requestWillBeSent":
            asked.add(message["params"]["request"]["url"])
    here = address.partition("?")[0]
    assert [url for url in asked if not url.startswith((here, *OWN))] == []
    failed = [entry for entry in driver.get_log("browser") if entry["level"] == "SEVERE"]
    assert [entry["message"] for entry in failed] == []
