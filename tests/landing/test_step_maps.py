"""Maps from which known steps are taken off around them alone, beside maps made anew."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from iscat_analysis.config import load_config
from iscat_analysis.landing import steps as steps_module
from iscat_analysis.landing.maps import StepMaps
from iscat_analysis.landing.neighbours import Step
from iscat_analysis.pipeline import fit_stack
from iscat_analysis.study import write_stack

SAMPLE = Path(__file__).resolve().parents[2] / "sample_configs" / "landing.toml"


class Judged(StepMaps):
    """Compares its maps, after every change of what is known, with maps made anew."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.arguments = arguments

    def without(self, steps: Sequence[Step], mapper: Any) -> Any:
        """See `StepMaps`."""
        found = super().without(steps, mapper)
        assert self.is_local
        blank, slow = StepMaps(*self.arguments), StepMaps(*self.arguments)
        slow.is_local = False
        expected, effective = slow.without(steps, mapper)
        np.testing.assert_allclose(found[1], effective, rtol=1e-12)
        taken = np.abs(blank.without([], mapper)[0] - expected).max()
        CALLS.append((len(steps), taken, np.abs(found[0] - expected).max()))
        return found


CALLS: list[tuple[int, float, float]] = []


@pytest.mark.parametrize(
    "heaviest", [480.0, pytest.param(3000.0, marks=pytest.mark.large)], ids=["weak", "strong"]
)
def test_maps_are_those_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, heaviest: float
) -> None:
    places = [(90, 20.3, 21.7, 480), (110, 27.1, 24.0, 146), (150, 3.1, 60.2, 300),
              (130, 44.0, 40.0, heaviest)]  # fmt: skip
    events = ", ".join(
        f"{{frame={frame}, x_px={x}, y_px={y}, mass_kda={mass}}}" for frame, x, y, mass in places
    )
    config = load_config(
        SAMPLE,
        [
            "simulation.shape=[64, 64]", "simulation.frames=240", "simulation.count=0",
            "simulation.leavings=0", f"simulation.events=[{events}]",
            "background.window_frames=40", "compute.workers=1",
        ],
    )  # fmt: skip
    write_stack(config, tmp_path / "movie.tif", seed=1)
    monkeypatch.setattr(steps_module, "StepMaps", Judged)
    CALLS.clear()
    found = fit_stack(tmp_path / "movie.tif", config)
    assert len(found.table) >= len(places)
    known, taken, apart = np.array(CALLS).T
    assert known[0] == 0
    assert known[-1] >= len(places)
    assert taken[-1] > 20
    assert apart.max() < 3e-6 * taken.max()
