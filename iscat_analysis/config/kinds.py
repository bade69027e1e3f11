"""What the schemes, the modes and the methods of the background mean, each named once.

Code asks for a property (`Optics.interferes`, `Fit.follows_tracks`, `BackgroundConfig.way`), and
never compares a name; where only the name is known, as in ``summary.json``, it asks these tables.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Way = Literal["fixed", "sliding", "tracks"]
PARAMETERS = ("x_nm", "y_nm", "z_nm", "mass_kda")
"""The particle's parameters, in the order every matrix and vector uses."""


@dataclass(frozen=True)
class SchemeKind:
    """An optical scheme.

    Attributes
    ----------
    title : str
        Its name in print.
    interferes : bool
        A reference reaches the camera: particles multiply the background, and have a contrast.
        Otherwise (dark field) they add to it, and images are in photoelectrons.
    reflected : bool
        The camera stands on the side from which the light comes, as in iSCAT.
    """

    title: str
    interferes: bool = True
    reflected: bool = False

    @property
    def direction(self) -> float:
        """Sign of the incident light's direction along the collected light's axis."""
        return 1.0 if self.reflected else -1.0

    @property
    def image_unit(self) -> str:
        """Unit of images without their background."""
        return "contrast" if self.interferes else "photoelectrons"


@dataclass(frozen=True)
class ModeKind:
    """A mode of the fit.

    Attributes
    ----------
    free : tuple of str
        Parameters that are fitted, of `PARAMETERS`.
    follows_tracks : bool
        Particles move, and are fitted frame by frame; else they land, leave, or stand.
    fits_sizes : bool
        Diameters of spheres are fitted, from which the masses follow.
    """

    free: tuple[str, ...] = PARAMETERS
    follows_tracks: bool = False
    fits_sizes: bool = False

    @property
    def heights_free(self) -> bool:
        """Whether every particle has a height of its own, which is fitted."""
        return "z_nm" in self.free

    @property
    def masses_free(self) -> bool:
        """Whether masses are fitted."""
        return "mass_kda" in self.free


@dataclass(frozen=True)
class MethodKind:
    """A method by which the background is measured.

    Attributes
    ----------
    way : str
        ``"fixed"``: frames with particles against a background before them or a known level |
        ``"sliding"``: frames just after each frame against those just before it | ``"tracks"``:
        each frame against what all frames have in common without particles.
    takes_frames : bool
        ``background.frames`` may name the frames.
    is_counted : bool
        It is a sum of counts, as the conditional likelihood assumes.
    """

    way: Way = "fixed"
    takes_frames: bool = True
    is_counted: bool = False


SCHEMES: Mapping[str, SchemeKind] = {
    "iscat": SchemeKind("iSCAT", reflected=True),
    "cobri": SchemeKind("COBRI"),
    "darkfield": SchemeKind("dark field", interferes=False),
}
MODES: Mapping[str, ModeKind] = {
    "mass": ModeKind(("x_nm", "y_nm", "mass_kda")),
    "localize": ModeKind(("x_nm", "y_nm", "z_nm")),
    "joint": ModeKind(),
    "size": ModeKind(fits_sizes=True),
    "track": ModeKind(follows_tracks=True),
}
METHODS: Mapping[str, MethodKind] = {
    "fixed": MethodKind(is_counted=True),
    "median": MethodKind(),
    "known": MethodKind(),
    "sliding": MethodKind("sliding", takes_frames=False, is_counted=True),
    "tracks": MethodKind("tracks", takes_frames=False),
}
