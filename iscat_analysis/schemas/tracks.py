"""Tracks, as ``iscat fit --mode track`` prints and writes them."""

from __future__ import annotations

from typing import Literal

from iscat_analysis.records import TrackStatus
from iscat_analysis.schemas.base import (
    Closed,
    Count,
    Document,
    Natural,
    NotNegative,
    Number,
    Positive,
    Share,
    key,
    maybe,
)

End = Literal["movie", "border", "inside"]


class Track(Closed):
    """One row of tracks.csv."""

    track: Count = key("Number of the track, as in fits.csv")
    first_frame: Count = key("First frame with the particle")
    last_frame: Count = key("Last frame with it")
    n_frames: Natural = key("Frames in which it was fitted")
    mass_kda: Number = key(
        "Mass common to its frames that are ok [kDa]; on the model's own scale, which is no mass, "
        "unless mass_scale is calibration"
    )
    sigma_mass_kda: Positive = key("Its standard error, from those of the frames [kDa]")
    crb_mass_kda: Positive = key("The same from the frames' Cramér–Rao bounds [kDa]")
    d_um2_s: NotNegative | None = key(
        "Diffusion coefficient along x and y of highest likelihood [µm²/s]; null without a frame "
        "rate or with fewer positions than track.min_frames"
    )
    sigma_d_um2_s: Positive = key("Its standard error, from the curvature [µm²/s]")
    crb_d_um2_s: Positive = key("Its Cramér–Rao bound [µm²/s]")
    diameter_nm: Positive = key(
        "Hydrodynamic diameter [nm]; where particles move in the liquid and D is above zero"
    )
    sigma_diameter_nm: Positive = key("Its standard error [nm]")
    refractive_index: Positive = key(
        "Index of the sphere of that diameter that scatters like mass_kda of [particle]; null for "
        "a material that absorbs"
    )
    confinement_nm: Positive = key(
        "Standard deviation of the place in a harmonic well [nm]; where p_confinement is at most "
        "0.005"
    )
    status: TrackStatus = key("The worst remark")
    flags: str = key("Every remark, worst first, joined by semicolons; crosses makes no verdict")
    d_low_um2_s: NotNegative | None = key("Lower end of the 95 % interval of D [µm²/s]; 0: open")
    d_high_um2_s: Positive = key("Upper end [µm²/s]")
    d_disagreement: Number = key(
        "Covariance-based estimate of D minus this one, in standard errors; far from 0 the errors "
        "of the places or the exposure are wrong, or motion is not free"
    )
    p_confinement: Share = key("Chance of a free track that looks as confined; first 300 positions")
    exponent: Number = key("Exponent of time in the mean-squared displacement; 1 where free")
    sigma_exponent: Positive = key("Its standard error")
    p_anomalous: Share = key("Chance of a free track with an exponent as far from 1")
    p_steady: Share = key("Chance of one D in all stretches of the track that differ as much")
    sigma_refractive_index: NotNegative | None = key("Standard error of the refractive index")
    contrast: Number = key("Signed peak contrast of a particle of mass_kda; null in dark field")
    mass_scatter: NotNegative | None = key("Scatter of the frames' masses over their σ")
    p_mass: Share = key("Chance of at least that scatter with one mass")
    n_mass_frames: Count = key("Frames that are ok, whose masses were combined")
    n_d_frames: Count = key("Frames whose places were used for D")
    x_nm: Number = key("Mean place along x [nm]")
    y_nm: Number = key("Mean place along y [nm]")
    z_nm: Number = key("Mean height [nm]")
    nearest_nm: Positive = key("Smallest distance to another track in the same frame [nm]")
    begins: End = key("movie: in the first frame; border: near that of the field; inside: else")
    ends: End = key("The same of the last frame")
    systematic_mass_kda: Number = maybe("Error common to the movie, from calibrations [kDa]")


class Motion(Document):
    """What the tracks of a movie come to; medians are over those that are ok."""

    frame_rate_hz: Number = key("Frames per second; null: there is no D")
    exposure_ms: Number = key("Time over which motion is averaged; null: all of it")
    status: dict[str, Count] = key("Tracks by status")
    flags: dict[str, Count] = key("Tracks by remark")
    medians: dict[str, Number] = key("Of n_frames, mass, D, diameter and refractive index")
    sigma_d_over_d_median: Number = key("Median of σ of D over D")
    begin_inside: Count = key("Tracks that begin inside the field after the first frame")
    end_inside: Count = key("Tracks that end inside the field before the last frame")
    cross_border: Count = key("Tracks that begin or end at the border of the field")
    crossed: Count = key("Tracks that came nearer than detection.min_separation_nm to another")
