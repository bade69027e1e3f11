"""The errors that all events of a movie share, as a table of fits has them."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.config import Config
from iscat_analysis.optics.model import MassScale
from iscat_analysis.trust.systematic import contributions, total


def systematic(
    config: Config, table: pd.DataFrame, scale: MassScale | None = None
) -> dict[str, NDArray[np.float64]]:
    """Add up what each source makes of every event."""
    return total(contributions(config, table, scale=scale), len(table))
