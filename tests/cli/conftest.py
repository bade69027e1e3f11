"""What the tests of commands share."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from iscat_cli import main


@pytest.fixture
def only_line(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run a command that is refused, and give the only line that it says."""

    def run(*arguments: str, status: int = 2) -> str:
        capsys.readouterr()
        assert main([*arguments]) == status
        said = capsys.readouterr()
        (line,) = said.err.strip().splitlines()
        assert said.out == ""
        assert "unexpected" not in line
        return line

    return run
