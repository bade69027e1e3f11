"""The command line: parses, makes one library call, prints.

One file per command; `app` lists them.  Nothing of the library is imported before a command runs,
so that ``--help`` and shell completion stay quick.
"""

from __future__ import annotations

from iscat_cli.app import main, main_fit

__all__ = ["main", "main_fit"]
