"""Registration of pictures and of patterns, beside that of scikit-image; each can fail."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from skimage.registration import phase_cross_correlation

from iscat_analysis.camera import measure_drift
from iscat_analysis.inference.laws import CONDITIONAL
from iscat_analysis.instrument.particle_image import ParticleImage, average_particle_images
from iscat_analysis.optics.forward import PixelGrid

FloatArray = NDArray[np.float64]
SIDE, PIXEL_NM = 25, 84.4
PHOTONS = 1e6
PATTERN_PX, WIDE = 1.5, 256


def particle(y_px: float, x_px: float) -> FloatArray:
    """Draw a spot with a ring of the other sign."""
    y, x = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    r = np.hypot(y - y_px, x - x_px)
    return -np.exp(-(r**2) / 4.5) + 0.35 * np.exp(-((r - 4.5) ** 2) / 2.5)


def picture(random: np.random.Generator, snr: float) -> tuple[FloatArray, ...]:
    """Draw a contrast, where its particle is, and where it is first thought to be [px]."""
    place = random.uniform(-2, 2, 2)
    signal = random.choice([-1, 1]) * particle(*place)
    noise = math.sqrt(2 / PHOTONS)
    scale = snr * noise / np.linalg.norm(particle(0, 0))
    contrast = scale * signal + noise * random.standard_normal(signal.shape)
    return contrast, place, np.rint(place) + random.integers(-1, 2, 2)


def image(contrast: FloatArray, first: FloatArray) -> ParticleImage:
    data = np.zeros((4, SIDE, SIDE))
    data[0], data[2], data[3] = PHOTONS * (1 + contrast), 1.0, 1.0
    data[1] = PHOTONS + data[0]
    y_nm, x_nm = first * PIXEL_NM
    return ParticleImage(
        PixelGrid.centred(SIDE, PIXEL_NM), CONDITIONAL, data, float(x_nm), float(y_nm), 0.0
    )


def misplaced(seed: int, snr: float, number: int = 12) -> FloatArray:
    """Distances of pictures from where they are [px], but for what all have in common."""
    random = np.random.default_rng([31, seed])
    contrasts, places, first = zip(*(picture(random, snr) for _ in range(number)), strict=True)
    first = (places[0], *first[1:])
    placed = average_particle_images([image(c, f) for c, f in zip(contrasts, first, strict=True)])[
        1
    ]
    found = np.array([[one.y_nm, one.x_nm] for one in placed]) / PIXEL_NM
    apart = found - np.array(places)
    return np.hypot(*(apart - np.median(apart, axis=0)).T)


def test_pictures_are_registered_to_half_a_pixel(repetitions: Callable[[int, int], int]) -> None:
    """A start for the fit of the optics: some twice of what the light tells, 1/(snr·g).

    Here g is the gradient of the drawn particle, relative to its size.
    """
    steps = [(particle(h, 0) - particle(-h, 0)) / (2 * h) for h in (1e-3,)]
    gradient = np.linalg.norm(steps[0]) / np.linalg.norm(particle(0, 0))
    for snr in (15.0, 40.0):
        apart = np.concatenate([misplaced(seed, snr) for seed in range(repetitions(10, 60))])
        assert np.mean(apart > 1) < 0.02
        bound = math.sqrt(2) / (snr * gradient)
        assert 0.8 * bound < np.sqrt(np.mean(apart[apart < 1] ** 2)) < 0.5  # pixels: a start


def patterns(seed: int, photons: float, reach_px: float) -> tuple[FloatArray, ...]:
    """Draw two pictures of a pattern that moved, and how far."""
    random = np.random.default_rng([33, seed])
    f = np.fft.fftfreq(WIDE)
    envelope = np.exp(-((f[:, None] ** 2 + f**2) * (2 * math.pi * PATTERN_PX) ** 2 / 2))
    spectrum = np.fft.fft2(random.standard_normal((WIDE, WIDE))) * envelope
    shift = random.uniform(-reach_px, reach_px, 2)
    turn = np.exp(-2j * np.pi * (f[:, None] * shift[0] + f * shift[1]))
    images = [np.fft.ifft2(s).real[:96, :96] for s in (spectrum, spectrum * turn)]
    scale = 0.1 / images[0].std()
    one, two = (random.poisson(photons * np.maximum(1 + scale * i, 0.0)) for i in images)
    return one.astype(float), two.astype(float), shift


def test_drift_is_closer_than_a_phase_correlation_gives_it(
    repetitions: Callable[[int, int], int],
) -> None:
    taper = np.outer(np.hanning(96), np.hanning(96))
    for photons in (1e3, 1e5):
        ours, theirs = [], []
        for seed in range(repetitions(15, 100)):
            one, two, shift = patterns(seed, photons, 1.5)
            ours.append(np.hypot(*(np.array(measure_drift(one, two)) - shift)))
            found, *_ = phase_cross_correlation(
                *(taper * (image / image.mean() - 1) for image in (one, two)),
                normalization="phase", upsample_factor=50,
            )  # fmt: skip
            theirs.append(np.hypot(*(-found - shift)))
        assert np.median(ours) < 0.05
        assert np.median(ours) < 0.5 * np.median(theirs)


def test_of_noise_alone_a_phase_correlation_gives_a_shift_all_the_same(
    repetitions: Callable[[int, int], int],
) -> None:
    for seed in range(repetitions(10, 50)):
        one, two = np.random.default_rng([34, seed]).poisson(1e5, (2, 96, 96)).astype(float)
        assert np.isnan(measure_drift(one, two)).all()
        found, *_ = phase_cross_correlation(one, two, normalization="phase")
        assert np.isfinite(found).all()
