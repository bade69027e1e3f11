"""Movies of other microscopes with background frames, analysed with the nominal one.

    python benchmarks/microscopes_fixed.py [--seed N]… [--only NAME]

Through each microscope of the table in ``microscopes.py`` a movie in which all particles bind after
the background frames, and which is analysed with a model that stays wrong.  An event counts as true
within 3 pixels of a particle; every other row that is not a side lobe is false.  Exit status 1
where more than a twentieth of the true ones are, the movies of all seeds together.
"""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from microscopes import MICROSCOPES, SEEDS, compare, nominal, tally

from instruments import Instrument, InstrumentMovie, draw_landings  # isort: skip

from iscat_analysis.camera import camera_from_config, measure_windows
from iscat_analysis.config import Config
from iscat_analysis.diagnosis import misfit_warning
from iscat_analysis.fitting.context import make_context
from iscat_analysis.fitting.field import fit_field
from iscat_analysis.fitting.results import table_of
from iscat_analysis.records import FRAME_COLUMN

SHAPE = (200, 200, 200)
BOUND = 100
"""Frame from which the particles are there."""
COUNT = 30


def fixed(config: Config) -> Config:
    """Give the same configuration with background frames."""
    background = config.background.model_copy(update={"method": "fixed", "frames": (0, BOUND)})
    return config.model_copy(update={"background": background})


def judge(name: str, seed: int) -> dict[str, Any]:
    """Analyse one movie with the nominal model and count."""
    landings = draw_landings(SHAPE, COUNT, seed=seed, frame=BOUND, apart_px=12.0)
    movie = InstrumentMovie(Instrument(**MICROSCOPES[name]), SHAPE, landings, seed=seed + 2)
    config = fixed(nominal())
    context = make_context(config, SHAPE[1:])
    start = time.process_time()
    camera = camera_from_config(config.camera, movie.shape[1:], movie.dtype)
    windows = measure_windows(movie, camera, (0, BOUND), (BOUND, SHAPE[0]))
    with ThreadPoolExecutor(1) as pool:
        events, windows = fit_field(context, windows, pool=pool)
    table = table_of(context, events)
    seconds = time.process_time() - start
    table = table[table["status"] != "sidelobe"].reset_index(drop=True)
    table = table.assign(frame=BOUND, **{FRAME_COLUMN: 0})
    return tally(landings, table, seconds, misfit_warning(config, events))


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, action="append")
    parser.add_argument("--only", choices=list(MICROSCOPES), action="append")
    options = parser.parse_args()
    seeds = options.seed or SEEDS
    print(f"{COUNT} particles in {SHAPE[2]} x {SHAPE[1]} pixels, seeds {seeds}")
    return int(compare(options.only or list(MICROSCOPES), judge, seeds))


if __name__ == "__main__":
    sys.exit(main())
