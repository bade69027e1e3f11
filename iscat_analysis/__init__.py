"""Particles in interferometric scattering movies, and how near their fits come to the bound.

Pieces, which take arrays and a microscope, and need neither a file nor a movie::

    import iscat_analysis as ia

    optics, camera = ia.Optics(na=1.42, focus_nm=-300), ia.Camera(pixel_size_nm=84.4)
    protein = ia.Particle(mass_kda=480)

    ia.psf(optics, protein, camera, z_nm=[0, 50, 100])          # images, (3, y, x)
    ia.fit_rois(before, after, optics, protein, camera,
                n_before=200, n_after=200)                      # pandas.DataFrame, one row each
    ia.log_likelihood(...)                                      # of θ in nm and kDa, with gradient
    ia.crb(optics, protein, camera, photons_per_pixel=1e4)      # what no estimate can beat
    ia.qcrb(...)                                                # whatever the camera
    ia.fit_diffusion(frames, positions_nm, sigma_nm, frame_rate_hz=331)  # of a track, with its CRB

The yardstick, for whoever simulates and estimates by other means::

    ia.bounds_for("setup.toml")                     # CRB, QCRB and Holevo bound
    ia.efficiency(estimates, truth, "setup.toml")   # bias, spread, efficiency, each with 95 %

Answers, from any table of events::

    ia.find_species("movie.iscat", ladder=66)       # masses, fractions, intervals
    ia.compare_samples("a.csv", "b.csv", k=2)       # shifts, differences of fractions, p-values
    ia.fit_kd("samples.csv", model="dimer")         # K_D with its profile interval
    ia.fit_kinetics("movie.iscat")                  # rates of landing, depletion and leaving

Whole jobs, from a movie to a report::

    setup = ia.configure("setup.toml", settings={"optics.na": 1.42})
    ia.instruments              # named set-ups to begin with: ia.configure(instrument="iscat")
    result = ia.fit_movie("movie.tif", config=setup, background=(0, 200))
    result                      # species, counts, errors; in a notebook, drawn as HTML
    result.species              # pandas.DataFrame, one row per species; .events, .findings
    result.table                # pandas.DataFrame, one row per event
    result.plot_masses()        # matplotlib Axes; also plot_field, plot_precision, plot_tracks
    result.plot_event(0)        # data, model, residual
    result.posterior(0)         # arviz.InferenceData
    result.tracks               # of particles that move: mass, D, one row per track
    result.save("movie.iscat")  # report.html, fits.csv, fits.parquet, …
    ia.open_result("movie.iscat").plot_event(0)     # a folder that was written before
    ia.Preview(ia.open_stack("movie.tif"), setup).look(200).found()  # what the search sees there
    ia.calibrate_optics("movie.tif", config=setup)  # focus, aberrations… from the movie itself
    ia.batch("samples.csv", out="day", config=setup)  # a day's movies: calibrations, one picture
    ia.watch("movies", config=setup)                # the same as they are saved, until Ctrl-C
    ia.compute_bounds(setup)    # what no estimate from such frames can beat
    ia.forecast_optics(setup)   # how well they would tell focus, NA, aberrations…

`fit_movie` runs load → calibrate → background → detect → fit → posterior → bounds.  The modules of
these names hold the stages; `iscat_analysis.pipeline` joins them, and `fit_stack` there is what the
command line calls.  `simulate_movie` makes a movie whose truth is known, `open_stack` reads frames
lazily, `schema` gives the JSON schema of what the commands print.

Lengths are nm, masses kDa, counts photoelectrons, as the names say; axes are (t, y, x); frame
ranges are half-open.  Errors meant for the user are `ConfigError` and `DataError`, both an
`IscatError`.

Names are imported when they are first used, so that ``import iscat_analysis`` is quick.
"""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # in the order of the manual
    # isort: off
    from iscat_analysis.config import Optics as Optics
    from iscat_analysis.config import Particle as Particle
    from iscat_analysis.pieces import Camera as Camera
    from iscat_analysis.config import Calibration as Calibration
    from iscat_analysis.pieces import psf as psf
    from iscat_analysis.pieces import fit_rods as fit_rods
    from iscat_analysis.pieces import fit_rois as fit_rois
    from iscat_analysis.pieces import log_likelihood as log_likelihood
    from iscat_analysis.pieces import LogLikelihood as LogLikelihood
    from iscat_analysis.pieces import crb as crb
    from iscat_analysis.pieces import qcrb as qcrb
    from iscat_analysis.species import fit_diffusion as fit_diffusion
    from iscat_analysis.species import Diffusion as Diffusion
    from iscat_analysis.species import anomalous_test as anomalous_test
    from iscat_analysis.species import AnomalousTest as AnomalousTest
    from iscat_analysis.species import confinement_test as confinement_test
    from iscat_analysis.species import ConfinementTest as ConfinementTest
    from iscat_analysis.species import hydrodynamic_diameter as hydrodynamic_diameter
    from iscat_analysis.species import refractive_index as refractive_index
    from iscat_analysis.report.exchange import to_trackpy as to_trackpy
    from iscat_analysis.report.exchange import to_napari as to_napari
    from iscat_analysis.report.exchange import tracked_rows as tracked_rows
    from iscat_analysis.pipeline.stored import open_result as open_result
    from iscat_analysis.pipeline.stored import StoredResult as StoredResult
    from iscat_analysis.pipeline.preview import Preview as Preview
    from iscat_analysis.pipeline.kinds import Look as Look
    from iscat_analysis.report.exchange import to_photomol as to_photomol
    from iscat_analysis.report.exchange import to_picasso as to_picasso
    from iscat_analysis.config import configure as configure
    from iscat_analysis.day import batch as batch
    from iscat_analysis.day import Batch as Batch
    from iscat_analysis.day.watch import watch as watch
    from iscat_analysis.notebook import fit_movie as fit_movie
    from iscat_analysis.notebook import Result as Result
    from iscat_analysis.notebook import simulate_movie as simulate_movie
    from iscat_analysis.notebook import calibrate_optics as calibrate_optics
    from iscat_analysis.answers.species import find_species as find_species
    from iscat_analysis.answers.comparing import compare_samples as compare_samples
    from iscat_analysis.answers.comparing import compare_tables as compare_tables
    from iscat_analysis.answers.binding import fit_kd as fit_kd
    from iscat_analysis.answers.binding import Binding as Binding
    from iscat_analysis.answers.kinetics import fit_kinetics as fit_kinetics
    from iscat_analysis.answers.kinetics import Kinetics as Kinetics
    from iscat_analysis.species import Comparison as Comparison
    from iscat_analysis.species import Distribution as Distribution
    from iscat_analysis.notebook import compute_bounds as compute_bounds
    from iscat_analysis.study.efficiency import bounds_for as bounds_for
    from iscat_analysis.study.efficiency import efficiency as efficiency
    from iscat_analysis.study.estimator_setup import EstimatorSetup as EstimatorSetup
    from iscat_analysis.notebook import forecast_optics as forecast_optics
    from iscat_analysis.notebook import Bounds as Bounds
    from iscat_analysis.config import Config as Config
    from iscat_analysis.config import load_config as load_config
    from iscat_analysis.config import instruments as instruments
    from iscat_analysis.config import config_to_toml as config_to_toml
    from iscat_analysis.movie import open_stack as open_stack
    from iscat_analysis.movie import Stack as Stack
    from iscat_analysis.pipeline import fit_stack as fit_stack
    from iscat_analysis.records import Analysis as Analysis
    from iscat_analysis.records import Status as Status
    from iscat_analysis.records import EVENT_COLUMNS as EVENT_COLUMNS
    from iscat_analysis.records import FREE_PARAMETERS as FREE_PARAMETERS
    from iscat_analysis.records import TRACK_COLUMNS as TRACK_COLUMNS
    from iscat_analysis.records import TrackStatus as TrackStatus
    from iscat_analysis.errors import IscatError as IscatError
    from iscat_analysis.errors import ConfigError as ConfigError
    from iscat_analysis.errors import DataError as DataError
    from iscat_analysis.schemas import schema as schema
    # isort: on

_TYPED = re.compile(r"^    from (\S+) import (\w+) as", re.MULTILINE)
_HOME = {name: module for module, name in _TYPED.findall(Path(__file__).read_text("utf-8"))}
"""Module of each public name, as the list for type checkers has it."""

__all__ = [*_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
