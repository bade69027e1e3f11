"""Document of ``iscat batch``."""

from __future__ import annotations

from typing import Literal

from iscat_analysis.schemas.base import Closed, Count, Document, Number, Share, key, maybe

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
    mass_se: Number = key("Its statistical standard error [kDa]")
    mass_low: Number = key("End of its 95 % interval [kDa]")
    mass_high: Number = key("The other end [kDa]")
    mass_systematic: Number = key("Error that the movie's masses have in common [kDa]")
    width_kda: Number = key("Width beyond the noise [kDa]")
    width_low: Number = key("End of its 95 % interval [kDa]")
    width_high: Number = key("The other end [kDa]")
    count: Number = key("Events")
    count_low: Number = key("End of its 95 % interval")
    count_high: Number = key("The other end")
    fraction: Share = key("Of the particles that came")
    fraction_low: Share = key("End of its 95 % interval")
    fraction_high: Share = key("The other end")
    share: Share = key("The same without outliers")
    share_low: Share = key("End of its 95 % interval")
    share_high: Share = key("The other end")
    count_corrected: Number = key("Events and those that were missed")
    corrected_low: Number = key("End of its 95 % interval")
    corrected_high: Number = key("The other end")
    landing: Number = key("Landings")
    leaving: Number = key("Leavings")
    efficiency: Number = key("Share of its particles that are detected")
    rate_per_s: Number = key("Landings per second, corrected")
    rate_low: Number = key("End of its 95 % interval")
    rate_high: Number = key("The other end")
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
