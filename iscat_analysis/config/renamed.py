"""Old values of keys, which work for one release with a notice that names the new one."""

from __future__ import annotations

import warnings
from typing import Any

from iscat_analysis.config.values import ALL

OLD_VALUES: dict[tuple[str, str], dict[str, str]] = {
    ("background", "method"): {"mean": "fixed", "none": "known"}
}
"""Section and key → old value → new value."""


def rename(values: dict[str, Any]) -> None:
    """Replace old values in place, and say so in a `FutureWarning`."""
    _name_all_frames(values)
    for (section, key), names in OLD_VALUES.items():
        table = values.get(section)
        old = table.get(key) if isinstance(table, dict) else None
        if isinstance(table, dict) and isinstance(old, str) and old in names:
            if old == "mean" and table.get("frames") is None:
                # Without frames the mean meant that the windows slide, where the scheme allows it.
                del table[key]
                _notice('background.method = "mean" without background.frames', '"sliding"')
                continue
            table[key] = names[old]
            _notice(f'{section}.{key} = "{old}"', f'"{names[old]}"')


def _name_all_frames(values: dict[str, Any]) -> None:
    """Name the frames of a median; without frames it meant all of them in mode track."""
    background, fit, optics = (values.get(name) for name in ("background", "fit", "optics"))
    if not (isinstance(background, dict) and isinstance(fit, dict)):
        return
    dark = isinstance(optics, dict) and str(optics.get("scheme")).lower() == "darkfield"
    median = background.get("method") == "median" and background.get("frames") is None
    if median and fit.get("mode") == "track" and not dark:
        background["frames"] = ALL
        _notice(
            'background.method = "median" without background.frames', 'background.frames = "all"'
        )


def _notice(old: str, new: str) -> None:
    warnings.warn(
        f"{old} is now called {new}; the old name works until the next release",
        FutureWarning,
        stacklevel=4,
    )
