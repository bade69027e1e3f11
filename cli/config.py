"""`iscat config`: a complete configuration to start from."""

from __future__ import annotations

import typer

from iscat_cli.console import Messages, failures, print_result
from iscat_cli.options import DebugOption, ModeOption

EXAMPLE = """Example:

    iscat config --mode joint > setup.toml
"""


def config(context: typer.Context, *, mode: ModeOption = None, debug: DebugOption = False) -> None:
    """Print a complete configuration, each key with what it means."""
    with failures(Messages(context.command_path), debug=debug):
        from iscat_analysis.config import config_to_toml, load_config

        print_result(config_to_toml(load_config(None, [f"fit.mode={mode.value}"] if mode else ())))
