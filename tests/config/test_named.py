"""Named set-ups show proteins as their publications do, and begin a configuration."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest

import iscat_analysis as ia
from iscat_analysis.study import Movie
from iscat_cli import main
from iscat_cli.options import Instrument

HUNDRED = {"particle.mass_kda": 480.0, "bounds.n_before": 100, "bounds.n_after": 100}
LANDED = {
    "background.frames": (0, 100),
    "fit.spheres": (),
    "optics.calibrate": "never",
    "posterior.enabled": False,
    "simulation.frames": 200,
    "simulation.shape": [72, 72],
    "simulation.events": [{"frame": 100, "x_px": 35.3, "y_px": 36.1, "mass_kda": 480.0}],
}
NAMES = get_args(Instrument)


def _snr(config: ia.Config) -> float:
    return float(480 / ia.compute_bounds(config).actual.loc["mass_kda", "crb_joint"])


@pytest.mark.parametrize("name", NAMES)
def test_a_protein_has_the_stated_signal_in_a_hundred_frames(name: str) -> None:
    """By the bound and in a fit; control: the defaults, whose reference nothing attenuates."""
    stated = ia.instruments[name].snr_480_kda
    assert stated > 8  # and above every threshold of detection
    assert _snr(ia.configure(instrument=name, settings=HUNDRED)) == pytest.approx(stated, rel=0.1)
    assert _snr(ia.configure(settings=HUNDRED | {"camera.pixel_size_nm": 84.4})) < 2

    config = ia.configure(instrument=name, settings=HUNDRED | LANDED)
    counts = np.array(list(Movie(config, 5).frames(5)))
    result = ia.fit_movie(counts, config=config)
    (row,) = result.table.itertuples()
    camera = result.summary["camera"]
    assert camera["offset_adu"]["se"] < 0.05 * camera["light_adu"]  # the light tells its zero
    assert np.hypot(row.x_px - 35.3, row.y_px - 36.1) < 1
    assert row.snr == pytest.approx(stated, abs=4 + 0.1 * stated)  # σ is 1
    assert abs(row.mass_kda - 480) < 4 * row.sigma_mass_kda


def test_set_ups_are_listed_with_their_publications() -> None:
    assert tuple(ia.instruments) == NAMES
    lines = repr(ia.instruments).splitlines()
    assert len(lines) <= 20
    for name, one in ia.instruments.items():
        assert any(line.startswith(f"{name}: ") for line in lines)
        assert any(one.reference in line for line in lines)


def test_a_printed_set_up_is_read_back(tmp_path: Path, capsys) -> None:
    path = tmp_path / "setup.toml"
    for name in NAMES:
        assert main(["config", "--instrument", name]) == 0
        path.write_text(capsys.readouterr().out, encoding="utf-8")
        assert ia.configure(path) == ia.configure(instrument=name)
        text = path.read_text(encoding="utf-8").replace("\n# ", " ")
        assert ia.instruments[name].reference in text


def test_a_set_up_lies_below_what_is_given(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("[optics]\nna = 1.49\n", encoding="utf-8")
    for source in (path, {"optics": {"na": 1.49}}, {"optics.na": 1.49}):
        config = ia.configure(source, instrument="cobri", settings={"optics.attenuation": 0.2})
        optics = config.optics
        assert (optics.scheme, optics.na, optics.attenuation) == ("cobri", 1.49, 0.2)
    with pytest.raises(ia.ConfigError, match=r'settings=ia\.instruments\["iscat"\]\.settings'):
        ia.configure(ia.configure(), instrument="iscat")
    with pytest.raises(ia.ConfigError, match="the names are mass-photometer-445, "):
        ia.configure(instrument="microscope")
    assert "microscope" not in ia.instruments


def test_simulated_counts_fit_into_their_bits_where_no_gain_is_given() -> None:
    """Each count is then as many photoelectrons as that takes; a gain that is given stands."""
    settings = LANDED | {"simulation.events": [], "simulation.frames": 20}
    settings |= {"simulation.background": "flat", "simulation.power_noise": 0.0}
    for light, gain in ((1e4, 1), (6e4, 1), (1e6, 16)):
        config = ia.configure(
            instrument="iscat", settings=settings | {"simulation.photons_per_pixel": light}
        )
        counts = np.array(list(Movie(config, 1).frames(1)))
        assert counts.mean() * gain == pytest.approx(light, rel=1e-3)
        assert counts.var() * gain**2 == pytest.approx(light, rel=0.02)
    given = ia.configure(config, settings={"camera.gain_e_per_adu": 1.0})
    with pytest.raises(ia.ConfigError, match="more than 16 bits"):
        Movie(given, 1)
