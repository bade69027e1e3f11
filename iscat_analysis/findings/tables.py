"""Findings about tables of events: species, comparisons, equilibria, rates, calibrations."""

from __future__ import annotations

from functools import partial

from iscat_analysis.findings.registry import Subject, makers

_CALIBRATION = "howto/calibration"

note, caution, _ = (partial(make, page="howto/answers") for make in makers(Subject.ERRORS))

AS_READ = note("table-as-read", "{text}")
MASSES_REPLACED = note(
    "masses-replaced",
    "masses are those of `calibration`, {times:.4g} times the table's own (median)",
    subject=Subject.SCALE,
)
REJECTED_BY_HAND = note("events-rejected-by-hand", "{amount} that somebody rejected left out")
SELECTED = note("events-selected", "{amount} that the selection leaves out are not counted")
NO_ERRORS = caution(
    "no-errors-of-events",
    "no event has an error of its own, so that the width of a species holds the errors",
    "`sigma_kda` gives them one",
)
NO_MASS = note(
    "events-without-mass",
    "{amount} without a mass and an error between {least:g} and {most:g} kDa left out{advice}",
)
UNKNOWN_LIMIT = caution(
    "unknown-limit",
    "{amount} there are no events, and nothing says what was missed of the lightest",
    "`above_kda` cuts where all are still detected, `limit_kda` says where half are",
)

NO_ERROR_OR_MASS = note("masses-left-out", "{amount} without a mass and an error left out")
TOO_FEW_EVENTS = note("too-few-events", "{amount}, too few for species; {needed} are needed")
NO_LADDER = caution(
    "no-ladder",
    "the species do not lie at multiples of {monomer_kda:.4g} kDa (p = {p_value:.1g} against free "
    "masses): give them an `offset`, say what is missed of the lightest with `limit_kda` or "
    "`above_kda`, or calibrate the mass scale anew",
)
SKEWED_PEAK = note(
    "skewed-peak",
    "the peak at {mass_kda:.4g} kDa is one species, and skewed: a second component near "
    "{beside_kda:.3g} kDa describes it better{mean}",
)
UNDETERMINED_SHARE = caution(
    "undetermined-share",
    "what lies at {masses} kDa may be all that is seen of a lighter species: its mass and number "
    "are not determined, for its share is not known to a factor of {factor:g}, and fractions are "
    "of the others",
    "`limit_kda` says what is detected, or `above_kda` from where on everything is",
)
UNDETECTABLE = caution(
    "undetectable-species",
    "of what lies at {masses} kDa or below fewer than {percent:g} % are detected: its mass and "
    "number are not determined, and fractions are of the others",
)
HALF_DETECTED = caution(
    "half-detected",
    "fewer than half of the particles of {masses} kDa are detected: their mass and number rest on "
    "the detection model",
)
OUTLIERS = note(
    "outliers", "at {masses} kDa there are fewer than {needed} events: outliers, and no species"
)
BROAD_SPECIES = caution(
    "broad-species",
    "the species at {masses} kDa is as broad as a background: it may hold all events that the "
    "other species do not explain",
)
BRIEF_VISITORS = note(
    "brief-visitors",
    "efficiencies and corrected counts are of particles that stay {frames} or longer; briefer "
    "visitors are missed more often and appear lighter: every other one is found of {residence}",
)
SPHERES_LEFT_OUT = note(
    "spheres-left-out",
    "{amount} without a diameter, or with an error above {percent:g} % of it, left out",
)
SPHERES_MISSED = caution(
    "spheres-missed",
    "{amount} of {least_nm} to {most_nm} nm {verb} hardly brighter than what is detected: others "
    "of such diameters were missed, for which nothing is corrected",
)
TRACKS_LEFT_OUT = note(
    "tracks-left-out-of-sizes",
    "{amount} of {tracks} left out, of which pictures do not tell the diameter, or do not agree on "
    "it",
)
LARGE_DIAMETER_ERRORS = caution(
    "large-diameter-errors",
    "the errors of the diameters are so large that those of their logarithms are not normal: "
    "median and width are biased by a part of the errors",
    "use more frames",
)

SCALE_NOT_IN_SHIFTS = note(
    "scale-not-in-shifts",
    "errors of shifts do not include that of the mass scale: samples with different calibrations "
    "may differ by it (systematic_mass_kda of the tables)",
    subject=Subject.SCALE,
)
MANY_COMPARISONS = note(
    "many-comparisons",
    "{number} comparisons: by chance alone some {by_chance:.2g} have p < 0.05; below "
    "{significant:.2g} a difference is significant among them all",
)

MOVIES_LEFT_OUT = note("movies-left-out", "left out, {why}: {names}")
MONOMER_TAKEN = note(
    "monomer-taken",
    "the monomer was taken for the peak at {monomer_kda:.3g} kDa, its dimer for that at "
    "{dimer_kda:.3g} kDa",
    "`masses_kda` names another",
)
OTHER_SPECIES = caution(
    "other-species",
    "no species of {given_kda:.3g} kDa was found, but one of {found_kda:.3g}: K_D is wrong where "
    "that is another species, as the dimer of a monomer that is missed",
    "look at `masses_kda`",
)
NO_EQUILIBRIUM = caution(
    "no-equilibrium",
    "the tables do not follow this equilibrium, p = {p_value:.1g}{farthest}, and the interval of "
    "K_D is too narrow: look at concentrations, replicates and what is missed of the lightest",
)
INACTIVE_PART = caution(
    "inactive-part",
    "an inactive part describes the tables better (p = {p_value:.1g} without), and K_D is wrong "
    "where there is one: fit it with `inactive`",
)
NO_UPPER_END = caution(
    "no-upper-kd", "complexes are too few for an upper end of K_D: measure higher concentrations"
)
NO_LOWER_END = caution(
    "no-lower-kd", "free partners are too few for a lower end of K_D: dilute further"
)
SINGLE_TABLE = caution(
    "single-concentration",
    "with a single table the model cannot be tested: whether its K_D is right is not known",
)

PARTLY_SEARCHED = note(
    "rates-partly-searched",
    "{share:.0%} of field and time were searched, and the rate of landing is for all of it",
)
NO_DEPLETION_LAW = caution(
    "landings-not-exponential",
    "landings are not as an exponential depletion has them (p = {p_value:.1g}): the rate in the "
    "beginning is that of a law that does not hold",
)
CHANCE_PAIRS = caution(
    "pairs-by-chance",
    "{chance} of {pairs} pairs are as many as chance makes: the field is too crowded for "
    "`radius_px`, or particles stay",
)

STANDARDS_SCATTER = caution(
    "standards-scatter",
    "the standards scatter about the line by more than their errors (χ²/dof = {chi2_per_dof:.3g}); "
    "its uncertainty is widened by {widened:.3g}",
    page=_CALIBRATION,
    subject=Subject.SCALE,
)
TWO_STANDARDS = note(
    "two-standards",
    "two standards fix a line but cannot test it; a third would",
    page=_CALIBRATION,
    subject=Subject.SCALE,
)
NO_RECORDED_OPTICS = caution(
    "no-recorded-optics",
    "does not say with what optics the standards were measured, so that [calibration] has no "
    "record of them and is taken at those that are configured where it is used",
    "give the folder of an analysis, with its config.toml",
    page=_CALIBRATION,
    subject=Subject.SCALE,
)
