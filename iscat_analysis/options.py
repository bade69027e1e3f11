"""Keywords of answers from tables: each declared once, for library, command, app and manual.

A group of keywords is a `TypedDict`, so that a type checker knows names and types where a function
takes ``**options``.  Each key says what it means, what the command calls it, and its default.
`takes` gives a function the signature and the docstring that follow.
"""

# Annotations are evaluated: the declarations in them are read when the program runs.

import inspect
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict, TypeVar

if TYPE_CHECKING:
    from iscat_analysis.calibration import Line
    from iscat_analysis.config import Source
    from iscat_analysis.records import Progress

F = TypeVar("F", bound=Callable[..., Any])


@dataclass(frozen=True)
class Option:
    """Type of a keyword, what it means, what the command calls it and its value, and its default.

    All but the type stand in this order in the annotation of the keyword.
    """

    kind: Any
    help: str
    written: str = ""
    default: Any = None

    @property
    def named(self) -> Any:
        """The type as it is written where it is named only."""
        return getattr(self.kind, "__forward_arg__", self.kind)

    @property
    def flag(self) -> str:
        """What begins the option on the command line; empty where it has none."""
        return self.written.partition(" ")[0]


class EventOptions(TypedDict, total=False):
    """What is known of the events of a table: their errors, what was missed, and the mass scale."""

    sigma_kda: Annotated[
        float | None, "Error of every event, instead of the table's [kDa].", "--sigma KDA"
    ]
    limit_kda: Annotated[
        float | None,
        "Mass at which half of the particles are detected, and the spread of the detector's "
        "estimate [kDa]; default from the table.",
        "--limit M[:S]",
    ]
    limit_sigma_kda: Annotated[
        float | None, "Spread of the detector's estimate about `limit_kda` [kDa]."
    ]
    above_kda: Annotated[
        float | None, "Use events above this mass only, and correct for the cut.", "--above KDA"
    ]
    calibration: Annotated[
        "Line | None",
        "Mass line, as `iscat calibrate mass` writes it, in place of any other: masses are those "
        "of the contrasts.",
        "--calibration LINE.toml",
    ]
    select: Annotated[
        "str | Path | None",
        "Selection that the result page saved: events inside its gates, without those rejected.",
        "--select FILE",
    ]


class CommonSpecies(EventOptions, total=False):
    """Which species to look for, in one table or in several."""

    k: Annotated[
        int | None, "Number of species; default the number with the smallest BIC.", "--k N"
    ]
    masses_kda: Annotated[
        Sequence[float] | None, "Masses of the species, which are fixed [kDa].", "--masses M1,M2"
    ]
    ladder: Annotated[
        float | Literal["auto"] | None,
        "Species are oligomers of a monomer of about this mass [kDa], which is fitted; auto finds"
        " it.",
        "--ladder M1",
    ]
    steps: Annotated[
        Sequence[int], "Which oligomers, as in 1,2,4; default those found.", "--steps N1,N2", ()
    ]
    background: Annotated[
        bool,
        "With `masses_kda` and `ladder`: whether a broad, weak background of other masses is "
        "fitted.",
        "--background/--no-background",
        True,
    ]


class SpeciesOptions(CommonSpecies, total=False):
    """How the species of a single table are found."""

    start_kda: Annotated[
        Sequence[float] | None,
        "Masses from which the fit of as many species begins [kDa]; they are free.",
        "--start M1,M2",
    ]
    offset: Annotated[bool, "Fit an offset common to all oligomers.", "--offset", False]
    hold: Annotated[bool, "Fix the mass of the monomer at the one given.", "--hold", False]
    widths: Annotated[
        Literal["free", "common"],
        "With `masses_kda` and `ladder`: a width for each species (default), or one for all.",
        "--widths",
        "free",
    ]
    branch: Annotated[
        Literal["magnitude", "landing", "leaving"],
        "Events to use: all, by the magnitude of their mass, or only those that land or leave.",
        "--branch",
        "magnitude",
    ]


class BindingOptions(EventOptions, total=False):
    """How an equilibrium constant is fitted."""

    masses_kda: Annotated[
        Sequence[float] | None,
        "Approximate mass of the monomer, or of A and B [kDa], from which the fit starts. Without"
        " it the monomer is found from peaks at one mass and its double.",
        "--masses M | A,B",
    ]
    landing_power: Annotated[
        float | None,
        "Exponent P: the number of landings is proportional to concentration times mass^P. -0.167"
        " out of a drop at rest onto an absorbing surface, -0.333 where liquid flows, 0 where all"
        " land alike; fitted, from -1/6 ± 1/6, unless given.",
        "--landing P",
    ]
    inactive: Annotated[
        bool, "Fit the fraction of monomers, or of A, that does not bind.", "--inactive", False
    ]


class DayOptions(TypedDict, total=False):
    """How the movies of a day are analysed, all at once or as they come."""

    config: Annotated["Source | Sequence[Source] | None", "As for `configure`; of all movies."]
    settings: Annotated[
        Mapping[str, Any] | Iterable[str] | None,
        "As for `configure`; they win over `config`, the day's calibrations over both, and the "
        "table over all.",
    ]
    calibration: Annotated[
        "Line | None",
        "The mass line of all movies, as ``iscat calibrate mass`` writes it; where there are "
        "standards among the movies, it is refused.",
    ]
    standards: Annotated[
        str | Sequence[float] | None,
        "Masses in the calibrants [kDa], beside those of the table; as text with standard errors,"
        ' as in ``"66,146:1.5,480"``, otherwise 1 %.',
    ]
    kd: Annotated[
        Literal["dimer", "ab"] | None,
        "Fit an equilibrium constant to each condition with samples of several concentrations, as"
        " `fit_kd`: of monomers in all in ``concentration_nm``, or of A and B in columns ``a_nm``"
        " and ``b_nm``.",
    ]
    kd_masses_kda: Annotated[
        Sequence[float] | None,
        "About the mass of the monomer, which is found otherwise, or of A and B [kDa].",
    ]
    scheduler: Annotated[
        str,
        'Where movies are analysed: ``"threads"``, here and one after the other, or the address '
        'of a Dask scheduler, as ``"tcp://10.0.0.1:8786"``, on whose workers several are at a '
        "time; the result is the same.",
        "",
        "threads",
    ]
    scheduler_file: Annotated[str | Path | None, "File with that address, instead of `scheduler`."]


class Told(TypedDict):
    """Who is told how far the work is, and what there is to say."""

    progress: "Progress"
    notify: Callable[[str], None]


def options_of(keywords: type) -> dict[str, Option]:
    """Give the declaration of each keyword of a group, in the order of their declaration."""
    return {
        name: Option(hint.__origin__, *hint.__metadata__)
        for name, hint in keywords.__annotations__.items()
    }


def only(keywords: type, given: Any) -> dict[str, Any]:
    """Select the keywords of a group."""
    return {name: given[name] for name in options_of(keywords) if name in given}


def defaults(keywords: type) -> Any:
    """Give the defaults of a group."""
    return {name: option.default for name, option in options_of(keywords).items()}


def takes(keywords: type) -> Callable[[F], F]:
    """Give a function with ``**options`` the keywords of a group, with their defaults."""
    known, usual = options_of(keywords), defaults(keywords)

    def expanded(work: F) -> F:
        declared = inspect.signature(work)
        *own, _ = declared.parameters.values()
        kind = inspect.Parameter.KEYWORD_ONLY
        added = [
            inspect.Parameter(name, kind, default=option.default, annotation=option.named)
            for name, option in known.items()
        ]
        signature = declared.replace(parameters=[*own, *added])

        @wraps(work)
        def run(*given: Any, **options: Any) -> Any:
            try:
                signature.bind(*given, **options)
            except TypeError as error:
                raise TypeError(f"{work.__name__}() {error}") from None
            return work(*given, **usual | options)

        vars(run)["__signature__"] = signature
        about = inspect.cleandoc(work.__doc__ or "").replace("**options", _described(known))
        run.__doc__ = about + "\n"
        return run  # type: ignore[return-value]

    return expanded


def _described(known: dict[str, Option]) -> str:
    """Describe keywords as in a docstring of numpydoc."""
    parts = []
    for name, option in known.items():
        what = "optional" if option.default is None else f"default {option.default!r}"
        text = textwrap.fill(option.help, 96, initial_indent="    ", subsequent_indent="    ")
        parts.append(f"{name} : {_written(option.kind)}, {what}\n{text}")
    return "\n".join(parts)


def _written(kind: Any) -> str:
    text: str = getattr(kind, "__forward_arg__", None) or inspect.formatannotation(kind)
    return re.sub(r"collections\.abc\.|typing\.| \| None", "", text)
