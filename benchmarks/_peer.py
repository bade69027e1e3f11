"""Environments of their own for the programs that benchmarks compare with."""

from __future__ import annotations

import os
import subprocess
import sys
import venv
from pathlib import Path

RESULTS = Path(__file__).resolve().parent / "results"


def peer_python(name: str, *packages: str) -> Path:
    """Make the environment `name` under ``results`` where it is missing; its Python."""
    folder = RESULTS / f"{name}-env"
    python = folder / ("Scripts" if os.name == "nt" else "bin") / "python"
    if not (folder / ".complete").exists():
        print("installing", *packages, file=sys.stderr)
        venv.create(folder, with_pip=True, clear=True)
        subprocess.run([str(python), "-m", "pip", "install", "--quiet", *packages], check=True)
        (folder / ".complete").touch()
    return python
