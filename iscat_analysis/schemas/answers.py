"""Documents of ``iscat species``, ``kd``, ``batch`` and ``init``."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from iscat_analysis.schemas.base import (
    Closed,
    Count,
    Document,
    Error,
    High,
    Low,
    Natural,
    Notes,
    Number,
    Share,
    Written,
    key,
    maybe,
)
from iscat_analysis.schemas.fit import Distribution


class LadderFit(Closed):
    """The monomer of a ladder, masses n·monomer + offset."""

    steps: list[int] = key("n of each rung")
    monomer_kda: float = key("Its mass [kDa]")
    monomer_se: Error
    monomer_low: Low
    monomer_high: High
    offset_kda: float = key("Offset [kDa]")
    offset_se: Error
    offset_low: Low
    offset_high: High
    held: bool = key("Whether the monomer was given and not fitted")
    p_value: Number = key("Of a ladder against free masses; null where they are as many")


class LandingRate(Closed):
    """How fast particles land: rate = per_second · exp(−depletion_per_s · t)."""

    landings: Count = key("Landings that were seen")
    seconds: float = key("Time in which they were [s]")
    per_second: Number = key("Rate in the beginning, of landings that are seen [1/s]")
    per_second_low: Low
    per_second_high: High
    depletion_per_s: Number = key("Rate at which it falls [1/s]")
    depletion_low: Low
    depletion_high: High
    depletion_p: Share = key("Chance of such a change if the rate is constant")
    p_value: Share = key("Chance of times that are as far from this law if it is true")


class UnbindingRate(Closed):
    """How fast particles leave, from landings paired with leavings."""

    landings: Count = key("Landings that could be followed")
    pairs: Count = key("Those with a leaving")
    chance_pairs: Count = key("Pairs found where leavings are moved by half of the field")
    per_second: Number = key("Rate [1/s]")
    per_second_low: Low
    per_second_high: High


class Kinetics(Closed):
    """Rates of a table that has a column frame."""

    landing: LandingRate = key("Landings")
    unbinding: UnbindingRate | None = key("Leavings; null if there are none, or no positions")
    frame_rate_hz: float = key("Frames per second")
    frames: tuple[int, int] = key("In which events were looked for, [start, stop)")
    notes: Notes


class Species(Distribution):
    """What iscat species prints of one table and writes as species.json."""

    source: str = key("The table of events")
    ladder: LadderFit = maybe("With --ladder: the monomer")
    kinetics: Kinetics = maybe("Rates, where the frames per second are known")
    out: Written


class Test(Closed):
    """A likelihood-ratio test."""

    chi2: float = key("Twice the difference of the log-likelihoods")
    dof: Count = key("Its degrees of freedom")
    p_value: Share = key("Chance of at least as much if the hypothesis is true; null without dof")


class SampleComparison(Document):
    """A sample beside the first one."""

    source: str = key("Its table of events")
    events: Count = key("Events of the first sample")
    events_other: Count = key("Events of this sample")
    same: Test = key("That the samples are one")
    same_masses: Test = key("That their species have the same masses")
    same_fractions: Test = key("That their species have the same fractions")
    background: float = key("Share of the first sample's events that is background")
    background_other: float = key("The same of this sample")
    species: list[dict[str, Any]] = key(
        "By rising mass: mass_kda and fraction of the first sample, *_other of this one, "
        "shift_kda, shift_percent and difference (of this sample minus the first) with 95 % "
        "intervals *_low and *_high; null if a species is too rare to compare"
    )


class SpeciesComparison(Document):
    """What iscat species prints of several tables and writes as comparison.json."""

    source: str = key("The table that the others are compared with")
    comparisons: list[SampleComparison] = key("One for each other table")
    notes: Notes
    out: Written


class Kd(Document):
    """What iscat kd prints and writes as kd.json."""

    source: str = key("The table of samples")
    model: Literal["dimer", "ab"] = key("2 M ⇌ D, or A + B ⇌ AB")
    kd_nm: float = key("K_D [nM]")
    kd_low: float = key("End of its 95 % profile interval [nM]; 0 where there is none")
    kd_high: Number = key("The other end [nM]; null where there is none")
    inactive: float = key("Part of monomers, or of A, that does not bind; 0 where not fitted")
    inactive_se: Number = key("Its standard error; null where it was not fitted")
    inactive_p: Share = key("Chance of such a gain by an inactive part if there is none")
    masses_kda: list[float] = key("Highest points of the species' peaks [kDa], the complex last")
    width_kda: float = key("Width of the lightest species beside the events' own errors [kDa]")
    tail_kda: float = key("Mean of the peaks' exponential tail, negative to low masses [kDa]")
    limit_kda: Number = key("Mass detected with probability 1/2, from the edge of the tables [kDa]")
    landing_power: float = key("p of landings ∝ concentration·mass^p")
    landing_power_se: float = key("Its standard error; 0 where it was given")
    chi2: float = key("Twice the gain of fractions that are free in every table")
    dof: int = key("Its degrees of freedom")
    p_value: Share = key("Chance of at least as much if the tables follow the equilibrium")
    samples: list[dict[str, Any]] = key(
        "The rows of the samples, with events, complexes (fraction of the particles that landed, "
        "with 95 % interval), predicted (the fraction at equilibrium), pull (their difference in "
        "standard errors) and background"
    )
    curve: dict[str, Any] = key("Model dimer: columns concentration_nm and complexes")
    profile: dict[str, Any] = key("ln_kd_nm, and twice the log-likelihood lost there")
    notes: Notes
    out: Written


Text = str | None


class DayMovie(Document):
    """A row of movies.csv; with --only, its name and state. The user's columns are keys too."""

    movie: str = key("Its name, which its result has too")
    state: Literal["done", "failed", "missing"] = key("What became of it")
    why: Text = key("What went wrong")
    sample: Text = maybe("Of the table, or the movie's name")
    condition: Text = maybe("Of the table")
    concentration_nm: Number = maybe("Of the table [nmol/l]")
    replicate: Text = maybe("Of the table")
    role: Literal["sample", "calibrant", "blank", "flat"] = maybe("What the movie is for")
    path: str = maybe("The movie, as the table writes it")
    cautions: Text = maybe("What to look at before its numbers are used")
    report: Text = maybe("Page of its result, relative to the folder of the batch")
    events: Count | None = maybe("Events in all")
    ok: Count | None = maybe("Events with the status ok")
    landings: Count | None = maybe("Landings")
    leavings: Count | None = maybe("Leavings")
    species: Count | None = maybe("Species, without outliers")
    main_mass_kda: Number = maybe("Mass of the species with most events [kDa]")
    answer: Text = maybe("What the movie says in a line: its species, or a median of one")
    rate_per_s: Number = maybe("Landings per second")
    rate_low: Number = maybe("End of its 95 % Poisson interval")
    rate_high: Number = maybe("The other end")
    rate_per_um2_s: Number = maybe("The same per square micrometre [1/(µm² s)]")
    frames_searched: Number = maybe("Frames in which a landing is found")
    seconds_searched: Number = maybe("The same as a time [s]")
    field_um2: Number = maybe("Area of the frame [µm²]")
    frames: Count | None = maybe("Frames of the movie")
    drift_px: Number = maybe("How far the fixed pattern moved [pixels]")
    focus_shift_nm: Number = maybe("Focus less that of the day, where it was learned [nm]")
    noise_over_shot: Number = maybe("Variance over that of shot noise")
    noise_frames: Number = maybe("Number of averaged frames that it is of")
    median_p_value: Share = maybe("Of the events")
    small_p_values: Share = maybe("Share of p-values below 0.01")
    repeat_over_crb: Number = maybe("Spread on disjoint frames over the bound")
    standards_seen: Text = maybe("Standards found in a calibrant, as in 3 of 3")
    optics: Text = maybe("Where the optics come from")
    mass_scale: Text = maybe("Where the mass scale comes from")
    outside_standards: Share = maybe("Share of masses beyond the standards")
    remarks: Count | None = maybe("Warnings of its result")
    sha256: Text = maybe("Of the movie")


class DaySpecies(Document):
    """A row of species.csv: a species of a movie."""

    movie: str = key("Its movie")
    sample: Text = key("Of the movie")
    condition: Text = key("Of the movie")
    concentration_nm: Number = key("Of the movie [nmol/l]")
    replicate: Text = key("Of the movie")
    role: str = key("Of the movie")
    kind: Count = key("The same for species of several movies with one mass; 0 for outliers")
    mass_kda: Number = key("Mass [kDa]")
    mass_se: Error
    mass_low: Low
    mass_high: High
    mass_systematic: Number = key("Error that the movie's masses have in common [kDa]")
    width_kda: Number = key("Width beyond the noise [kDa]")
    width_low: Low
    width_high: High
    count: Number = key("Events")
    count_low: Low
    count_high: High
    fraction: Share = key("Of the particles that came")
    fraction_low: Share = key("End of its 95 % interval")
    fraction_high: Share = key("The other end")
    share: Share = key("The same without outliers")
    share_low: Share = key("End of its 95 % interval")
    share_high: Share = key("The other end")
    count_corrected: Number = key("Events and those that were missed")
    corrected_low: Low
    corrected_high: High
    landing: Number = key("Landings")
    leaving: Number = key("Leavings")
    efficiency: Number = key("Share of its particles that are detected")
    rate_per_s: Number = key("Landings per second, corrected")
    rate_low: Low
    rate_high: High
    outlier: bool = key("One or two events apart from all others")


class DayKd(Closed):
    """A row of kd.csv: the equilibrium of a condition."""

    condition: Text = key("The condition")
    model: Literal["dimer", "ab"] = key("2 M ⇌ D, or A + B ⇌ AB")
    movies: Count = key("Movies with enough events")
    kd_nm: Number = key("K_D [nM]")
    kd_low: Number = key("End of its 95 % profile interval [nM]")
    kd_high: Number = key("The other end [nM]; null where there is none")
    inactive_p: Share = key("Chance of such a gain by an inactive part if there is none")
    p_value: Share = key("Chance of at least such a distance if the movies follow the equilibrium")
    masses_kda: Text = key("Masses of the species [kDa]")
    remarks: Text = key("What the user should know")
    why: Text = key("Why there is no K_D")


class NotDone(Closed):
    """A movie, a calibration or a K_D that failed."""

    name: str = key("Which")
    why: str = key("What went wrong, or that it is not analysed yet")


class Batch(Document):
    """What iscat batch and iscat watch print."""

    out: str = key("Folder of the batch")
    page: str = maybe("Its page, once there is one")
    movies: list[DayMovie] = key("One for each movie")
    species: list[DaySpecies] = key("One for each species of each movie; empty of a part")
    kd: list[DayKd] = key("With --kd: one for each condition")
    analysed: list[str] = key("Movies that were analysed now; the others were finished before")
    failed: list[NotDone] = key("What failed, or is not analysed yet")


class SetupValue(Document):
    """A value of the configuration."""

    value: float | str = key("The value")
    se: Number = key("Its standard error, where it was measured")
    origin: str = Field(
        alias="from",
        description="Where it comes from: read from the file, measured from the movie, your "
        "answer, instrument NAME, assumed, to be given; and whether it will be learned",
    )


class Look(Document):
    """What the search found in some parts of the movie."""

    frames: list[Count] = key("The frames at which it looked")
    window: Natural = key("Frames in each of its windows")
    candidates: list[Count] = key("Number of candidates in each part")
    threshold_snr: Number = key("Signal-to-noise ratio above which something is a candidate")
    strongest_snr: Number = key("That of the strongest candidate")
    noise_contrast: Number = key("Standard deviation of a pixel of the contrast that is searched")
    light_e: Number = key("Photoelectrons in a pixel of a frame")


class Init(Document):
    """What iscat init prints."""

    movie: str = key("Name of the movie")
    shape: Annotated[list[Natural], Field(min_length=3, max_length=3)] = key(
        "Frames, rows, columns"
    )
    values: dict[str, SetupValue] = key("The configuration, by section.key")
    notes: list[str] = key("What the movie gives to say")
    preview: Look = key("What the search saw")
    out: str = key("The configuration that was written")
