"""Run every benchmark beside this file, one after another, and say which did not finish.

    python benchmarks/run.py [--quick] [NAME…]

Without names all of them; each writes its numbers to ``benchmarks/results/NAME.json``.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent


def main() -> int:
    scripts = {path.stem: path for path in sorted(ROOT.glob("[a-z]*.py")) if path.stem != "run"}
    parser = argparse.ArgumentParser(description="Run the benchmarks.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(scripts))
    parser.add_argument("--quick", action="store_true", help="rough numbers in a few minutes")
    options = parser.parse_args()
    unknown = [name for name in options.names if name not in scripts]
    if unknown:
        parser.error(f"{unknown[0]!r} is not a benchmark; there are {', '.join(scripts)}")
    failed = []
    for name in options.names or scripts:
        print(f"== {name}", flush=True)
        command = [sys.executable, str(scripts[name]), *(["--quick"] if options.quick else [])]
        if subprocess.run(command, check=False).returncode:
            failed.append(name)
    if failed:
        print(f"did not pass: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
