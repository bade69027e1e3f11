"""`iscat fit`, the main job.

`iscat export`, `view` and `app`: results for other programs, and in the browser.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from iscat_cli.console import Messages, listed, print_result, short, table
from iscat_cli.options import (
    Count,
    ModeSetup,
    MovieSetup,
    Output,
    command,
    frame_range,
    parsed,
    two_numbers,
)

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import RenderableType
    from rich.table import Table

    from iscat_analysis.records import Analysis

GAP = 3  # characters between the columns of a table on a terminal


@dataclass(frozen=True)
class FitSetup(ModeSetup, MovieSetup):
    """The configuration of a fit, with options for its commonest keys.

    Options
    -------
    --frames A:B
        Frames to fit, half-open.
    --background A:B
        Frames of the background, before the particles bound, half-open.
    --channels N:K
        Of N channels whose frames take turns, analyse channel K, from 0.
    --posterior/--no-posterior
        Sample the posterior; default as configured.
    """

    frames: str | None = None
    background: str | None = None
    channels: str | None = None
    posterior: bool | None = None

    @property
    def changes(self) -> list[str]:
        """Changes of the configuration; options come last, so they win over --set."""
        form = (
            "write it as N:K, how many channels take turns and which one is analysed, from 0, "
            "as in --channels 2:0"
        )
        values = {
            "fit.frames": frame_range("--frames", self.frames),
            "background.frames": frame_range("--background", self.background),
            "camera.channels": parsed("--channels", self.channels, two_numbers, form),
        }
        changes = [f"{key}={list(value)}" for key, value in values.items() if value is not None]
        if self.posterior is not None:
            changes.append(f"posterior.enabled={str(self.posterior).lower()}")
        return [*super().changes, *changes]


@dataclass(frozen=True)
class FitOutput(Output):
    """Where the results of a fit go, and how much of them is printed.

    Options
    -------
    --events N
        Print the first N events as well, or tracks; fits.csv and tracks.csv have all of them.
    --figures
        Draw figures for papers into the folder, PNG and SVG; `iscat figures` does so later.
    """

    events: Annotated[int, typer.Option(min=0)] = 0
    figures: bool = False


@command
def fit(
    messages: Messages,
    stacks: list[Path],
    *,
    raw: str | None = None,
    inject: Count = None,
    strict: str | None = None,
    setup: FitSetup,
    output: FitOutput,
) -> None:
    """Fit the particles of a movie and set each spread beside its Cramér–Rao bounds.

    Writes fits.csv, fits.parquet, summary.json, config.toml and report.html to the output
    folder; in mode track also tracks.csv and tracks.parquet: mass and diffusion coefficient of
    every particle.

    Options
    -------
    STACK
        The movie: TIFF of any kind or a folder of them, Refeyn .mp, HDF5 (FILE::/DATASET), Zarr,
        .npy, .npz, .mat (FILE::NAME), ND2, CZI.
    --config C.toml
        Configuration; default iscat.toml beside STACK, which `iscat init` writes. Of several, keys
        of later ones win.
    --out DIR
        Output folder; default the movie's name with .iscat.
    --raw SHAPE,TYPE
        Shape and type of a raw file of numbers, as in 1500x128x128,uint16 (>u2 for big endian;
        behind a header 128x128,uint16,header=344; as MATLAB writes them
        128x96,uint16,order=columns); also STACK::SHAPE,TYPE.
    --inject N
        Landing movies: add N known particles, which land and leave, in a second run and report
        recall, bias and spread.
    --strict [=CODE,…]
        Exit with status 3 if any result is flagged, or σ is understated; with codes of findings,
        as the manual lists them, also if one of these was made.

    Example: 200 frames before the particles bound, the rest after.

        iscat fit movie.tif --mode mass --config setup.toml --background 0:200

    Exit status: 0 done; 1 the data cannot be analysed; 2 usage or configuration;
    3 done, but --strict was given and something is flagged or σ understated;
    130 interrupted.
    """
    from iscat_analysis.errors import ConfigError

    if len(stacks) > 1:
        more = ", …" if len(stacks) > 2 else ""
        raise ConfigError(
            f"{len(stacks)} movies were given ({stacks[0]}, {stacks[1]}{more}), but one is "
            "analysed at a time: name one, or let the shell repeat the command, as in "
            'for movie in *.tif; do iscat-fit "$movie" --config setup.toml; done'
        )
    (stack,) = stacks
    codes = _codes(strict)
    resolved = setup.of(stack, messages)

    from iscat_analysis.executors import open_executor
    from iscat_analysis.movie import MARK

    if raw is not None:
        stack = Path(f"{stack}{MARK}{raw}")
    folder = output.beside(stack, ".iscat")
    with (
        open_executor(setup.scheduler, setup.scheduler_file) as executor,
        messages.telling() as told,
    ):
        from iscat_analysis.pipeline import fit_stack

        how: Any = {"command": messages.command, "inject": inject or 0, "executor": executor}
        how |= {"overwrite": output.overwrite, "figures": output.figures}
        analysis = fit_stack(stack, resolved, out=folder, **how, **told)
    rows = _show(messages, analysis, folder, output.events)
    if strict is not None and (
        any(map(_is_flagged, rows))
        or analysis.summary.get("repeats", {}).get("understated", False)
        or codes & {finding.code for finding in analysis.findings}
    ):
        raise typer.Exit(3)  # something is flagged


@command
def figures(
    messages: Messages,
    result: Path,
    *,
    format_: Literal["pdf", "svg", "png"] = "pdf",
    out: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Draw figures for papers of an analysis: masses, field, precision, tracks, single events.

    Events are drawn where the movie is, at its old place or beside the result.

    Options
    -------
    RESULT
        Output folder of iscat fit.
    --format pdf|svg|png
        Kind of the files; PNG has 300 dots per inch.
    --out DIR
        Folder of the files; default the result's name with .figures.
    --overwrite
        Replace earlier figures.

    Example: for a manuscript.

        iscat figures movie.iscat --format pdf --out paper
    """
    from iscat_analysis.errors import DataError
    from iscat_analysis.pipeline.stored import open_result

    folder = result.with_suffix(".figures") if out is None else out
    with open_result(result) as stored:
        if folder.exists() and not overwrite:
            raise DataError(f"{folder}: is there already; pass `overwrite` to replace its figures")
        written = stored.write_figures(folder, formats=(format_,))
    if not any(path.name.startswith("event_") for path in written) and len(stored):
        messages.note(f"the movie of {result} was not found, so no single event is drawn")
    for path in written:
        print_result(str(path))


def _show(
    messages: Messages, analysis: Analysis, folder: Path, events: int
) -> list[dict[str, Any]]:
    """Print what was found, and give its rows, events and tracks."""
    rows: list[dict[str, Any]] = analysis.table.to_dict("records")
    found: dict[str, Any] = {**analysis.summary, "events": rows, "out": str(folder)}
    if analysis.tracks is not None:
        found["tracks"] = analysis.tracks.to_dict("records")
    messages.show("fit", found, _lines(analysis, folder, events))
    return [*rows, *found.get("tracks", ())]


def _codes(strict: str | None) -> frozenset[str]:
    """Read the codes of findings of ``--strict``, which has none where it stands alone."""
    from iscat_analysis.errors import ConfigError
    from iscat_analysis.findings import KINDS

    codes = frozenset(filter(None, (strict or "").split(",")))
    for code in sorted(codes - KINDS.keys()):
        raise ConfigError(f"--strict={code}: no finding has this code; codes: {', '.join(KINDS)}")
    return codes


def _is_flagged(row: Mapping[str, Any]) -> bool:
    flags = row["flags"]
    return row["status"] != "ok" or (isinstance(flags, str) and bool(flags))


def _lines(analysis: Analysis, folder: Path, events: int) -> Iterator[RenderableType]:
    """Print the species, or what else is the answer, the first rows, and where all of it is."""
    from iscat_analysis.records import tally
    from iscat_analysis.report import answer as said

    answer = said.spoken(analysis)
    yield from answer.cautions
    if answer.species.rows:
        yield listed(answer.species)
    yield from answer.facts
    if events:
        rows = analysis.table if analysis.tracks is None else analysis.tracks
        name, number = "fits", tally(rows).number
        if analysis.tracks is None:
            yield _events_table(analysis, events)
        else:
            name = "tracks"
            contrast = said.main_quantity(analysis) is said.CONTRAST
            yield tracks_table(rows.head(events), contrast=contrast)
        if number > events:
            yield f"… and {number - events} more in {folder / name}.csv"
    yield answer.totals
    yield f"the page: {folder / 'report.html'}"


def _events_table(analysis: Analysis, number: int) -> Table:
    """Tabulate the first events in the unit of their main quantity."""
    from rich.console import Console

    from iscat_analysis.records import counted
    from iscat_analysis.report import answer as said

    shown, mass, console = counted(analysis.table).head(number), ("mass", "kDa"), Console()
    if said.is_uncalibrated(analysis):
        mass = ("mass, model scale", "kDa")
        if said.main_quantity(analysis) is said.CONTRAST:
            shown, mass = said.as_contrasts(shown), ("contrast", "")
    if analysis.mode_kind.fits_sizes:
        shown, mass = said.as_diameters(shown), ("diameter", "nm")
    width = console.width if console.is_terminal else None
    return events_table(shown.to_dict("records"), analysis.mode_kind.free, mass=mass, width=width)


def tracks_table(tracks: pd.DataFrame, *, contrast: bool = False) -> Table:
    """Tabulate rows of ``tracks.csv``: mass or contrast, D, diameter and index if known."""
    from iscat_analysis.report.answer import TRACK_HEADINGS
    from iscat_analysis.report.numbers import with_error

    rows = tracks.to_dict("records")
    columns = {"track": [str(row["track"]) for row in rows]}
    columns["frames"] = [f"{row['first_frame']}–{row['last_frame']}" for row in rows]
    for name, (column, error, unit) in TRACK_HEADINGS.items():
        if name == "mass" and contrast:
            relative = [row[error] / row[column] for row in rows]
            columns["contrast ± σ"] = [
                with_error(row["contrast"], abs(share * row["contrast"]))
                for row, share in zip(rows, relative, strict=True)
            ]
        elif name in ("mass", "D") or (column in tracks and tracks[column].notna().any()):
            heading = f"{name} ± σ{f' [{unit}]' if unit else ''}"
            columns[heading] = [with_error(row[column], row[error]) for row in rows]
    columns["status"] = [str(row["status"]) for row in rows]
    return _of_columns(columns)


def events_table(
    rows: Sequence[Mapping[str, Any]],
    free: Sequence[str],
    *,
    mass: tuple[str, str] = ("mass", "kDa"),
    width: int | None = None,
) -> Table:
    """Tabulate rows of ``fits.csv``: every parameter ± σ, and the bounds of z and mass where free.

    `mass` is what the column ``mass_kda`` is called, and its unit, which may be empty.  On a
    terminal of `width` characters parameters that are not free are left out, headings have two
    lines, and what fits least goes.
    """
    from iscat_analysis.report.numbers import with_error

    symbols = {name: (name[0], "nm") for name in ("x_nm", "y_nm", "z_nm")} | {"mass_kda": mass}
    gap = " " if width is None else "\n"
    cells = {name: [str(row[name]) for row in rows] for name in ("event", "frame")}
    for name, (symbol, unit) in symbols.items():
        if name in free or width is None:
            heading = f"{symbol} ± σ{gap}{f'[{unit}]' if unit else ''}"
            cells[heading] = [with_error(row[name], row[f"sigma_{name}"]) for row in rows]
    shared = any(f"systematic_{name}" in row for row in rows for name in ("z_nm", "mass_kda"))
    errors = {"common": "systematic"} if shared else {}
    for name in (name for name in ("z_nm", "mass_kda") if name in free):
        symbol, unit = symbols[name]
        for title, kind in (errors | {"CRB": "crb", "QCRB": "qcrb"}).items():
            heading = f"{title}{gap}{symbol}{f' [{unit}]' if unit and width is None else ''}"
            cells[heading] = [short(row.get(f"{kind}_{name}"), 3) for row in rows]
    cells["status"] = [str(row["status"]) for row in rows]
    if width is not None:
        bounds = ("QCRB\nz", "CRB\nz", f"QCRB\n{mass[0]}", f"CRB\n{mass[0]}", "frame", "common\nz")
        for spare in (*bounds, f"common\n{mass[0]}", "y ± σ\n[nm]", "x ± σ\n[nm]"):
            if sum(_widest(heading, column) + GAP for heading, column in cells.items()) > width:
                cells.pop(spare, None)
    return _of_columns(cells)


def _of_columns(cells: Mapping[str, Sequence[str]]) -> Table:
    return table(*cells, rows=zip(*cells.values(), strict=True), left=(len(cells) - 1,))


def _widest(heading: str, cells: Sequence[str]) -> int:
    return max(map(len, [*heading.splitlines(), *cells]))


@command
def export(
    messages: Messages,
    folder: Path,
    *,
    to: Literal["trackpy", "napari", "photomol", "picasso"],
    out: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Write the events or tracks of an analysis as other programs read them.

    Of landings, those whose status is ok. trackpy: columns y, x, frame, particle (of tracks), mass,
    signal, ep, z, places in pixels. napari: numpy.load gives what viewer.add_tracks, of landings
    viewer.add_points, takes. photomol: columns contrasts and masses_kDa, which iscat species reads
    back with errors. picasso: locs with frame, x, y, photons, lpx, lpy, and mass_kda beside them.

    Options
    -------
    DIR
        Output folder of iscat fit.
    --to
        trackpy: a CSV table; napari: an array (track, t, y, x), of landings (t, y, x); photomol: a
        CSV table like Refeyn's; picasso: HDF5 and YAML.
    --out FILE
        The file; default the folder's name with .trackpy.csv, .napari.npy, .photomol.csv or
        .picasso.hdf5.
    --overwrite
        Replace earlier output.

    Example: tracks for trackpy, and landings for PhotoMol.

        iscat export moving.iscat --to trackpy --out moving.csv

        iscat export standards.iscat --to photomol
    """
    from iscat_analysis.report.exchange import export_result

    written = export_result(folder, to, out=out, overwrite=overwrite)
    messages.note(*written.notes)
    print_result(f"{written.text} in {written.path}")


@command
def view(result: Path) -> None:
    """Open the page of a result in the browser.

    Prints where the page is; on a machine without a browser that is all, and the status is 1.

    Options
    -------
    DIR
        Output folder of fit, batch, calibrate, species, kd, bounds or benchmark; or a movie that
        has one beside it.

    Example: the report of a movie, in the browser.

        iscat view movie.iscat
    """
    import webbrowser

    from iscat_analysis.errors import DataError
    from iscat_analysis.report.output import page_of

    page = page_of(result)
    print_result(str(page))
    if not webbrowser.open(page.resolve().as_uri()):
        raise DataError(
            f"{page}: no browser could be opened here; copy the file to a machine with one, it "
            "needs no other file"
        )


@command
def app(
    messages: Messages,
    folder: Path = Path(),
    *,
    port: Annotated[int | None, typer.Option(min=0, max=65535)] = None,
) -> None:
    """Open movies, analyse them and export figures in the browser, without programming.

    Listens on this machine alone, to whoever has the token in the address that it prints.

    Options
    -------
    FOLDER
        Folder of movies; default this one.
    --port N
        Port to listen at; default a free one from 5006.

    Example: the movies of a day.

        iscat app measurements/monday

    Ctrl-C ends it; a movie that is being analysed then is stopped, keeps what is
    finished, and can be gone on with.
    """
    from iscat_analysis.errors import ConfigError

    try:
        from iscat_app.server import serve
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in ("panel", "bokeh", "param"):
            raise
        raise ConfigError(
            "the window in the browser needs Panel; install it with: "
            'pip install "iscat-analysis[app]"'
        ) from None
    messages.note("Ctrl-C ends it")
    serve(folder, port=port, say=print_result, warn=messages.error, debug=messages.debug)
