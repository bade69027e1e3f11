"""Units and their conversions, each defined once; numbers with what they count."""

from __future__ import annotations

import math
from collections.abc import Iterable

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
