"""Settings of small movies that are looked at before and after their analysis."""

from __future__ import annotations

from typing import Any

_FIELD = {"simulation.shape": [64, 64], "optics.calibrate": "never"}


def landing_settings(frames: int, *events: dict[str, Any]) -> dict[str, Any]:
    """Set up a landing movie; see `bound_settings`."""
    return _FIELD | {
        "simulation.frames": frames,
        "simulation.count": 0,
        "simulation.leavings": 0,
        "simulation.events": list(events),
        "background.window_frames": 24,
    }


def bound_settings(frames: int, *events: dict[str, Any]) -> dict[str, Any]:
    """Set up a movie of particles that bind in the middle of it."""
    half = frames // 2
    return _FIELD | {
        "simulation.frames": frames,
        "simulation.events": [{"frame": half, **event} for event in events],
        "background.frames": (0, half),
        "fit.frames": (half, frames),
        "posterior.enabled": False,
    }


def moving_settings(side: int, frames: int, **mover: Any) -> dict[str, Any]:
    """Set up a movie of one particle that moves."""
    return {
        "optics.calibrate": "never",
        "camera.pixel_size_nm": 84.0,
        "camera.gain_e_per_adu": 20.0,
        "camera.frame_rate_hz": 331.0,
        "calibration.gradient_per_kda": -3.1e-5,
        "particle.mass_kda": 400.0,
        "fit.mode": "track",
        "fit.roi_nm": 2000.0,
        "posterior.enabled": False,
        "simulation.shape": [side, side],
        "simulation.frames": frames,
        "simulation.photons_per_pixel": 4e5,
        "simulation.movers": [mover],
    }
