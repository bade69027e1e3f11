"""Named set-ups from publications, to begin with: optics, camera and typical light.

The light is what the camera counts, after the reference was attenuated.  None has a [calibration],
which is of one instrument and one day: without it masses have the scale of the optical model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
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


class Instruments(dict[str, Instrument]):
    """Set-ups by name; printed, it lists them."""

    def __missing__(self, name: str) -> Instrument:
        raise ConfigError(f"`instrument` = {name!r}: is not known; the names are {', '.join(self)}")

    def __repr__(self) -> str:
        lines = []
        for name, one in self.items():
            lines += [
                f"{name}: {one.title}",
                f"    480 kDa in 100 frames: SNR {one.snr_480_kda:.3g}; {one.reference}",
            ]
        return "\n".join([*lines, 'as in configure(instrument="iscat")'])


_LIGHT = {"simulation.background": "speckle", "simulation.power_noise": 0.01}
"""Glass is rough and lasers flicker, which tells the camera's gain and offset."""

# In mode mass, the focus is where dark particles have the largest contrast.
instruments = Instruments(
    {
        "mass-photometer-445": Instrument(
            "home-built mass photometer, 445 nm, a mask that lets 1 % of the reflected light pass",
            {
                "optics.wavelength_nm": 445.0,
                "optics.na": 1.42,
                "optics.attenuation": 0.1,
                "optics.mask_na": 0.6,
                "optics.focus_nm": -200.0,
                "camera.pixel_size_nm": 84.4,
                "bounds.photons_per_pixel": 1e6,
                "simulation.photons_per_pixel": 1e6,
                **_LIGHT,
            },
            "Cole, ACS Photonics 4, 211 (2017); Young, Science 360, 423 (2018)",
            110.0,
        ),
        # The mask is not published: with this one the contrast of 1 kDa is 2.8e-5 by the model, and
        # 6.1e-5 in a published table of events.
        "mass-photometer-525": Instrument(
            "commercial mass photometer, 525 nm, pixels of 19.3 nm binned 4 x 4",
            {
                "optics.wavelength_nm": 525.0,
                "optics.na": 1.42,
                "optics.attenuation": 0.03,
                "optics.mask_na": 0.6,
                "optics.focus_nm": -200.0,
                "camera.pixel_size_nm": 77.2,
                "bounds.photons_per_pixel": 1e5,
                "simulation.photons_per_pixel": 1e5,
                **_LIGHT,
            },
            "Refeyn OneMP, as in Sonn-Segev, Nat. Commun. 11, 1772 (2020)",
            97.0,
        ),
        "iscat": Instrument(
            "plain iSCAT, 405 nm, all reflected light on a camera with a deep well",
            {
                "optics.wavelength_nm": 405.0,
                "optics.na": 1.4,
                "optics.focus_nm": -150.0,
                "camera.pixel_size_nm": 60.0,
                "bounds.photons_per_pixel": 1e6,
                "simulation.photons_per_pixel": 1e6,
                **_LIGHT,
            },
            "Piliarik and Sandoghdar, Nat. Commun. 5, 4495 (2014)",
            19.0,
        ),
        "cobri": Instrument(
            "COBRI, 517.5 nm: transmitted light attenuated to 0.4 %",
            {
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
                **_LIGHT,
            },
            "Huang, ACS Nano 11, 2575 (2017); Dong, J. Phys. D 54, 394002 (2021)",
            9.1,
        ),
    }
)
"""Named set-ups, for `configure`."""
