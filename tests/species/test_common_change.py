"""Masses that change together are told from one track that changes, and from noise."""

from __future__ import annotations

import numpy as np

from iscat_analysis.species.tracks import common_change

FRAMES = (100, 900)
LENGTH = 300  # of a track
SIGMA = 0.08  # of the mass of a frame


def _tracks(change: np.ndarray, only: int | None, seed: int) -> list[tuple[np.ndarray, ...]]:
    """Six tracks here and there; `change` is relative, in every frame."""
    rng = np.random.default_rng(seed)
    out = []
    for k, begin in enumerate(rng.integers(FRAMES[0], FRAMES[1] - LENGTH, 6)):
        frame = np.arange(begin, begin + LENGTH)
        felt = change[frame - FRAMES[0]] if only is None or k == only else 0.0
        mass = 100 * (1 + k) * (1 + felt + SIGMA * rng.standard_normal(LENGTH))
        out.append((frame, mass, np.full(LENGTH, 100 * (1 + k) * SIGMA)))
    return out


def test_a_drift_of_all_is_found_with_its_size() -> None:
    time = np.linspace(-1, 1, FRAMES[1] - FRAMES[0])
    tracks = [_tracks(0.15 * time, None, seed) for seed in range(8)]
    found = np.array([common_change(each, FRAMES) for each in tracks])
    assert (found > 0).all()
    np.testing.assert_allclose(found.mean(), 0.3, atol=0.05)


def test_nothing_is_found_in_noise_nor_where_one_changes() -> None:
    time = np.linspace(-1, 1, FRAMES[1] - FRAMES[0])
    assert not any(common_change(_tracks(0 * time, None, seed), FRAMES) for seed in range(50))
    assert not any(common_change(_tracks(2 * time, 2, seed), FRAMES) for seed in range(8))
    assert common_change(_tracks(time, None, 0)[:2], FRAMES) == 0.0  # two may both have changed


def test_two_tracks_that_exchange_their_particles_are_no_drift() -> None:
    """As where 200 and 400 kDa meet; all tracks of a movie were flagged for it."""
    for seed in range(20):
        tracks = _tracks(np.zeros(FRAMES[1] - FRAMES[0]), None, seed)
        rng = np.random.default_rng(seed)
        middle = rng.uniform(0.2, 0.8) * FRAMES[1]
        for k, (before, after) in enumerate(((200.0, 400.0), (400.0, 200.0))):
            frame, mass, sigma = tracks[k]
            mass = mass * np.where(frame < middle, before, after) / 200.0
            tracks[k] = frame, mass, sigma
        assert common_change(tracks, FRAMES) == 0.0
