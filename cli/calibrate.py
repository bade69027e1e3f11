"""`iscat calibrate`: the camera from its noise, the optics from particles, mass from standards."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from iscat_cli.console import Messages, failures, print_json, print_result, table
from iscat_cli.options import ConfigOption, JsonOption, OverwriteOption, SetOption, command

if TYPE_CHECKING:
    from iscat_analysis.calibration import MassCalibration
    from iscat_analysis.camera import CameraCalibration, Estimate
    from iscat_analysis.instrument.result import OpticsCalibration

SUMMARY = "Calibrate the camera, the optics, or contrast against mass."

CAMERA_EXAMPLE = """Example: gain, offset and read noise from a movie and a dark.

    iscat calibrate camera movie.tif --dark dark.tif --out camera
"""

MASS_EXAMPLE = """Example: three standards in a measured table of events.

    iscat calibrate mass standards.iscat/fits.csv --standards 66,146,480
"""


OPTICS_EXAMPLE = """Example: focus, aperture, phase and aberrations from the movie itself.

    iscat calibrate optics landing.tif --config landing.toml --out microscope
"""


class LandingSign(StrEnum):
    """What a particle that lands does to its place."""

    DARK = "dark"
    BRIGHT = "bright"


@command
def camera(
    messages: Messages,
    stacks: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[STACK]...", help="Flats at one or several levels, or the movie itself."
        ),
    ] = None,
    *,
    dark: Annotated[
        Path | None, typer.Option(metavar="STACK", help="Frames without light.")
    ] = None,
    offset: Annotated[
        float | None,
        typer.Option(
            metavar="COUNTS", help="Offset of the camera in counts, if it is known without a dark."
        ),
    ] = None,
    maps: Annotated[
        bool, typer.Option("--maps", help="Write maps, one number per pixel, as TIFF.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Output folder; default the first stack's name with .camera."
        ),
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Measure gain, offset and read noise, and how far averaging lowers the noise.

    Writes camera.json, camera.toml (a section to paste), camera.html and, with --maps, TIFF maps.
    """
    with failures(messages):
        from iscat_analysis.answers.calibrations import camera_calibration
        from iscat_analysis.errors import ConfigError
        from iscat_analysis.movie import path_beside

        given = [*(stacks or ()), *([dark] if dark is not None else [])]
        if not given:
            raise ConfigError("give a flat, the movie, or --dark")
        if dark is not None and offset is not None:
            raise ConfigError("--dark measures the offset: leave --offset out")
        folder = out if out is not None else path_beside(given[0], ".camera")
        with messages.progress() as progress:
            found = camera_calibration(
                stacks or (),
                folder,
                dark=dark,
                offset_adu=offset,
                maps=maps,
                overwrite=overwrite,
                progress=progress,
                notify=messages.notify,
            )
        if as_json:
            print_json("camera", {**found.to_dict(), "out": str(folder)})
        else:
            _print_camera(found)
        messages.notify(f"wrote {folder}; open {folder / 'camera.html'}")


@command
def mass(
    messages: Messages,
    events: Annotated[
        Path,
        typer.Argument(
            metavar="EVENTS",
            help="fits.csv or its folder, or an event table of Refeyn's, h5 or csv.",
        ),
    ],
    *,
    standards: Annotated[
        str,
        typer.Option(
            metavar="KDA,KDA,...",
            help=(
                "Masses of the standards [kDa]; 66:0.5 gives a mass its standard error, the "
                "default is 1 %."
            ),
        ),
    ],
    peaks: Annotated[
        str | None,
        typer.Option(
            metavar="C,C,...",
            help=(
                "About the |contrast| of each standard's peak, in the order of --standards; "
                "default as the masses fit best."
            ),
        ),
    ] = None,
    landing: Annotated[
        LandingSign | None,
        typer.Option(
            help=(
                "Whether a particle that lands makes its place dark or bright; default from the "
                "table's masses, or dark."
            )
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Output folder; default the table's name with .calibration."
        ),
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Fit the line between contrast and mass through the peaks of standards.

    Writes calibration.json, calibration.toml (a section to paste) and calibration.html.  Of the
    folder of an analysis the section keeps the optics with which the standards were measured, so
    that it serves movies at another focus too.
    """
    with failures(messages):
        masses, errors = _standards(standards)
        places = None if peaks is None else _contrasts(peaks)

        from iscat_analysis.answers.calibrations import mass_calibration
        from iscat_analysis.movie import path_beside

        folder = out if out is not None else path_beside(events, ".calibration")
        found = mass_calibration(
            events,
            masses,
            folder,
            standards_se_kda=errors,
            peaks_at=places,
            landing=landing.value if landing is not None else None,
            overwrite=overwrite,
            notify=messages.notify,
        )
        if as_json:
            print_json("calibration", {**found.to_dict(), "out": str(folder)})
        else:
            _print_mass(found)
        messages.notify(f"wrote {folder}; open {folder / 'calibration.html'}")


@command
def optics(
    messages: Messages,
    movie: Annotated[
        Path,
        typer.Argument(
            metavar="MOVIE",
            help="A landing movie, one with background frames, or a scan of the focus.",
        ),
    ],
    *,
    config: ConfigOption = None,
    settings: SetOption = None,
    free: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help=(
                "Parameters to learn, some of focus,na,phase,mask,zernike,polarization; "
                "default all."
            ),
        ),
    ] = None,
    focus_step: Annotated[
        float | None,
        typer.Option(
            metavar="NM",
            help=(
                "The movie is a scan of the focus over immobile particles: rise of the focus "
                "per frame [nm]; where focus is free it is measured as well."
            ),
        ),
    ] = None,
    measured: Annotated[
        bool,
        typer.Option(
            "--measured",
            help=(
                "Measure the picture of a particle itself, for a microscope that no optics "
                "describe; mode mass."
            ),
        ),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Output folder; default the movie's name with .optics."),
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Learn focus, aperture, phase, mask, aberrations and polarisation from a movie.

    Writes optics.toml (name it as optics.file in a configuration), optics.json and optics.html;
    with --measured template.npz, template.json and template.html beside optics.toml.
    """
    with failures(messages):
        if measured:
            _measure(
                movie, config, settings, free, focus_step, out, messages,
                overwrite=overwrite, as_json=as_json,
            )  # fmt: skip
            return
        from iscat_analysis.answers.calibrations import optics_calibration
        from iscat_analysis.config import load_config
        from iscat_analysis.errors import DataError
        from iscat_analysis.movie import path_beside

        folder = out if out is not None else path_beside(movie, ".optics")
        with messages.progress() as progress:
            found = optics_calibration(
                movie,
                load_config(config, settings or ()),
                folder,
                free=free,
                focus_step_nm=focus_step,
                overwrite=overwrite,
                progress=progress,
                notify=messages.notify,
            )
        if as_json:
            shown = found.to_dict()
            del shown["pictures"]
            print_json("optics", {**shown, "out": str(folder)})
        else:
            _print_optics(found)
        messages.notify(f"wrote {folder}; open {folder / 'optics.html'}")
        if not found.accepted:
            raise DataError(
                f"{movie}: the optics are refused: {'; '.join(found.measured.refusals)}; record "
                "brighter or more particles that stand alone, or let more change with --free"
            )


def _measure(
    movie: Path,
    config: list[Path] | None,
    settings: list[str] | None,
    free: str | None,
    focus_step: float | None,
    out: Path | None,
    messages: Messages,
    *,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Measure the picture of a particle."""
    from iscat_analysis.answers.calibrations import template_calibration
    from iscat_analysis.config import load_config
    from iscat_analysis.errors import ConfigError, DataError
    from iscat_analysis.movie import path_beside

    if free is not None or focus_step is not None:
        raise ConfigError(
            "--measured takes the picture as it is at one focus: leave out --free and --focus-step"
        )
    folder = out if out is not None else path_beside(movie, ".optics")
    with messages.progress() as progress:
        found = template_calibration(
            movie, load_config(config, settings or ()), folder,
            overwrite=overwrite, progress=progress, notify=messages.notify,
        )  # fmt: skip
    if as_json:
        print_json("template", {**found.to_dict(), "out": str(folder)})
    else:
        print_result(found.headline())
    messages.notify(f"wrote {folder}; open {folder / 'template.html'}")
    if not found.accepted:
        raise DataError(
            f"{movie}: the template is refused: {'; '.join(found.refusals)}; record more particles "
            "that stand alone"
        )


def _contrasts(text: str) -> list[float]:
    from iscat_analysis.errors import ConfigError

    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise ConfigError(f"--peaks {text}: write contrasts as in --peaks 0.002,0.0045") from None


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


def _print_camera(found: CameraCalibration) -> None:
    shown = table("camera", "value", "95 % low", "95 % high")
    for label, estimate in (
        ("gain [e/count]", found.gain_e_per_adu),
        ("offset [counts]", found.offset_adu),
        ("read noise [counts]", found.read_noise_adu),
        ("read noise [e]", found.read_noise_e),
    ):
        shown.add_row(label, *_cells(estimate))
    print_result(shown)
    if found.read_noise_below_e is not None:
        print_result(f"read noise below {found.read_noise_below_e:.3g} e (95 %)")
    print_result(found.verdict)


def _cells(estimate: Estimate | None) -> list[str]:
    if estimate is None:
        return ["–", "–", "–"]
    low, high = estimate.ci95
    ends = [f"{low:.5g}", f"{high:.5g}"] if low < high else ["given", "given"]
    return [f"{estimate.value:.5g}", *ends]


def _print_optics(found: OpticsCalibration) -> None:
    shown = table("optics", "value", "±", "CRB", "configured")
    shown.add_column("")
    for row in found.parameters.to_dict("records"):
        numbers = ("value", "sigma", "crb", "configured")
        cells = ("–" if row[name] != row[name] else f"{row[name]:.6g}" for name in numbers)
        shown.add_row(row["parameter"], *cells, row["state"])
    print_result(shown)
    print_result(found.headline())


def _print_mass(found: MassCalibration) -> None:
    headings = ("contrast", "± ", "by the line [kDa]", "95 % low", "95 % high", "residual [%]")
    shown = table("standard [kDa]", *headings)
    for row in found.standards.to_dict("records"):
        names = ("contrast", "contrast_se", "found_kda", "low_kda", "high_kda", "residual_percent")
        shown.add_row(f"{row['mass_kda']:g}", *(f"{row[name]:.4g}" for name in names))
    print_result(shown)
    print_result(found.to_toml())
