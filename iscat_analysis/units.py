"""Units and their conversions, each defined once; numbers in words and in cells of tables."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from string import Formatter
from typing import Any

NM = 1e-9
"""One nanometre in metres."""


KILODALTON_KG = 1e3 * 1.66053906892e-27  # one dalton in kilograms (CODATA 2022)
"""One kilodalton in kilograms."""


def sphere_mass_kda(diameter_nm: float, density_kg_m3: float) -> float:
    """Mass of a sphere."""
    return density_kg_m3 * math.pi / 6 * (diameter_nm * NM) ** 3 / KILODALTON_KG


def sphere_diameter_nm(mass_kda: float, density_kg_m3: float) -> float:
    """Diameter of a sphere."""
    return math.cbrt(6 * mass_kda * KILODALTON_KG / (math.pi * density_kg_m3)) / NM


def count(n: int, noun: str) -> str:
    """Write so many of something, in the plural unless it is one."""
    return f"{n} {noun}{'' if n == 1 else 's'}"


def listed(items: Iterable[object], most: int) -> str:
    """Write the first few things, and how many more there are."""
    words = [str(item) for item in items]
    more = f" and {len(words) - most} more" if len(words) > most else ""
    return ", ".join(words[:most]) + more


def are(n: int) -> str:
    """Give the verb that belongs to so many."""
    return "is" if n == 1 else "are"


def frames_listed(numbers: Iterable[object]) -> str:
    """Write the numbers of the first four frames, and how many more there are."""
    numbers = list(numbers)
    return f"frame{'' if len(numbers) == 1 else 's'} {listed(numbers, 4)}"


_NO_RANGE = re.compile("–( to |–)–")


class _Cells(Formatter):
    """Formats as `str.format` does, and with a dash for numbers that are not known.

    ``.3g%`` makes percent of a share, with three digits; digits are grouped by spaces.
    """

    def format_field(self, value: Any, format_spec: str) -> str:
        if value is None or (isinstance(value, float) and not math.isfinite(value)):
            return "–"
        if format_spec.endswith(("f%", "g%")):
            return f"{100 * value:{format_spec[:-1]}} %"
        text = str(super().format_field(value, format_spec))
        return text.replace(",", " ") if "," in format_spec else text


def cells(records: Iterable[Mapping[str, Any]], row: str) -> list[tuple[str, ...]]:
    """Write the cells of a table: `row` has the formats of a record's values, between bars."""
    formats, write = row.split(" | "), _Cells().vformat
    return [
        tuple(_NO_RANGE.sub("–", write(form, (), record)) for form in formats) for record in records
    ]
