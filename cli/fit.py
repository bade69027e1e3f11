"""`iscat fit`, the main job."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from iscat_cli.console import Messages, failures, print_json, print_result
from iscat_cli.options import (
    CalibrationOption,
    JsonOption,
    Mode,
    ModeOption,
    OverwriteOption,
    SchedulerFileOption,
    SchedulerOption,
    SetOption,
    WorkersOption,
    channel_of,
    command,
    frame_range,
    setup_of,
)

if TYPE_CHECKING:
    import pandas as pd
    from rich.table import Table

    from iscat_analysis.records import Analysis

FLAGGED = 3
ROWS_SHOWN = 20
GAP = 3  # characters between the columns of a table on a terminal

EXAMPLE = """Example: 200 frames before the particles bound, the rest after.

    iscat fit movie.tif --mode mass --config setup.toml --background 0:200

Exit status: 0 done; 1 the data cannot be analysed; 2 usage or configuration;
3 done, but --strict was given and something is flagged or σ understated;
130 interrupted.
"""


@command
def fit(
    messages: Messages,
    stacks: Annotated[
        list[Path],
        typer.Argument(
            metavar="STACK",
            help="The movie: TIFF of any kind or a folder of them, Refeyn .mp, HDF5 "
            "(FILE::/DATASET), Zarr, .npy, .npz, .mat (FILE::NAME), ND2, CZI.",
        ),
    ],
    *,
    mode: ModeOption = None,
    config: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="C.toml",
            help="Configuration; default iscat.toml beside STACK, which `iscat init` writes. Of "
            "several, keys of later ones win.",
        ),
    ] = None,
    calibration: CalibrationOption = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Output folder; default the movie's name with .iscat."),
    ] = None,
    raw: Annotated[
        str | None,
        typer.Option(
            metavar="SHAPE,TYPE",
            help=(
                "Shape and type of a raw file of numbers, as in 1500x128x128,uint16 (>u2 for big "
                "endian; behind a header 128x128,uint16,header=344; as MATLAB writes them "
                "128x96,uint16,order=columns); also STACK::SHAPE,TYPE."
            ),
        ),
    ] = None,
    frames: Annotated[
        str | None, typer.Option(metavar="A:B", help="Frames to fit, half-open.")
    ] = None,
    background: Annotated[
        str | None,
        typer.Option(
            metavar="A:B", help="Frames of the background, before the particles bound, half-open."
        ),
    ] = None,
    channels: Annotated[
        str | None,
        typer.Option(
            metavar="N:K", help="Of N channels whose frames take turns, analyse channel K, from 0."
        ),
    ] = None,
    settings: SetOption = None,
    posterior: Annotated[
        bool | None,
        typer.Option(
            "--posterior/--no-posterior", help="Sample the posterior; default as configured."
        ),
    ] = None,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = "threads",
    scheduler_file: SchedulerFileOption = None,
    inject: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Landing movies: add N known particles, which land and leave, in a second run and "
            "report recall, bias and spread.",
        ),
    ] = None,
    overwrite: OverwriteOption = False,
    strict: Annotated[
        bool,
        typer.Option(
            "--strict", help="Exit with status 3 if any result is flagged, or σ is understated."
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Fit the particles of a movie and set each spread beside its Cramér–Rao bounds.

    Writes fits.csv, fits.parquet, summary.json, config.toml, report.html and figures to the
    output folder; in mode track also tracks.csv and tracks.parquet: mass and diffusion
    coefficient of every particle.
    """
    with failures(messages):
        from iscat_analysis.errors import ConfigError

        if len(stacks) > 1:
            more = ", …" if len(stacks) > 2 else ""
            raise ConfigError(
                f"{len(stacks)} movies were given ({stacks[0]}, {stacks[1]}{more}), but one is "
                "analysed at a time: name one, or let the shell repeat the command, as in "
                'for movie in *.tif; do iscat-fit "$movie" --config setup.toml; done'
            )
        (stack,) = stacks
        from iscat_analysis.config import load_config

        changes = _changes(settings, mode, frames, background, channels, posterior, workers)

        from iscat_analysis.calibration.line import with_line
        from iscat_analysis.movie import MARK, path_beside

        sources = with_line(setup_of(stack, config, messages), calibration)
        resolved = load_config(sources, changes)

        from iscat_analysis.executors import open_executor

        movie, many = stack, resolved.compute.workers
        if raw is not None:
            stack = Path(f"{stack}{MARK}{raw}")
        folder = path_beside(stack, ".iscat") if out is None else out
        with (
            open_executor(scheduler, scheduler_file, shared=movie, workers=many) as executor,
            messages.progress() as progress,
        ):
            from iscat_analysis.pipeline import fit_stack  # while the second process imports

            analysis = fit_stack(
                stack,
                resolved,
                out=folder,
                overwrite=overwrite,
                progress=progress,
                notify=messages.notify,
                command=messages.command,
                inject=inject or 0,
                executor=executor,
            )
        rows: list[dict[str, Any]] = analysis.table.to_dict("records")
        if as_json:
            found: dict[str, Any] = {**analysis.summary, "events": rows, "out": str(folder)}
            if analysis.tracks is not None:
                found["tracks"] = analysis.tracks.to_dict("records")
            print_json("fit", found)
        else:
            _print_table(analysis, folder)
        flagged = [row for row in rows if _is_flagged(row)]
        if flagged:
            _advise(messages, flagged)
        if analysis.tracks is not None:
            from iscat_analysis.report.tracks import advice

            for line in advice(analysis.tracks):
                messages.notify(line)
            flagged += [row for row in analysis.tracks.to_dict("records") if _is_flagged(row)]
        understated = analysis.summary.get("repeats", {}).get("understated", False)
        if strict and (flagged or understated):
            raise typer.Exit(FLAGGED)


def _changes(
    settings: Sequence[str] | None,
    mode: Mode | None,
    frames: str | None,
    background: str | None,
    channels: str | None,
    posterior: bool | None,
    workers: int | None,
) -> list[str]:
    """Write the options as configuration keys; they come last, so they win over --set."""
    changes = list(settings or ())
    if mode is not None:
        changes.append(f'fit.mode="{mode.value}"')
    if frames is not None:
        changes.append(f"fit.frames={list(frame_range('--frames', frames))}")
    if background is not None:
        changes.append(f"background.frames={list(frame_range('--background', background))}")
    if channels is not None:
        changes.append(f"camera.channels={list(channel_of(channels))}")
    if posterior is not None:
        changes.append(f"posterior.enabled={str(posterior).lower()}")
    if workers is not None:
        changes.append(f"compute.workers={workers}")
    return changes


def _is_flagged(row: Mapping[str, Any]) -> bool:
    flags = row["flags"]
    return row["status"] != "ok" or (isinstance(flags, str) and bool(flags))


def _advise(messages: Messages, flagged: Sequence[Mapping[str, Any]]) -> None:
    from iscat_analysis.records import NO_EVENT, Status

    flag_counts: Counter[str] = Counter()
    for row in flagged:
        found = {str(row["status"]), *str(row["flags"] or "").split(";")}
        flag_counts.update(found & NO_EVENT or found)
    for status in Status:
        if status != Status.OK and flag_counts[status.value]:
            messages.notify(f"{flag_counts[status.value]} {status}: {status.advice}")


def _print_table(analysis: Analysis, folder: Path) -> None:
    from rich.console import Console

    from iscat_analysis.config import MODES
    from iscat_analysis.records import counted, tally
    from iscat_analysis.report.answer import answers, caution, main_quantity
    from iscat_analysis.report.answer import is_uncalibrated as uncalibrated
    from iscat_analysis.report.headline import NOT_A_MASS, as_contrasts, as_diameters

    if analysis.tracks is not None:
        _print_tracks(analysis, folder)
        return
    found = tally(analysis.table)
    if found.number:
        console = Console()
        width = console.width if console.is_terminal else None
        if (flagged := caution(analysis.table)) is not None:
            print_result(flagged)
        shown, mass = counted(analysis.table).head(ROWS_SHOWN), ("mass", "kDa")
        if uncalibrated(analysis):
            print_result(NOT_A_MASS)
            mass = ("mass, model scale", "kDa")
            if main_quantity(analysis).column == "contrast":
                shown, mass = as_contrasts(shown), ("contrast", "")
        mode = MODES[analysis.mode]
        if mode.fits_sizes:
            shown, mass = as_diameters(shown), ("diameter", "nm")
        print_result(events_table(shown.to_dict("records"), mode.free, mass=mass, width=width))
        if found.number > ROWS_SHOWN:
            print_result(f"… and {found.number - ROWS_SHOWN} more in {folder / 'fits.csv'}")
        for answer in answers(analysis, analysis.table):
            print_result(answer.text)
    print_result(f"{found.text()}; results in {folder}")


def _print_tracks(analysis: Analysis, folder: Path) -> None:
    from iscat_analysis.records import tally
    from iscat_analysis.report.answer import main_quantity, tracks_of
    from iscat_analysis.report.tables import event_table
    from iscat_analysis.report.tracks import track_lines, tracks_headline

    tracks = tracks_of(analysis)
    if len(tracks):
        contrast = main_quantity(analysis).column == "contrast"
        print_result(tracks_table(tracks.head(ROWS_SHOWN), contrast=contrast))
    if len(tracks) > ROWS_SHOWN:
        print_result(f"… and {len(tracks) - ROWS_SHOWN} more in {folder / 'tracks.csv'}")
    for line in (*tracks_headline(analysis, event_table(analysis)), *track_lines(analysis.summary)):
        print_result(line)
    print_result(f"{tally(tracks).text('track')}; results in {folder}")


def tracks_table(tracks: pd.DataFrame, *, contrast: bool = False) -> Table:
    """Tabulate rows of ``tracks.csv``: mass or contrast, D, diameter and index if known."""
    from rich.table import Table

    from iscat_analysis.report.tracks import TRACK_HEADINGS

    table = Table(box=None, pad_edge=False)
    rows = tracks.to_dict("records")
    columns: dict[str, list[str]] = {
        "track": [str(row["track"]) for row in rows],
        "frames": [f"{row['first_frame']}–{row['last_frame']}" for row in rows],
    }
    for name, (column, error, unit) in TRACK_HEADINGS.items():
        if name == "mass" and contrast:
            columns["contrast ± σ"] = [
                _with_spread(row["contrast"], abs(row[error] * row["contrast"] / row[column]))
                for row in rows
            ]
        elif name in ("mass", "D") or (column in tracks and tracks[column].notna().any()):
            heading = f"{name} ± σ{f' [{unit}]' if unit else ''}"
            columns[heading] = [_with_spread(row[column], row[error]) for row in rows]
    columns["status"] = [str(row["status"]) for row in rows]
    for heading in columns:
        table.add_column(heading, justify="left" if heading == "status" else "right", no_wrap=True)
    for line in zip(*columns.values(), strict=True):
        table.add_row(*line)
    return table


def events_table(
    rows: Sequence[Mapping[str, Any]],
    free: Sequence[str],
    *,
    mass: tuple[str, str] = ("mass", "kDa"),
    width: int | None = None,
) -> Table:
    """Tabulate rows of ``fits.csv``: every parameter ± σ, and the bounds of z and mass where free.

    `mass` is what the column ``mass_kda`` is called, and its unit, which may be empty.  Where
    there are fewer than `width` characters, what fits least is left out.
    """
    from rich import box
    from rich.table import Table

    shared = any(f"systematic_{name}" in row for row in rows for name in ("z_nm", "mass_kda"))
    columns = _columns(free, mass, compact=width is not None, shared=shared)
    cells = {heading: [cell(row) for row in rows] for heading, cell in columns.items()}
    if width is not None:
        spare = [heading for heading in _spare(mass[0]) if heading in cells]
        while spare and sum(_widest(h, cells[h]) + GAP for h in cells) > width:
            del cells[spare.pop(0)]
    table = Table(box=box.SIMPLE_HEAD if width is not None else None, pad_edge=False)
    for heading in cells:
        table.add_column(heading, justify="left" if heading == "status" else "right", no_wrap=True)
    for line in zip(*cells.values(), strict=True):
        table.add_row(*line)
    return table


_SYMBOLS = {"x_nm": ("x", "nm"), "y_nm": ("y", "nm"), "z_nm": ("z", "nm")}


def _spare(mass: str) -> tuple[str, ...]:
    """Name what a narrow terminal does without, the first to go first."""
    bounds = ("QCRB\nz", "CRB\nz", f"QCRB\n{mass}", f"CRB\n{mass}")
    return (*bounds, "frame", "common\nz", f"common\n{mass}", "y ± σ\n[nm]", "x ± σ\n[nm]")


def _columns(
    free: Sequence[str], mass: tuple[str, str], *, compact: bool, shared: bool
) -> dict[str, Callable[[Mapping[str, Any]], str]]:
    """Give heading → cell; compact, what is not free is left out and headings have two lines.

    `shared` adds the errors that all events have in common.
    """
    columns: dict[str, Callable[[Mapping[str, Any]], str]] = {
        "event": lambda row: str(row["event"]),
        "frame": lambda row: str(row["frame"]),
    }
    symbols = {**_SYMBOLS, "mass_kda": mass}
    for name, (symbol, unit) in symbols.items():
        if name in free or not compact:
            heading = f"{symbol} ± σ{chr(10) if compact else ' '}{f'[{unit}]' if unit else ''}"
            columns[heading] = lambda row, name=name: _with_spread(  # type: ignore[misc]
                row[name], row[f"sigma_{name}"]
            )
    for name in ("z_nm", "mass_kda"):
        symbol, unit = symbols[name]
        if name in free and shared:
            heading = f"common{chr(10) if compact else ' '}{symbol}"
            heading += f" [{unit}]" if unit and not compact else ""
            columns[heading] = lambda row, key=f"systematic_{name}": _short(row.get(key))  # type: ignore[misc]
        for kind in ("crb", "qcrb") if name in free else ():
            title = kind.upper()
            heading = f"{title}\n{symbol}" if compact else f"{title} {symbol}"
            heading += f" [{unit}]" if unit and not compact else ""
            columns[heading] = lambda row, key=f"{kind}_{name}": _short(row[key])  # type: ignore[misc]
    columns["status"] = lambda row: str(row["status"])
    return columns


def _widest(heading: str, cells: Sequence[str]) -> int:
    return max(map(len, [*heading.splitlines(), *cells]))


def _with_spread(value: float, sigma: float | None) -> str:
    """Write a value to the second significant digit of its standard deviation."""
    if sigma is None or not math.isfinite(sigma) or sigma <= 0:
        return _short(value)
    digits = max(0, 1 - math.floor(math.log10(sigma)))
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def _short(value: float | None) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{value:.3g}"
