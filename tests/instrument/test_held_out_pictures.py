"""Pictures that judge a microscope begin where those lie that it was fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from iscat_analysis.inference.laws import POISSON
from iscat_analysis.instrument.joint_fit import Estimate
from iscat_analysis.instrument.measure import OpticsSearch
from iscat_analysis.instrument.particle_image import ParticleImage
from iscat_analysis.optics.parameters import Prior, Settings
from iscat_analysis.optics.pixels import PixelGrid

HEIGHTS_NM = (0.0, 1000.0)


def _particle_images(count: int, mass_kda: float) -> tuple[ParticleImage, ...]:
    grid = PixelGrid.centred(5, 84.0)
    one = ParticleImage(grid, POISSON, np.ones((4, 5, 5)), 0.0, 0.0, 100.0, heights_nm=HEIGHTS_NM)
    return tuple(replace(one, mass_kda=mass_kda, z_nm=100.0 + 50 * k) for k in range(count))


def _estimate(images: Sequence[ParticleImage], values: Settings) -> Estimate:
    return Estimate(
        ("reference_phase_deg",),
        values,
        tuple(images),
        information=np.eye(1),
        scatter=np.eye(1),
        errors=np.ones(1),
        log_likelihood=0.0,
        log_prior=0.0,
        converged=True,
    )


class _Moving(OpticsSearch):
    """Every fit of optics moves all heights by a fringe."""

    def fit(
        self,
        images: Sequence[ParticleImage],
        start: Settings,
        names: Sequence[str],
        passes: int = 40,
    ) -> Estimate:
        del passes
        moved = [s.raised(200.0) for s in images] if names else images
        return _estimate(moved, start)


def _search(kind: type[OpticsSearch] = OpticsSearch) -> OpticsSearch:
    values: dict[str, Any] = {"reference_phase_deg": 0.0, "polarization": "linear", "mask_na": 0.0}
    build: Any = None  # no picture is looked at
    return kind(values, build, ("phase",), {}, Prior(values))


@pytest.mark.parametrize(("mass", "phase"), [(-400.0, 173.0), (400.0, -7.0)])
def test_pictures_that_judge_turn_with_the_phase(mass: float, phase: float) -> None:
    """A strong particle of free height stays where it is: χ² 1.07 became 2.05."""
    best = _estimate(_particle_images(12, mass), {"reference_phase_deg": -7.0})
    turned, judged = _search()._signed(best, _particle_images(6, mass))
    assert turned.values["reference_phase_deg"] == pytest.approx(phase)
    assert {s.mass_kda for s in (*turned.images, *judged)} == {400.0}


def test_pictures_that_judge_follow_the_heights_of_the_others() -> None:
    """From where they were they would end in another fringe: χ² 1.05 became 3.9."""
    images = _particle_images(12, 400.0)
    search = _search(_Moving)
    best, judged = search._of_known_kind(images, search.configured)
    assert len(best.images) + len(judged) == len(images)
    assert [s.z_nm for s in judged] == [s.z_nm + 200.0 for s in images[1::3]]


def test_no_picture_leaves_the_heights_that_are_possible() -> None:
    (image,) = _particle_images(1, 400.0)
    assert image.raised(-300.0).z_nm == HEIGHTS_NM[0]
    assert image.raised(3000.0).z_nm == HEIGHTS_NM[1]
    assert replace(image, heights_nm=None).raised(50.0).z_nm == image.z_nm
