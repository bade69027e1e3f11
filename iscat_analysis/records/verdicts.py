"""Verdicts on fits and tracks, and what each asks of the user."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum


class Status(StrEnum):
    """The verdict on one fit; `advice` says what each asks of the user."""

    OK = "ok"
    NOT_CONVERGED = "not_converged"
    AT_BOUND = "at_bound"
    AMBIGUOUS_Z = "ambiguous_z"
    AMBIGUOUS_SIZE = "ambiguous_size"
    AMBIGUOUS_DIRECTION = "ambiguous_direction"
    POOR_FIT = "poor_fit"
    TOO_CLOSE = "too_close"
    SATURATED = "saturated"
    UNCALIBRATED_OPTICS = "uncalibrated_optics"
    SIDELOBE = "sidelobe"
    NOT_DETECTED = "not_detected"
    NONLINEAR = "nonlinear"
    PROCESSED = "processed"
    CHANGING = "changing"
    EXTENDED = "extended"
    LARGE = "large"

    @property
    def advice(self) -> str:
        """What the status means and what to try."""
        return _ADVICE[self]


_ADVICE = {
    Status.OK: "The fit converged, inside its bounds, and agrees with the data.",
    Status.NOT_CONVERGED: "The fit did not converge: check the optics, or enlarge fit.roi_nm.",
    Status.AT_BOUND: "The best value of a parameter is beyond its bound: of a height (widen "
    "fit.z_range_nm; at the coverslip check optics.focus_nm and the indices), of a position (no "
    "particle there, or wrong optics), or of a mass (below a calibration.offset).",
    Status.AMBIGUOUS_Z: "Another height explains the data almost as well: use more frames, "
    "another focus, or a narrower fit.z_range_nm.",
    Status.AMBIGUOUS_SIZE: "Another diameter explains the data almost as well: use more frames, "
    "another focus, or a narrower fit.diameter_range_nm.",
    Status.AMBIGUOUS_DIRECTION: "Another direction of a rod explains the data almost as well: use "
    "more frames, another focus or another polarisation.",
    Status.POOR_FIT: "The model does not describe the data: check focus, NA, pixel size, gain and "
    "neighbours; a large particle that fit.spheres does not describe needs mode size.",
    Status.TOO_CLOSE: "Another particle is nearer than detection.min_separation_nm: "
    "treat the mass as shared between them.",
    Status.SIDELOBE: "Not larger than the residual of a brighter particle beside it, and not "
    "counted: check focus, NA and aberrations to tell whether it is a particle.",
    Status.NOT_DETECTED: "No particle stands out from the noise of the region, as noise alone does "
    "in at most 1 of 100 regions: use more frames or more light, or check where it was cut out.",
    Status.UNCALIBRATED_OPTICS: "The contrast is right, but the mass scale was measured with "
    "other optics: measure standards with these optics (iscat calibrate mass).",
    Status.SATURATED: "The camera is saturated here: lower the exposure or the laser power.",
    Status.PROCESSED: "The frames were interpolated, smoothed or sharpened, which changes their "
    "noise and their particles: analyse the raw frames of the camera.",
    Status.NONLINEAR: "The counts of the whole movie are not in proportion to its light, so that "
    "all masses are wrong by the same factor: a line says by how much and why.",
    Status.CHANGING: "The light of the particle changes beside its step: the particle settles, "
    "bleaches, blinks or moves, or another one is at the same place; the mass is that of the mean "
    "change.",
    Status.EXTENDED: "The image is wider than that of a point: the particle wiggles by more than "
    "particle.wiggle_nm, or has separate parts, or the optics are not those configured; its mass "
    "is too small.",
    Status.LARGE: "It is no dipole, so that its contrast does not give its mass: the column model "
    "says which sphere on the coverslip describes it, with its diameter.",
}


SEVERITY = (
    Status.SIDELOBE,
    Status.NOT_DETECTED,
    Status.NOT_CONVERGED,
    Status.AT_BOUND,
    Status.LARGE,
    Status.POOR_FIT,
    Status.CHANGING,
    Status.EXTENDED,
    Status.AMBIGUOUS_SIZE,
    Status.AMBIGUOUS_Z,
    Status.AMBIGUOUS_DIRECTION,
    Status.TOO_CLOSE,
    Status.SATURATED,
    Status.UNCALIBRATED_OPTICS,
    Status.NONLINEAR,
    Status.PROCESSED,
)
"""Flags of a fit, worst first: perhaps no particle; none above the noise; no estimate; no estimate
inside the bounds; no dipole and so no mass; a model that does not describe the data, their change
in time or their width; one of several diameters, heights or directions; a mass shared with a
neighbour; pixels left out; a mass on the scale of other optics; counts that are not in proportion
to the light; frames that were processed."""


NO_EVENT = frozenset({Status.SIDELOBE, Status.NOT_DETECTED})
"""Verdicts on rows that are no particles: they are in no count, histogram or species."""


def verdict(flags: Iterable[Status]) -> tuple[Status, tuple[Status, ...]]:
    """Sort the flags of a fit; the status is the worst one."""
    ordered = tuple(sorted(set(flags) - {Status.OK}, key=SEVERITY.index))
    return (ordered[0] if ordered else Status.OK), ordered


class TrackStatus(StrEnum):
    """The verdict on one track; worst first."""

    FEW_FRAMES = "few_frames"
    POOR_FITS = "poor_fits"
    AMBIGUOUS_SIZE = "ambiguous_size"
    OTHER_PARTICLE = "other_particle"
    MASS_VARIES = "mass_varies"
    PARTLY_SEEN = "partly_seen"
    SHORT_WAY = "short_way"
    NOT_FREE = "not_free"
    STANDS_STILL = "stands_still"
    NEAR_WALL = "near_wall"
    UNCALIBRATED_OPTICS = "uncalibrated_optics"
    OK = "ok"

    @property
    def advice(self) -> str:
        """What the status means and what to try."""
        return _TRACK_ADVICE[self]


_TRACK_ADVICE = {
    TrackStatus.OK: "The frames agree on one mass, and the particle diffuses freely.",
    TrackStatus.FEW_FRAMES: "Fewer of its positions than track.min_frames can be used (those at "
    "the border of the field, too close to another particle or not converged cannot): no "
    "diffusion coefficient.",
    TrackStatus.POOR_FITS: "Fewer than half of its frames are ok, so that poor fits are used too; "
    "its errors are enlarged by the factor by which the masses of its frames scatter beyond theirs "
    "(mass_scatter): see the status of its rows in fits.csv.",
    TrackStatus.AMBIGUOUS_SIZE: "Another diameter explains all its frames almost as well: "
    "optical_probability says how likely this one is.",
    TrackStatus.OTHER_PARTICLE: "Its images and its motion are those of a homogeneous sphere of "
    "another refractive index rather than of the particle of [particle], so that its optical "
    "diameter is wrong: give [particle] its refractive_index, or its shell.",
    TrackStatus.MASS_VARIES: "Its frames differ in mass by more than their errors, or the masses "
    "of all tracks change together: motion blurs the image, particles met, the particle changed, "
    "or the focus drifts.",
    TrackStatus.PARTLY_SEEN: "It is seen in some of the frames only, but moves too slowly to have "
    "gone far in the others: there the background contains it, and its mass is too small; record "
    "for longer, or give background frames without it.",
    TrackStatus.SHORT_WAY: "It moved so little that it can hardly be told from the background "
    "learnt with it: mass and D are wrong together, D as the mass to the power of -2; record for "
    "longer, or give background frames without it.",
    TrackStatus.NOT_FREE: "It does not diffuse freely: p_confinement, p_anomalous and p_steady "
    "say in which way; D is that of free diffusion.",
    TrackStatus.STANDS_STILL: "Its D is not above zero within its error: take d_high_um2_s as an "
    "upper limit, or record for longer.",
    TrackStatus.NEAR_WALL: "The coverslip slows it by more than 5 %: its diameter is too large, "
    "its index too small.",
    TrackStatus.UNCALIBRATED_OPTICS: Status.UNCALIBRATED_OPTICS.advice,
}
