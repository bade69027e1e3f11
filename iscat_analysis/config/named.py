"""Named set-ups from publications, to begin with: optics, camera and typical light.

The light is what the camera counts, after the reference was attenuated.  None has a [calibration],
which is of one instrument and one day: without it masses have the scale of the optical model.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from iscat_analysis.errors import ConfigError


@dataclass(frozen=True)
class Instrument:
    """A set-up: settings for `configure`, and where they were published.

    Attributes
    ----------
    title : str
        What it is.
    settings : mapping of str to Any
        Keys of the configuration.
    reference : str
        Publication.
    snr_480_kda : float
        Signal-to-noise ratio of 480 kDa in 100 frames, against 100 frames before it landed.
    """

    title: str
    settings: Mapping[str, Any]
    reference: str
    snr_480_kda: float


class Instruments(Mapping[str, Instrument]):
    """Set-ups by name; printed, it lists them."""

    def __init__(self, known: Mapping[str, Instrument]) -> None:
        self._known = known

    def __getitem__(self, name: str) -> Instrument:
        if name not in self._known:
            raise ConfigError(
                f"`instrument` = {name!r}: is not known; the names are {', '.join(self._known)}"
            )
        return self._known[name]

    def __contains__(self, name: object) -> bool:
        return name in self._known

    def __iter__(self) -> Iterator[str]:
        return iter(self._known)

    def __len__(self) -> int:
        return len(self._known)

    def __repr__(self) -> str:
        lines = []
        for name, one in self.items():
            lines += [
                f"{name}: {one.title}",
                f"    480 kDa in 100 frames: SNR {one.snr_480_kda:.3g}; {one.reference}",
            ]
        return "\n".join([*lines, 'as in configure(instrument="iscat")'])


# In mode mass, the focus is where dark particles have the largest contrast.
instruments = Instruments({
    "mass-photometer-445": Instrument(
        "home-built mass photometer, 445 nm, a mask that lets 1 % of the reflected light pass",
        MappingProxyType({
            "optics.wavelength_nm": 445.0,
            "optics.na": 1.42,
            "optics.attenuation": 0.1,
            "optics.mask_na": 0.6,
            "optics.focus_nm": -200.0,
            "camera.pixel_size_nm": 84.4,
            "bounds.photons_per_pixel": 1e6,
            "simulation.photons_per_pixel": 1e6,
        }),
        "Cole, ACS Photonics 4, 211 (2017); Young, Science 360, 423 (2018)",
        119.0,
    ),
    # The mask is not published: with this one, the contrast of 1 kDa is within a factor of 2.5 of
    # the 6.1e-5 that standards had.
    "mass-photometer-525": Instrument(
        "commercial mass photometer, 525 nm, pixels of 19.3 nm binned 4 x 4",
        MappingProxyType({
            "optics.wavelength_nm": 525.0,
            "optics.na": 1.42,
            "optics.attenuation": 0.03,
            "optics.mask_na": 0.6,
            "optics.focus_nm": -200.0,
            "camera.pixel_size_nm": 77.2,
            "bounds.photons_per_pixel": 1e5,
            "simulation.photons_per_pixel": 1e5,
        }),
        "Refeyn OneMP, as in Sonn-Segev, Nat. Commun. 11, 1772 (2020)",
        102.0,
    ),
    "iscat": Instrument(
        "plain iSCAT, 405 nm, all reflected light on a camera with a deep well",
        MappingProxyType({
            "optics.wavelength_nm": 405.0,
            "optics.na": 1.4,
            "optics.focus_nm": -150.0,
            "camera.pixel_size_nm": 60.0,
            "bounds.photons_per_pixel": 1e6,
            "simulation.photons_per_pixel": 1e6,
        }),
        "Piliarik and Sandoghdar, Nat. Commun. 5, 4495 (2014)",
        20.0,
    ),
    "cobri": Instrument(
        "COBRI, 517.5 nm: transmitted light attenuated to 0.4 %",
        MappingProxyType({
            "optics.scheme": "cobri",
            "optics.wavelength_nm": 517.5,
            "optics.na": 1.3,
            "optics.n_immersion": 1.5,
            "optics.n_glass": 1.5,
            "optics.attenuation": 0.0601,
            "optics.focus_nm": -250.0,
            "camera.pixel_size_nm": 80.0,
            "bounds.photons_per_pixel": 1e6,
            "simulation.photons_per_pixel": 1e6,
        }),
        "Huang, ACS Nano 11, 2575 (2017); Dong, J. Phys. D 54, 394002 (2021)",
        9.5,
    ),
})  # fmt: skip
"""Named set-ups, for `configure`."""
