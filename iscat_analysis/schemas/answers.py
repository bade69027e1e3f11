"""Documents of ``iscat species`` and ``iscat kd``."""

from __future__ import annotations

from typing import Any, Literal

from iscat_analysis.schemas.base import Closed, Count, Document, Number, Share, key, maybe
from iscat_analysis.schemas.fit import Distribution


class LadderFit(Closed):
    """The monomer of a ladder, masses n·monomer + offset."""

    steps: list[int] = key("n of each rung")
    monomer_kda: float = key("Its mass [kDa]")
    monomer_se: Number = key("Its statistical standard error [kDa]")
    monomer_low: Number = key("End of its 95 % interval [kDa]")
    monomer_high: Number = key("The other end [kDa]")
    offset_kda: float = key("Offset [kDa]")
    offset_se: Number = key("Its statistical standard error [kDa]")
    offset_low: Number = key("End of its 95 % interval [kDa]")
    offset_high: Number = key("The other end [kDa]")
    held: bool = key("Whether the monomer was given and not fitted")
    p_value: Number = key("Of a ladder against free masses; null where they are as many")


class LandingRate(Closed):
    """How fast particles land: rate = per_second · exp(−depletion_per_s · t)."""

    landings: Count = key("Landings that were seen")
    seconds: float = key("Time in which they were [s]")
    per_second: Number = key("Rate in the beginning, of landings that are seen [1/s]")
    per_second_low: Number = key("End of its 95 % interval [1/s]")
    per_second_high: Number = key("The other end [1/s]")
    depletion_per_s: Number = key("Rate at which it falls [1/s]")
    depletion_low: Number = key("End of its 95 % interval [1/s]")
    depletion_high: Number = key("The other end [1/s]")
    depletion_p: Share = key("Chance of such a change if the rate is constant")
    p_value: Share = key("Chance of times that are as far from this law if it is true")


class UnbindingRate(Closed):
    """How fast particles leave, from landings paired with leavings."""

    landings: Count = key("Landings that could be followed")
    pairs: Count = key("Those with a leaving")
    chance_pairs: Count = key("Pairs found where leavings are moved by half of the field")
    per_second: Number = key("Rate [1/s]")
    per_second_low: Number = key("End of its 95 % interval [1/s]")
    per_second_high: Number = key("The other end [1/s]")


class Kinetics(Closed):
    """Rates of a table that has a column frame."""

    landing: LandingRate = key("Landings")
    unbinding: UnbindingRate | None = key("Leavings; null if there are none, or no positions")
    frame_rate_hz: float = key("Frames per second")
    frames: tuple[int, int] = key("In which events were looked for, [start, stop)")
    notes: list[str] = key("What the user should know, one line each")


class Species(Distribution):
    """What iscat species prints of one table and writes as species.json."""

    source: str = key("The table of events")
    ladder: LadderFit = maybe("With --ladder: the monomer")
    kinetics: Kinetics = maybe("Rates, where the frames per second are known")
    out: str = maybe("When printed: the folder that was written")


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
    notes: list[str] = key("What the user should know, one line each")
    out: str = maybe("When printed: the folder that was written")


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
    masses_kda: list[float] = key(
        "Masses at which the species' peaks are highest [kDa], the complex last"
    )
    width_kda: float = key("Width of the lightest species beside the events' own errors [kDa]")
    tail_kda: float = key("Mean of the peaks' exponential tail, negative to low masses [kDa]")
    limit_kda: Number = key(
        "Mass that is detected with probability 1/2, from the edge of the tables [kDa]"
    )
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
    notes: list[str] = key("What the user should know, one line each")
    out: str = maybe("When printed: the folder that was written")
