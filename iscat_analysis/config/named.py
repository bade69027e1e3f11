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


def _settings(photons: float, pixel_nm: float, optics: Mapping[str, Any]) -> dict[str, Any]:
    """Give the keys of a set-up; glass is rough and lasers flicker, which tells the camera."""
    return {
        **{f"optics.{key}": value for key, value in optics.items()},
        "camera.pixel_size_nm": pixel_nm,
        "bounds.photons_per_pixel": photons,
        "simulation.photons_per_pixel": photons,
        "simulation.background": "speckle",
        "simulation.power_noise": 0.01,
    }


_MASKED = {"na": 1.42, "mask_na": 0.6, "focus_nm": -200.0}
_TRANSMITTED = {"scheme": "cobri", "n_immersion": 1.5, "n_glass": 1.5, "attenuation": 0.0601}

# In mode mass, the focus is where dark particles have the largest contrast.
instruments = Instruments(
    {
        "mass-photometer-445": Instrument(
            "home-built mass photometer, 445 nm, a mask that lets 1 % of the reflected light pass",
            _settings(1e6, 84.4, {**_MASKED, "wavelength_nm": 445.0, "attenuation": 0.1}),
            "Cole, ACS Photonics 4, 211 (2017); Young, Science 360, 423 (2018)",
            110.0,
        ),
        # The mask is not published: with this one the contrast of 1 kDa is 2.8e-5 by the model, and
        # 6.1e-5 in a published table of events.
        "mass-photometer-525": Instrument(
            "commercial mass photometer, 525 nm, pixels of 19.3 nm binned 4 x 4",
            _settings(1e5, 77.2, {**_MASKED, "wavelength_nm": 525.0, "attenuation": 0.03}),
            "Refeyn OneMP, as in Sonn-Segev, Nat. Commun. 11, 1772 (2020)",
            97.0,
        ),
        "iscat": Instrument(
            "plain iSCAT, 405 nm, all reflected light on a camera with a deep well",
            _settings(1e6, 60.0, {"wavelength_nm": 405.0, "na": 1.4, "focus_nm": -150.0}),
            "Piliarik and Sandoghdar, Nat. Commun. 5, 4495 (2014)",
            19.0,
        ),
        "cobri": Instrument(
            "COBRI, 517.5 nm: transmitted light attenuated to 0.4 %",
            _settings(
                1e6, 80.0, {**_TRANSMITTED, "wavelength_nm": 517.5, "na": 1.3, "focus_nm": -250.0}
            ),
            "Huang, ACS Nano 11, 2575 (2017); Dong, J. Phys. D 54, 394002 (2021)",
            9.1,
        ),
    }
)
"""Named set-ups, for `configure`."""
