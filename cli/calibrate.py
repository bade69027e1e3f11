"""`iscat calibrate`: the camera from its noise, the optics from particles, mass from standards."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from iscat_cli.console import Messages, listing, table
from iscat_cli.options import Output, Setup, command, numbers

if TYPE_CHECKING:
    from rich.console import RenderableType

    from iscat_analysis.calibration import MassCalibration
    from iscat_analysis.camera import CameraCalibration, Estimate
    from iscat_analysis.instrument.result import OpticsCalibration

SUMMARY = "Calibrate the camera, the optics, or contrast against mass."


@command
def camera(
    messages: Messages,
    stacks: list[Path] | None = None,
    *,
    dark: Path | None = None,
    offset: float | None = None,
    maps: bool = False,
    output: Output,
) -> None:
    """Measure gain, offset and read noise, and how far averaging lowers the noise.

    Writes camera.json, camera.toml (a section to paste), camera.html and, with --maps, TIFF maps.

    Options
    -------
    STACK
        Flats at one or several levels, or the movie itself.
    --dark STACK
        Frames without light.
    --offset COUNTS
        Offset of the camera in counts, if it is known without a dark.
    --maps
        Write maps, one number per pixel, as TIFF.
    --out DIR
        Output folder; default the first stack's name with .camera.

    Example: gain, offset and read noise from a movie and a dark.

        iscat calibrate camera movie.tif --dark dark.tif --out camera
    """
    from iscat_analysis.answers.calibrations import camera_calibration
    from iscat_analysis.errors import ConfigError

    given = [*(stacks or ()), *([dark] if dark is not None else [])]
    if not given:
        raise ConfigError("give a flat, the movie, or --dark")
    if dark is not None and offset is not None:
        raise ConfigError("--dark measures the offset: leave --offset out")
    folder = output.beside(given[0], ".camera")
    known: Any = {"dark": dark, "offset_adu": offset, "maps": maps, "overwrite": output.overwrite}
    with messages.telling() as told:
        found = camera_calibration(stacks or (), folder, **known, **told)
    messages.answer("camera", found.to_dict(), _camera_lines(found), folder, "camera.html")


def _camera_lines(found: CameraCalibration) -> Iterator[RenderableType]:
    estimates = {
        "gain [e/count]": found.gain_e_per_adu,
        "offset [counts]": found.offset_adu,
        "read noise [counts]": found.read_noise_adu,
        "read noise [e]": found.read_noise_e,
    }
    rows = ((label, *_cells(estimate)) for label, estimate in estimates.items())
    yield table("camera", "value", "95 % low", "95 % high", rows=rows)
    if found.read_noise_below_e is not None:
        yield f"read noise below {found.read_noise_below_e:.3g} e (95 %)"
    yield found.verdict


def _cells(estimate: Estimate | None) -> list[str]:
    if estimate is None:
        return ["–", "–", "–"]
    low, high = estimate.ci95
    ends = [f"{low:.5g}", f"{high:.5g}"] if low < high else ["given", "given"]
    return [f"{estimate.value:.5g}", *ends]


@command
def mass(
    messages: Messages,
    events: Path,
    *,
    standards: str,
    peaks: str | None = None,
    landing: Literal["dark", "bright"] | None = None,
    output: Output,
) -> None:
    """Fit the line between contrast and mass through the peaks of standards.

    Writes calibration.json, calibration.toml (a section to paste) and calibration.html.  Of the
    folder of an analysis the section keeps the optics with which the standards were measured, so
    that it serves movies at another focus too.

    Options
    -------
    EVENTS
        fits.csv or its folder, or an event table of Refeyn's, h5 or csv.
    --standards KDA,KDA,...
        Masses of the standards [kDa]; 66:0.5 gives a mass its standard error, the default is 1 %.
    --peaks C,C,...
        About the |contrast| of each standard's peak, in the order of --standards; default as the
        masses fit best.
    --landing
        Whether a particle that lands makes its place dark or bright; default from the table's
        masses, or dark.
    --out DIR
        Output folder; default the table's name with .calibration.

    Example: three standards in a measured table of events.

        iscat calibrate mass standards.iscat/fits.csv --standards 66,146,480
    """
    masses, errors = _standards(standards)
    places = numbers("--peaks", peaks, "contrasts as in {} 0.002,0.0045")

    from iscat_analysis.answers.calibrations import mass_calibration

    folder = output.beside(events, ".calibration")
    found = mass_calibration(
        events,
        masses,
        folder,
        standards_se_kda=errors,
        peaks_at=places,
        landing=landing,
        overwrite=output.overwrite,
        notify=messages.note,
    )
    lines = _mass_lines(found)
    messages.answer("calibration", found.to_dict(), lines, folder, "calibration.html")


def _standards(text: str) -> tuple[list[float], list[float]]:
    """Read ``66,146:1.5,480``."""
    from iscat_analysis.calibration import STANDARD_ERROR
    from iscat_analysis.errors import ConfigError

    masses, errors = [], []
    for part in text.split(","):
        value, colon, error = part.partition(":")
        try:
            masses.append(float(value))
            errors.append(float(error) if colon else STANDARD_ERROR * abs(masses[-1]))
        except ValueError:
            raise ConfigError(
                f"--standards {text}: {part.strip()!r} is not a mass in kDa; write it as 66,146,480"
            ) from None
    return masses, errors


def _mass_lines(found: MassCalibration) -> Iterator[RenderableType]:
    yield listing(
        found.standards.to_dict("records"),
        "standard [kDa] | contrast | ± | by the line [kDa] | 95 % low | 95 % high | residual [%]",
        "{mass_kda:g} | {contrast:.4g} | {contrast_se:.4g} | {found_kda:.4g} | {low_kda:.4g} "
        "| {high_kda:.4g} | {residual_percent:.4g}",
    )
    yield found.to_toml()


@command
def optics(
    messages: Messages,
    movie: Path,
    *,
    free: str | None = None,
    focus_step: float | None = None,
    measured: bool = False,
    setup: Setup,
    output: Output,
) -> None:
    """Learn focus, aperture, phase, mask, aberrations and polarisation from a movie.

    Writes optics.toml (name it as optics.file in a configuration), optics.json and optics.html;
    with --measured template.npz, template.json and template.html beside optics.toml.

    Options
    -------
    MOVIE
        A landing movie, one with background frames, or a scan of the focus.
    --free NAMES
        Parameters to learn, some of focus,na,phase,mask,zernike,polarization; default all.
    --focus-step NM
        The movie is a scan of the focus over immobile particles: rise of the focus per frame [nm];
        where focus is free it is measured as well.
    --measured
        Measure the picture of a particle itself, for a microscope that no optics describe; mode
        mass.
    --out DIR
        Output folder; default the movie's name with .optics.

    Example: focus, aperture, phase and aberrations from the movie itself.

        iscat calibrate optics landing.tif --config landing.toml --out microscope
    """
    from iscat_analysis.answers.calibrations import optics_calibration
    from iscat_analysis.errors import ConfigError, DataError

    if measured and (free is not None or focus_step is not None):
        raise ConfigError(
            "--measured takes the picture as it is at one focus: leave out --free and --focus-step"
        )
    if measured:
        _measure(messages, movie, setup, output)
        return
    folder = output.beside(movie, ".optics")
    known: Any = {"free": free, "focus_step_nm": focus_step, "overwrite": output.overwrite}
    with messages.telling() as told:
        found = optics_calibration(movie, setup.load(), folder, **known, **told)
    values = {key: value for key, value in found.to_dict().items() if key != "pictures"}
    messages.answer("optics", values, _optics_lines(found), folder, "optics.html")
    if not found.accepted:
        raise DataError(
            f"{movie}: the optics are refused: {'; '.join(found.measured.refusals)}; record "
            "brighter or more particles that stand alone, or let more change with --free"
        )


def _optics_lines(found: OpticsCalibration) -> Iterator[RenderableType]:
    yield listing(
        found.parameters.to_dict("records"),
        "optics | value | ± | CRB | configured | ",
        "{parameter} | {value:.6g} | {sigma:.6g} | {crb:.6g} | {configured:.6g} | {state}",
        left=(0, 5),
    )
    yield found.headline()


def _measure(messages: Messages, movie: Path, setup: Setup, output: Output) -> None:
    """Measure the picture of a particle."""
    from iscat_analysis.answers.calibrations import template_calibration
    from iscat_analysis.errors import DataError

    folder = output.beside(movie, ".optics")
    with messages.telling() as told:
        found = template_calibration(
            movie, setup.load(), folder, overwrite=output.overwrite, **told
        )
    messages.answer("template", found.to_dict(), [found.headline()], folder, "template.html")
    if not found.accepted:
        raise DataError(
            f"{movie}: the template is refused: {'; '.join(found.refusals)}; record more particles "
            "that stand alone"
        )
