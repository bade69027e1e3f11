"""A wrong offset of the camera is told from a wrong gain, and from light that is noisy."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from iscat_analysis.camera import Camera, LightZero, find_zero
from iscat_analysis.diagnosis import judge_counts

SHAPE, FRAMES, LEVEL_E, GAIN = (64, 64), 128, 1e5, 4.0
SEEDS = 20
TRUE_COUNTS = 2000  # 8 % of the light

Counts = NDArray[Any]


def _pattern(rng: np.random.Generator, spread: float) -> NDArray[np.float64]:
    rough = gaussian_filter(rng.standard_normal(SHAPE), 3.0, mode="wrap")
    return np.asarray(1 + spread * rough / rough.std())


def _movie(
    seed: int,
    *,
    offset: int = 0,
    speckle: float = 0.15,
    power: float = 0.01,
    kind: str = "",
    gain: float = GAIN,
) -> Counts:
    """Record a scene; what may be mistaken for an offset is called by its kind."""
    rng = np.random.default_rng(seed)
    light, other = LEVEL_E * _pattern(rng, speckle), _pattern(rng, 1.0) - 1
    slope_y, slope_x = np.gradient(light)
    counts = np.empty((FRAMES, *SHAPE), dtype=np.uint16)
    for t in range(FRAMES):
        now = light
        if kind == "shaking":
            now = now + 0.02 * (slope_x * rng.standard_normal() + slope_y * rng.standard_normal())
        elif kind == "slow speckle":
            now = now * (1 + 0.01 * other * t / FRAMES)
        elif kind == "noisy light":
            now = now * (1 + 0.003 * rng.standard_normal(SHAPE))
        elif kind == "noisy rows":
            now = now * (1 + 0.002 * rng.standard_normal((SHAPE[0], 1)))
        expected = (1 + power * rng.standard_normal()) * now
        noisy = expected + np.sqrt(expected) * rng.standard_normal(SHAPE)
        counts[t] = np.floor(noisy / gain + offset + rng.random(SHAPE))
    return counts


def _zero(counts: Counts, offset: float = 0.0) -> LightZero:
    found = find_zero(counts, Camera(gain_e_per_adu=GAIN, offset_adu=offset))
    assert found is not None
    return found


def _said(counts: Counts, offset: float = 0.0, **more: Any) -> str:
    camera = Camera(gain_e_per_adu=GAIN, offset_adu=offset)
    return " ".join(found.text for found in judge_counts(counts, camera, **more).findings)


@pytest.mark.parametrize("power", [0.01, 0.0])
def test_where_the_light_ends_is_found_within_its_error(power: float) -> None:
    pulls, errors = [], []
    for seed in range(SEEDS):
        found = _zero(_movie(seed, offset=TRUE_COUNTS, power=power))
        share = TRUE_COUNTS / (TRUE_COUNTS + LEVEL_E / GAIN)
        assert found.off or not power  # of a steady laser the error is 1.4 % of the light
        assert found.flickers == (power > 0)
        pulls.append((found.electrons - GAIN * TRUE_COUNTS) / (found.se * GAIN * 27e3))
        errors.append(found.se)
        assert abs(found.share - share) < 5 * found.se
    assert abs(np.mean(pulls)) < 1.0  # a tenth of a count of rounding, and few tiles
    assert 0.6 < np.std(pulls) < 1.5
    assert np.median(errors) < (0.004 if power else 0.016)


@pytest.mark.parametrize("kind", ["", "shaking", "slow speckle", "noisy light", "noisy rows"])
@pytest.mark.parametrize("power", [0.01, 0.0])
def test_a_right_offset_is_not_called_wrong(
    kind: str, power: float, repetitions: Callable[[int, int], int]
) -> None:
    for seed in range(repetitions(2, 4) if kind else repetitions(8, SEEDS)):
        said = _said(_movie(seed, kind=kind, power=power))
        assert "camera.offset_adu = 0 is too" not in said
        if kind in {"", "slow speckle"}:
            assert not said


def test_control_the_line_alone_takes_noisy_light_for_an_offset() -> None:
    """Without looking at how much noise there is, the offset would be called wrong."""
    assert _zero(_movie(1, kind="noisy light", power=0.0)).off
    assert _zero(_movie(1, kind="noisy light", power=0.0)).share > 0
    assert not _zero(_movie(1, kind="noisy light")).off  # the laser's flicker does not care


@pytest.mark.parametrize(("power", "why"), [(0.01, "laser's power"), (0.0, "noise grows")])
def test_a_wrong_offset_is_named_with_what_it_does_to_masses(power: float, why: str) -> None:
    missing = _said(_movie(3, offset=TRUE_COUNTS, power=power))
    assert "camera.offset_adu = 0 is too low" in missing
    assert why in missing
    assert "gain" not in missing
    counts, effect, advised = map(
        float, re.findall(r"by (\d+) ± .* masses ([\d.]+) % too small: set .* = (\d+)", missing)[0]
    )
    assert counts == pytest.approx(TRUE_COUNTS, abs=800)
    assert effect == pytest.approx(7.4, abs=3)
    assert advised == counts
    needless = _said(_movie(3, power=power), offset=TRUE_COUNTS)
    assert f"camera.offset_adu = {TRUE_COUNTS} is too high" in needless
    assert "% too large" in needless
    assert ("read noise" in needless) == (power == 0)


def test_a_gain_that_is_wrong_as_well_is_named_as_it_is() -> None:
    said = _said(_movie(3, offset=TRUE_COUNTS, gain=GAIN / 1.5))
    assert "camera.offset_adu = 0 is too low" in said
    (advised,) = map(
        float, re.findall(r"with that offset, .* camera.gain_e_per_adu = ([\d.]+)$", said)
    )
    assert advised == pytest.approx(GAIN / 1.5, rel=0.02)


def test_a_gain_that_is_wrong_is_not_called_an_offset() -> None:
    for gain in (GAIN / 1.3, GAIN * 1.3):
        said = _said(_movie(3, gain=gain))
        assert "set camera.gain_e_per_adu" in said
        assert "offset" not in said


def test_where_nothing_tells_them_apart_both_are_named() -> None:
    """A flat field and a steady laser leave one number: the noise over the light."""
    flat = _movie(3, offset=TRUE_COUNTS, power=0.0, speckle=0.0)
    said = _said(flat)
    assert re.search(r"whether by the gain \(.*\), or by camera.offset_adu = 0", said)
    assert "7.5 % too small" in said
    much = _said(_movie(3, power=0.0, speckle=0.0, gain=GAIN / 2.5))
    assert re.search(r"masses 1[45]0 % too large", much)  # and not 1.5e+02 %
    assert not _said(_movie(3, power=0.0, speckle=0.0))
    assert not _said(flat, additive=True)


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_what_may_be_either_is_one_line(factor: float) -> None:
    """The gain was said to be wrong in one line, and not to be told from the offset in the next."""
    movie = _movie(3, power=0.0, speckle=0.0, gain=GAIN / factor)
    (found,) = judge_counts(movie, Camera(gain_e_per_adu=GAIN)).findings
    assert found.code == "offset-or-gain"
    assert found.values["measured"] == pytest.approx(GAIN / factor, rel=0.02)
    assert ("light that is noisy by itself" in found.text) == (factor > 1)


def test_few_frames_say_nothing() -> None:
    assert find_zero(_movie(1)[:8], Camera(gain_e_per_adu=GAIN)) is None


def test_frames_without_noise_say_nothing() -> None:
    one = _movie(1)[0].astype(np.int64)
    copied = np.stack([one + t % 2 for t in range(40)]).astype(np.uint16)
    assert find_zero(copied, Camera(gain_e_per_adu=GAIN)) is None
