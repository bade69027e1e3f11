"""Keys of ``[optics]`` that say how the microscope differs over its field and in time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field

from iscat_analysis.config.values import Finite, Section

Size = Annotated[Finite, Field(ge=-1000.0, le=1000.0)]
Share = Annotated[Finite, Field(ge=-0.5, le=0.5)]

FIELD_TERMS: Mapping[str, tuple[str, int | None]] = {
    "focus_tilt_x_nm": ("focus_tilt_nm", 0),
    "focus_tilt_y_nm": ("focus_tilt_nm", 1),
    "focus_curvature_nm": ("focus_curvature_nm", None),
    "coma_field_nm": ("coma_field_nm", None),
    "astigmatism_field_x_nm": ("astigmatism_field_nm", 0),
    "astigmatism_field_y_nm": ("astigmatism_field_nm", 1),
    "phase_tilt_x_deg": ("phase_tilt_deg", 0),
    "phase_tilt_y_deg": ("phase_tilt_deg", 1),
    "phase_curvature_deg": ("phase_curvature_deg", None),
    "reference_tilt_x": ("reference_tilt", 0),
    "reference_tilt_y": ("reference_tilt", 1),
    "reference_curvature": ("reference_curvature", None),
}
"""Every coefficient by a name of its own: its key in ``[optics]``, and its place in a pair."""


MOVING: Mapping[str, Any] = {
    "focus_drift_nm": 0.0,
    "focus_bend_nm": 0.0,
    "focus_jumps": (),
    "focus_frame": 0,
}
"""Keys of ``[optics]`` that move the focus during a movie, and their values where it rests."""

Jump = tuple[Annotated[int, Field(ge=0)], Size]
"""Frame, and rise of the focus there [nm]."""

MOST_JUMPS = 4
"""Jumps of the focus that a movie may have."""

JUMPS = tuple(f"focus_jump_{number}_nm" for number in range(1, MOST_JUMPS + 1))
"""Rises of the focus at the frames of ``focus_jumps`` [nm]."""

MOVES = ("focus_drift_nm", "focus_bend_nm", *JUMPS)
"""What moves the focus during a movie, each coefficient by a name of its own."""


class FieldTerms(Section):
    """Terms of the field by name; each is the change from its centre to its edge."""

    def field_term(self, name: str) -> float:
        """Give a coefficient by its own name.

        Parameters
        ----------
        name : str
            One of `FIELD_TERMS`.

        Returns
        -------
        float
            Its value, in the unit that the name ends with.
        """
        key, index = FIELD_TERMS[name]
        value = getattr(self, key)
        return float(value if index is None else value[index])

    @property
    def is_even(self) -> bool:
        """Whether the microscope is the same everywhere in its field."""
        return not any(self.field_term(name) for name in FIELD_TERMS)


def field_keys(terms: Mapping[str, float]) -> dict[str, float | tuple[float, float]]:
    """Give coefficients as keys of ``[optics]``; what of a pair is not named is 0.

    Parameters
    ----------
    terms : Mapping[str, float]
        Coefficients by name, others are left out.

    Returns
    -------
    dict
        By key.
    """
    out: dict[str, float | tuple[float, float]] = {}
    for name, (key, index) in FIELD_TERMS.items():
        if name not in terms:
            continue
        if index is None:
            out[key] = terms[name]
        else:
            pair = [terms.get(n, 0.0) for n, (k, _) in FIELD_TERMS.items() if k == key]
            out[key] = (pair[0], pair[1])
    return out
