"""Documents of ``iscat species``, ``kd``, ``batch`` and ``init``."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from iscat_analysis.schemas.base import (
    ABSENT,
    Closed,
    Count,
    Document,
    Natural,
    Notes,
    Number,
    Share,
)
from iscat_analysis.schemas.fit import Distribution


class LadderFit(Closed):
    """The monomer of a ladder, masses n·monomer + offset."""

    steps: list[int]
    """n of each rung"""
    monomer_kda: float
    """Its mass [kDa]"""
    monomer_se: Number
    """Its statistical standard error [kDa]"""
    monomer_low: Number
    """End of its 95 % interval [kDa]"""
    monomer_high: Number
    """The other end [kDa]"""
    offset_kda: float
    """Offset [kDa]"""
    offset_se: Number
    """Its statistical standard error [kDa]"""
    offset_low: Number
    """End of its 95 % interval [kDa]"""
    offset_high: Number
    """The other end [kDa]"""
    held: bool
    """Whether the monomer was given and not fitted"""
    p_value: Number
    """Of a ladder against free masses; null where they are as many"""


class LandingRate(Closed):
    """How fast particles land: rate = per_second · exp(−depletion_per_s · t)."""

    landings: Count
    """Landings that were seen"""
    seconds: float
    """Time in which they were [s]"""
    per_second: Number
    """Rate in the beginning, of landings that are seen [1/s]"""
    per_second_low: Number
    """End of its 95 % interval [1/s]"""
    per_second_high: Number
    """The other end [1/s]"""
    depletion_per_s: Number
    """Rate at which it falls [1/s]"""
    depletion_low: Number
    """End of its 95 % interval [1/s]"""
    depletion_high: Number
    """The other end [1/s]"""
    depletion_p: Share
    """Chance of such a change if the rate is constant"""
    p_value: Share
    """Chance of times that are as far from this law if it is true"""


class UnbindingRate(Closed):
    """How fast particles leave, from landings paired with leavings."""

    landings: Count
    """Landings that could be followed"""
    pairs: Count
    """Those with a leaving"""
    chance_pairs: Count
    """Pairs found where leavings are moved by half of the field"""
    per_second: Number
    """Rate [1/s]"""
    per_second_low: Number
    """End of its 95 % interval [1/s]"""
    per_second_high: Number
    """The other end [1/s]"""


class Kinetics(Closed):
    """Rates of a table that has a column frame."""

    landing: LandingRate
    """Landings"""
    unbinding: UnbindingRate | None
    """Leavings; null if there are none, or no positions"""
    frame_rate_hz: float
    """Frames per second"""
    frames: tuple[int, int]
    """In which events were looked for, [start, stop)"""
    notes: Notes


class Species(Distribution):
    """What iscat species prints of one table and writes as species.json."""

    source: str
    """The table of events"""
    ladder: LadderFit = ABSENT
    """With --ladder: the monomer"""
    kinetics: Kinetics = ABSENT
    """Rates, where the frames per second are known"""
    out: str = ABSENT
    """When printed: the folder that was written"""


class Test(Closed):
    """A likelihood-ratio test."""

    chi2: float
    """Twice the difference of the log-likelihoods"""
    dof: Count
    """Its degrees of freedom"""
    p_value: Share
    """Chance of at least as much if the hypothesis is true; null without dof"""


class SampleComparison(Document):
    """A sample beside the first one."""

    source: str
    """Its table of events"""
    events: Count
    """Events of the first sample"""
    events_other: Count
    """Events of this sample"""
    same: Test
    """That the samples are one"""
    same_masses: Test
    """That their species have the same masses"""
    same_fractions: Test
    """That their species have the same fractions"""
    background: float
    """Share of the first sample's events that is background"""
    background_other: float
    """The same of this sample"""
    species: list[dict[str, Any]]
    """By rising mass: mass_kda and fraction of the first sample, *_other of this one, shift_kda,
    shift_percent and difference (of this sample minus the first) with 95 % intervals *_low and
    *_high; null if a species is too rare to compare"""


class SpeciesComparison(Document):
    """What iscat species prints of several tables and writes as comparison.json."""

    source: str
    """The table that the others are compared with"""
    comparisons: list[SampleComparison]
    """One for each other table"""
    notes: Notes
    out: str = ABSENT
    """When printed: the folder that was written"""


class Kd(Document):
    """What iscat kd prints and writes as kd.json."""

    source: str
    """The table of samples"""
    model: Literal["dimer", "ab"]
    """2 M ⇌ D, or A + B ⇌ AB"""
    kd_nm: float
    """K_D [nM]"""
    kd_low: float
    """End of its 95 % profile interval [nM]; 0 where there is none"""
    kd_high: Number
    """The other end [nM]; null where there is none"""
    inactive: float
    """Part of monomers, or of A, that does not bind; 0 where not fitted"""
    inactive_se: Number
    """Its standard error; null where it was not fitted"""
    inactive_p: Share
    """Chance of such a gain by an inactive part if there is none"""
    masses_kda: list[float]
    """Masses at which the species' peaks are highest [kDa], the complex last"""
    width_kda: float
    """Width of the lightest species beside the events' own errors [kDa]"""
    tail_kda: float
    """Mean of the peaks' exponential tail, negative to low masses [kDa]"""
    limit_kda: Number
    """Mass that is detected with probability 1/2, from the edge of the tables [kDa]"""
    landing_power: float
    """p of landings ∝ concentration·mass^p"""
    landing_power_se: float
    """Its standard error; 0 where it was given"""
    chi2: float
    """Twice the gain of fractions that are free in every table"""
    dof: int
    """Its degrees of freedom"""
    p_value: Share
    """Chance of at least as much if the tables follow the equilibrium"""
    samples: list[dict[str, Any]]
    """The rows of the samples, with events, complexes (fraction of the particles that landed, with
    95 % interval), predicted (the fraction at equilibrium), pull (their difference in standard
    errors) and background"""
    curve: dict[str, Any]
    """Model dimer: columns concentration_nm and complexes"""
    profile: dict[str, Any]
    """ln_kd_nm, and twice the log-likelihood lost there"""
    notes: Notes
    out: str = ABSENT
    """When printed: the folder that was written"""


Text = str | None


class DayMovie(Document):
    """A row of movies.csv; with --only, its name and state. The user's columns are keys too."""

    movie: str
    """Its name, which its result has too"""
    state: Literal["done", "failed", "missing"]
    """What became of it"""
    why: Text
    """What went wrong"""
    sample: Text = ABSENT
    """Of the table, or the movie's name"""
    condition: Text = ABSENT
    """Of the table"""
    concentration_nm: Number = ABSENT
    """Of the table [nmol/l]"""
    replicate: Text = ABSENT
    """Of the table"""
    role: Literal["sample", "calibrant", "blank", "flat"] = ABSENT
    """What the movie is for"""
    path: str = ABSENT
    """The movie, as the table writes it"""
    cautions: Text = ABSENT
    """What to look at before its numbers are used"""
    report: Text = ABSENT
    """Page of its result, relative to the folder of the batch"""
    events: Count | None = ABSENT
    """Events in all"""
    ok: Count | None = ABSENT
    """Events with the status ok"""
    landings: Count | None = ABSENT
    """Landings"""
    leavings: Count | None = ABSENT
    """Leavings"""
    species: Count | None = ABSENT
    """Species, without outliers"""
    main_mass_kda: Number = ABSENT
    """Mass of the species with most events [kDa]"""
    answer: Text = ABSENT
    """What the movie says in a line: its species, or a median of one"""
    rate_per_s: Number = ABSENT
    """Landings per second"""
    rate_low: Number = ABSENT
    """End of its 95 % Poisson interval"""
    rate_high: Number = ABSENT
    """The other end"""
    rate_per_um2_s: Number = ABSENT
    """The same per square micrometre [1/(µm² s)]"""
    frames_searched: Number = ABSENT
    """Frames in which a landing is found"""
    seconds_searched: Number = ABSENT
    """The same as a time [s]"""
    field_um2: Number = ABSENT
    """Area of the frame [µm²]"""
    frames: Count | None = ABSENT
    """Frames of the movie"""
    drift_px: Number = ABSENT
    """How far the fixed pattern moved [pixels]"""
    focus_shift_nm: Number = ABSENT
    """Focus less that of the day, where it was learned [nm]"""
    noise_over_shot: Number = ABSENT
    """Variance over that of shot noise"""
    noise_frames: Number = ABSENT
    """Number of averaged frames that it is of"""
    median_p_value: Share = ABSENT
    """Of the events"""
    small_p_values: Share = ABSENT
    """Share of p-values below 0.01"""
    repeat_over_crb: Number = ABSENT
    """Spread on disjoint frames over the bound"""
    standards_seen: Text = ABSENT
    """Standards found in a calibrant, as in 3 of 3"""
    optics: Text = ABSENT
    """Where the optics come from"""
    mass_scale: Text = ABSENT
    """Where the mass scale comes from"""
    outside_standards: Share = ABSENT
    """Share of masses beyond the standards"""
    remarks: Count | None = ABSENT
    """Warnings of its result"""
    sha256: Text = ABSENT
    """Of the movie"""


class DaySpecies(Document):
    """A row of species.csv: a species of a movie."""

    movie: str
    """Its movie"""
    sample: Text
    """Of the movie"""
    condition: Text
    """Of the movie"""
    concentration_nm: Number
    """Of the movie [nmol/l]"""
    replicate: Text
    """Of the movie"""
    role: str
    """Of the movie"""
    kind: Count
    """The same for species of several movies with one mass; 0 for outliers"""
    mass_kda: Number
    """Mass [kDa]"""
    mass_se: Number
    """Its statistical standard error [kDa]"""
    mass_low: Number
    """End of its 95 % interval [kDa]"""
    mass_high: Number
    """The other end [kDa]"""
    mass_systematic: Number
    """Error that the movie's masses have in common [kDa]"""
    width_kda: Number
    """Width beyond the noise [kDa]"""
    width_low: Number
    """End of its 95 % interval [kDa]"""
    width_high: Number
    """The other end [kDa]"""
    count: Number
    """Events"""
    count_low: Number
    """End of its 95 % interval"""
    count_high: Number
    """The other end"""
    fraction: Share
    """Of the particles that came"""
    fraction_low: Share
    """End of its 95 % interval"""
    fraction_high: Share
    """The other end"""
    share: Share
    """The same without outliers"""
    share_low: Share
    """End of its 95 % interval"""
    share_high: Share
    """The other end"""
    count_corrected: Number
    """Events and those that were missed"""
    corrected_low: Number
    """End of its 95 % interval"""
    corrected_high: Number
    """The other end"""
    landing: Number
    """Landings"""
    leaving: Number
    """Leavings"""
    efficiency: Number
    """Share of its particles that are detected"""
    rate_per_s: Number
    """Landings per second, corrected"""
    rate_low: Number
    """End of its 95 % interval"""
    rate_high: Number
    """The other end"""
    outlier: bool
    """One or two events apart from all others"""


class DayKd(Closed):
    """A row of kd.csv: the equilibrium of a condition."""

    condition: Text
    """The condition"""
    model: Literal["dimer", "ab"]
    """2 M ⇌ D, or A + B ⇌ AB"""
    movies: Count
    """Movies with enough events"""
    kd_nm: Number
    """K_D [nM]"""
    kd_low: Number
    """End of its 95 % profile interval [nM]"""
    kd_high: Number
    """The other end [nM]; null where there is none"""
    inactive_p: Share
    """Chance of such a gain by an inactive part if there is none"""
    p_value: Share
    """Chance of at least such a distance if the movies follow the equilibrium"""
    masses_kda: Text
    """Masses of the species [kDa]"""
    remarks: Text
    """What the user should know"""
    why: Text
    """Why there is no K_D"""


class NotDone(Closed):
    """A movie, a calibration or a K_D that failed."""

    name: str
    """Which"""
    why: str
    """What went wrong, or that it is not analysed yet"""


class Batch(Document):
    """What iscat batch and iscat watch print."""

    out: str
    """Folder of the batch"""
    page: str = ABSENT
    """Its page, once there is one"""
    movies: list[DayMovie]
    """One for each movie"""
    species: list[DaySpecies]
    """One for each species of each movie; empty of a part"""
    kd: list[DayKd]
    """With --kd: one for each condition"""
    analysed: list[str]
    """Movies that were analysed now; the others were finished before"""
    failed: list[NotDone]
    """What failed, or is not analysed yet"""


class SetupValue(Document):
    """A value of the configuration."""

    value: float | str
    """The value"""
    se: Number
    """Its standard error, where it was measured"""
    origin: str = Field(alias="from")
    """Where it comes from: read from the file, measured from the movie, your answer, instrument
    NAME, assumed, to be given; and whether it will be learned"""


class Look(Document):
    """What the search found in some parts of the movie."""

    frames: list[Count]
    """The frames at which it looked"""
    window: Natural
    """Frames in each of its windows"""
    candidates: list[Count]
    """Number of candidates in each part"""
    threshold_snr: Number
    """Signal-to-noise ratio above which something is a candidate"""
    strongest_snr: Number
    """That of the strongest candidate"""
    noise_contrast: Number
    """Standard deviation of a pixel of the contrast that is searched"""
    light_e: Number
    """Photoelectrons in a pixel of a frame"""


class Init(Document):
    """What iscat init prints."""

    movie: str
    """Name of the movie"""
    shape: Annotated[list[Natural], Field(min_length=3, max_length=3)]
    """Frames, rows, columns"""
    values: dict[str, SetupValue]
    """The configuration, by section.key"""
    notes: list[str]
    """What the movie gives to say"""
    preview: Look
    """What the search saw"""
    out: str
    """The configuration that was written"""
