"""Options of the commands that read tables of events, and how lists of numbers are written."""

from __future__ import annotations

from typing import Annotated

import typer

SigmaOption = Annotated[
    float | None,
    typer.Option(
        "--sigma", metavar="KDA", help="Error of every event, instead of the table's [kDa]."
    ),
]

LimitOption = Annotated[
    str | None,
    typer.Option(
        "--limit",
        metavar="M[:S]",
        help=(
            "Mass at which half of the particles are detected, and the spread of the "
            "detector's estimate [kDa]; default from the table."
        ),
    ),
]

AboveOption = Annotated[
    float | None,
    typer.Option(
        "--above", metavar="KDA", help="Use events above this mass only, and correct for the cut."
    ),
]


def numbers(option: str, text: str) -> list[float]:
    """Read ``66,132``; messages name the option."""
    from iscat_analysis.errors import ConfigError

    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise ConfigError(f"{option} {text}: write masses in kDa as in {option} 66,132") from None


def whole(option: str, text: str) -> list[int]:
    """Read ``1,2,4``; messages name the option."""
    from iscat_analysis.errors import ConfigError

    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise ConfigError(f"{option} {text}: write whole numbers as in {option} 1,2,4") from None


def pair(option: str, text: str | None) -> tuple[float | None, float | None]:
    """Read ``40:8`` or ``40``, None where a number is missing; messages name the option."""
    from iscat_analysis.errors import ConfigError

    if text is None:
        return None, None
    first, colon, second = text.partition(":")
    try:
        return float(first), float(second) if colon else None
    except ValueError:
        raise ConfigError(f"{option} {text}: write it as {option} 40 or {option} 40:8") from None
