"""Findings about tables of events: species, comparisons, equilibria, rates, calibrations."""

from __future__ import annotations

from iscat_analysis.findings.registry import Severity, define

_ANSWERS, _CALIBRATION = "howto/answers", "howto/calibration"

AS_READ = define("table-as-read", Severity.NOTE, "{text}", page=_ANSWERS)
MASSES_REPLACED = define(
    "masses-replaced",
    Severity.NOTE,
    "masses are those of `calibration`, {times:.4g} times the table's own (median)",
    page=_ANSWERS,
)
REJECTED_BY_HAND = define(
    "events-rejected-by-hand",
    Severity.NOTE,
    "{amount} that somebody rejected left out",
    page=_ANSWERS,
)
NO_ERRORS = define(
    "no-errors-of-events",
    Severity.CAUTION,
    "no event has an error of its own, so that the width of a species holds the errors",
    "`sigma_kda` gives them one",
    _ANSWERS,
)
NO_MASS = define(
    "events-without-mass",
    Severity.NOTE,
    "{amount} without a mass and an error between {least:g} and {most:g} kDa left out{advice}",
    page=_ANSWERS,
)
UNKNOWN_LIMIT = define(
    "unknown-limit",
    Severity.CAUTION,
    "{amount} there are no events, and nothing says what was missed of the lightest",
    "`above_kda` cuts where all are still detected, `limit_kda` says where half are",
    _ANSWERS,
)

NO_ERROR_OR_MASS = define(
    "masses-left-out", Severity.NOTE, "{amount} without a mass and an error left out", page=_ANSWERS
)
TOO_FEW_EVENTS = define(
    "too-few-events",
    Severity.NOTE,
    "{amount}, too few for species; {needed} are needed",
    page=_ANSWERS,
)
NO_LADDER = define(
    "no-ladder",
    Severity.CAUTION,
    "the species do not lie at multiples of {monomer_kda:.4g} kDa (p = {p_value:.1g} against free "
    "masses): give them an `offset`, say what is missed of the lightest with `limit_kda` or "
    "`above_kda`, or calibrate the mass scale anew",
    page=_ANSWERS,
)
SKEWED_PEAK = define(
    "skewed-peak",
    Severity.NOTE,
    "the peak at {mass_kda:.4g} kDa is one species, and skewed: a second component near "
    "{beside_kda:.3g} kDa describes it better{mean}",
    page=_ANSWERS,
)
UNDETERMINED_SHARE = define(
    "undetermined-share",
    Severity.CAUTION,
    "what lies at {masses} kDa may be all that is seen of a lighter species: its mass and number "
    "are not determined, for its share is not known to a factor of {factor:g}, and fractions are "
    "of the others",
    "`limit_kda` says what is detected, or `above_kda` from where on everything is",
    _ANSWERS,
)
UNDETECTABLE = define(
    "undetectable-species",
    Severity.CAUTION,
    "of what lies at {masses} kDa or below fewer than {percent:g} % are detected: its mass and "
    "number are not determined, and fractions are of the others",
    page=_ANSWERS,
)
HALF_DETECTED = define(
    "half-detected",
    Severity.CAUTION,
    "fewer than half of the particles of {masses} kDa are detected: their mass and number rest on "
    "the detection model",
    page=_ANSWERS,
)
OUTLIERS = define(
    "outliers",
    Severity.NOTE,
    "at {masses} kDa there are fewer than {needed} events: outliers, and no species",
    page=_ANSWERS,
)
BROAD_SPECIES = define(
    "broad-species",
    Severity.CAUTION,
    "the species at {masses} kDa is as broad as a background: it may hold all events that the "
    "other species do not explain",
    page=_ANSWERS,
)
BRIEF_VISITORS = define(
    "brief-visitors",
    Severity.NOTE,
    "efficiencies and corrected counts are of particles that stay {frames} or longer; briefer "
    "visitors are missed more often and appear lighter: every other one is found of {residence}",
    page=_ANSWERS,
)
SPHERES_LEFT_OUT = define(
    "spheres-left-out",
    Severity.NOTE,
    "{amount} without a diameter, or with an error above {percent:g} % of it, left out",
    page=_ANSWERS,
)
SPHERES_MISSED = define(
    "spheres-missed",
    Severity.CAUTION,
    "{amount} of {least_nm} to {most_nm} nm {verb} hardly brighter than what is detected: others "
    "of such diameters were missed, for which nothing is corrected",
    page=_ANSWERS,
)
TRACKS_LEFT_OUT = define(
    "tracks-left-out-of-sizes",
    Severity.NOTE,
    "{amount} of {tracks} left out, of which pictures do not tell the diameter, or do not agree on "
    "it",
    page=_ANSWERS,
)
LARGE_DIAMETER_ERRORS = define(
    "large-diameter-errors",
    Severity.CAUTION,
    "the errors of the diameters are so large that those of their logarithms are not normal: "
    "median and width are biased by a part of the errors",
    "use more frames",
    _ANSWERS,
)

SCALE_NOT_IN_SHIFTS = define(
    "scale-not-in-shifts",
    Severity.NOTE,
    "errors of shifts do not include that of the mass scale: samples with different calibrations "
    "may differ by it (systematic_mass_kda of the tables)",
    page=_ANSWERS,
)
MANY_COMPARISONS = define(
    "many-comparisons",
    Severity.NOTE,
    "{number} comparisons: by chance alone some {by_chance:.2g} have p < 0.05; below "
    "{significant:.2g} a difference is significant among them all",
    page=_ANSWERS,
)

MOVIES_LEFT_OUT = define(
    "movies-left-out", Severity.NOTE, "left out, {why}: {names}", page=_ANSWERS
)
MONOMER_TAKEN = define(
    "monomer-taken",
    Severity.NOTE,
    "the monomer was taken for the peak at {monomer_kda:.3g} kDa, its dimer for that at "
    "{dimer_kda:.3g} kDa",
    "`masses_kda` names another",
    _ANSWERS,
)
OTHER_SPECIES = define(
    "other-species",
    Severity.CAUTION,
    "no species of {given_kda:.3g} kDa was found, but one of {found_kda:.3g}: K_D is wrong where "
    "that is another species, as the dimer of a monomer that is missed",
    "look at `masses_kda`",
    _ANSWERS,
)
NO_EQUILIBRIUM = define(
    "no-equilibrium",
    Severity.CAUTION,
    "the tables do not follow this equilibrium, p = {p_value:.1g}{farthest}, and the interval of "
    "K_D is too narrow: look at concentrations, replicates and what is missed of the lightest",
    page=_ANSWERS,
)
INACTIVE_PART = define(
    "inactive-part",
    Severity.CAUTION,
    "an inactive part describes the tables better (p = {p_value:.1g} without), and K_D is wrong "
    "where there is one: fit it with `inactive`",
    page=_ANSWERS,
)
NO_UPPER_END = define(
    "no-upper-kd",
    Severity.CAUTION,
    "complexes are too few for an upper end of K_D: measure higher concentrations",
    page=_ANSWERS,
)
NO_LOWER_END = define(
    "no-lower-kd",
    Severity.CAUTION,
    "free partners are too few for a lower end of K_D: dilute further",
    page=_ANSWERS,
)
SINGLE_TABLE = define(
    "single-concentration",
    Severity.CAUTION,
    "with a single table the model cannot be tested: whether its K_D is right is not known",
    page=_ANSWERS,
)

PARTLY_SEARCHED = define(
    "rates-partly-searched",
    Severity.NOTE,
    "{share:.0%} of field and time were searched, and the rate of landing is for all of it",
    page=_ANSWERS,
)
NO_DEPLETION_LAW = define(
    "landings-not-exponential",
    Severity.CAUTION,
    "landings are not as an exponential depletion has them (p = {p_value:.1g}): the rate in the "
    "beginning is that of a law that does not hold",
    page=_ANSWERS,
)
CHANCE_PAIRS = define(
    "pairs-by-chance",
    Severity.CAUTION,
    "{chance} of {pairs} pairs are as many as chance makes: the field is too crowded for "
    "`radius_px`, or particles stay",
    page=_ANSWERS,
)

STANDARDS_SCATTER = define(
    "standards-scatter",
    Severity.CAUTION,
    "the standards scatter about the line by more than their errors (χ²/dof = {chi2_per_dof:.3g}); "
    "its uncertainty is widened by {widened:.3g}",
    page=_CALIBRATION,
)
TWO_STANDARDS = define(
    "two-standards",
    Severity.NOTE,
    "two standards fix a line but cannot test it; a third would",
    page=_CALIBRATION,
)
NO_RECORDED_OPTICS = define(
    "no-recorded-optics",
    Severity.CAUTION,
    "does not say with what optics the standards were measured, so that [calibration] has no "
    "record of them and is taken at those that are configured where it is used",
    "give the folder of an analysis, with its config.toml",
    _CALIBRATION,
)
