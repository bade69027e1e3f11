"""The runner of the manual's code blocks; `make docs` runs the blocks themselves."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(
    [ROOT / "README.md", *(p for p in (ROOT / "docs").rglob("*.md") if "_build" not in p.parts)]
)


def _load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


BLOCKS = _load("blocks")


def test_a_block_that_is_not_run_says_why_and_few_are() -> None:
    blocks = [block for page in PAGES for block in BLOCKS.blocks_of(page)]
    left_out = [block for block in blocks if block.not_run is not None]
    assert all(len(block.not_run.split()) > 3 for block in left_out)
    assert len(left_out) <= 7
    assert len(blocks) > 40


def test_no_shell_block_hides_under_another_name() -> None:
    for page in PAGES:
        fences = re.findall(r"^ *```+([\w-]*)$", page.read_text(encoding="utf-8"), re.M)
        assert set(fences) <= {"", "console", "python", "toml", "text", "none"}, page


def test_the_runner_finds_fails_and_stops(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "<!-- first: echo hidden > a.txt -->\n<!-- keep: said -->\n"
        "```console\n$ cat a.txt\nhidden\n$ echo one \\\n   two\n```\n\n"
        "```{literalinclude} x y\n```\n"
        "```python\nx = 1\nprint(x)\n```\n"
        "<!-- not run: this would do harm -->\n```console\n$ false\n```\n"
        "```python\nprint(x + 1)\n```\n```python\nraise ValueError('oh')\n```\n"
        "```python\nprint('never')\n```\n",
        encoding="utf-8",
    )
    with BLOCKS.Interpreter(Path(sys.executable).parent) as interpreter:
        outcomes = BLOCKS.run_page(page, tmp_path, interpreter)
        (tmp_path / "next.md").write_text("```python\nprint(x)\n```\n", encoding="utf-8")
        (of_next,) = BLOCKS.run_page(tmp_path / "next.md", tmp_path, interpreter)
    assert [outcome.out for outcome in outcomes] == ["hidden\none two\n", "1\n", "2\n", ""]
    assert outcomes[0].block.keep == "said"
    assert "ValueError: oh" in outcomes[-1].failed
    assert "NameError: name 'x'" in of_next.failed


def test_a_command_of_the_package_is_run_as_a_shell_would(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "```console\n$ iscat config \\\n   --mode joint > setup.toml\n$ grep '^mode =' setup.toml\n"
        "```\n```console\n$ iscat-fit 'no such.tif'\n```\n```console\n$ echo never\n```\n",
        encoding="utf-8",
    )
    with BLOCKS.Interpreter(Path(sys.executable).parent) as interpreter:
        done, failed = BLOCKS.run_page(page, tmp_path, interpreter)
    assert done.out.startswith('mode = "joint"')
    assert done.failed is None
    assert "iscat-fit: error: no such.tif" in failed.failed
