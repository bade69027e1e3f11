"""Tables of events, and the selections of them that a result page saves."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from iscat_analysis.config.analysis import Calibration
from iscat_analysis.errors import DataError
from iscat_analysis.species.tables import event_table


class TestSelection:
    """What the result page saves, and `iscat species --select` reads."""

    def table(self) -> pd.DataFrame:
        mass = np.random.default_rng(4).normal(np.repeat([66.0, -146.0, 480.0], 20), 5.0)
        return pd.DataFrame(
            {
                "event": np.arange(60),
                "frame": 10 * np.arange(60),
                "mass_kda": mass,
                "sigma_mass_kda": 5.0,
                "contrast": -3.1e-5 * mass,
                "status": "ok",
            }
        )

    def saved(self, folder: Path, quantity: str, gates: list[list[float]], frame: int) -> Path:
        rejected = [{"event": 25, "frame": frame, "x_px": 1.0, "y_px": 2.0}]
        content = {"movie": "a.tif", "quantity": quantity, "gates": gates, "rejected": rejected}
        file = folder / "selection.json"
        file.write_text(json.dumps(content), encoding="utf-8")
        return file

    @pytest.mark.parametrize(("quantity", "unit"), [("mass", 1.0), ("contrast", 3.1e-2)])
    def test_keeps_what_is_inside_its_gates_and_not_rejected(
        self, tmp_path: Path, quantity: str, unit: float
    ) -> None:
        file = self.saved(tmp_path, quantity, [[unit * 100, unit * 200]], 250)
        found = event_table(self.table(), select=file)
        assert np.abs(found.mass_kda).min() > 100
        assert len(found.mass_kda) == 19
        assert "41 events that the selection leaves out" in found.findings[0].text
        everywhere = event_table(self.table(), select=self.saved(tmp_path, quantity, [], 250))
        assert len(everywhere.mass_kda) == 59

    def test_of_another_result_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(DataError, match="no event 25 at frame 251"):
            event_table(self.table(), select=self.saved(tmp_path, "mass", [], 251))
        with pytest.raises(DataError, match="has no diameter_nm"):
            event_table(self.table(), select=self.saved(tmp_path, "diameter", [], 250))
        (tmp_path / "no.json").write_text("[]", encoding="utf-8")
        with pytest.raises(DataError, match="is no selection"):
            event_table(self.table(), select=tmp_path / "no.json")


@pytest.mark.parametrize(("scale", "refused"), [("absolute model", True), ("calibration", False)])
def test_masses_on_the_scale_of_the_model_are_no_masses(
    tmp_path: Path, scale: str, refused: bool
) -> None:
    """A sample of 66, 146 and 480 kDa was told as 2985, 6380 and 20 906, labelled kDa."""
    TestSelection().table().to_csv(tmp_path / "fits.csv", index=False)
    (tmp_path / "summary.json").write_text(json.dumps({"mass_scale": scale}), encoding="utf-8")
    if not refused:
        assert len(event_table(tmp_path).mass_kda) == 60
        return
    with pytest.raises(DataError, match="an uncalibrated absolute scale is not a mass"):
        event_table(tmp_path)
    assert len(event_table(tmp_path, any_scale=True).mass_kda) == 60
    line = Calibration(gradient_per_kda=-3.1e-5)
    assert len(event_table(tmp_path, calibration=line).mass_kda) == 60
