"""Keywords of answers from tables: each declared once, for library, command, app and manual.

A group of keywords is a `TypedDict`, so that a type checker knows names and types where a function
takes ``**options``.  Each key says its default, what it means, and what the command calls it.
`takes` gives a function the signature and the docstring that follow.
"""

# Annotations are evaluated: the declarations in them are read when the program runs.

import inspect
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict, TypeVar

if TYPE_CHECKING:
    from iscat_analysis.calibration import Line
    from iscat_analysis.config import Source

F = TypeVar("F", bound=Callable[..., Any])


@dataclass(frozen=True)
class Option:
    """A keyword's default, its meaning, and the command's flag and placeholder of a value.

    `text` says how a value is written on a command line that no type describes.
    """

    default: Any
    help: str
    flag: str = ""
    metavar: str | None = None
    text: Literal["", "numbers", "whole", "monomer", "pair"] = ""


class EventOptions(TypedDict, total=False):
    """What is known of the events of a table: their errors, what was missed, and the mass scale."""

    sigma_kda: Annotated[
        float | None,
        Option(None, "Error of every event, instead of the table's [kDa].", "--sigma", "KDA"),
    ]
    limit_kda: Annotated[
        float | None,
        Option(
            None,
            "Mass at which half of the particles are detected, and the spread of the detector's "
            "estimate [kDa]; default from the table.",
            "--limit",
            "M[:S]",
            "pair",
        ),
    ]
    limit_sigma_kda: Annotated[
        float | None, Option(None, "Spread of the detector's estimate about `limit_kda` [kDa].")
    ]
    above_kda: Annotated[
        float | None,
        Option(None, "Use events above this mass only, and correct for the cut.", "--above", "KDA"),
    ]
    calibration: Annotated[
        "Line | None",
        Option(
            None,
            "Mass line, as `iscat calibrate mass` writes it, in place of any other: masses are "
            "those of the contrasts.",
            "--calibration",
            "LINE.toml",
        ),
    ]


class CommonSpecies(EventOptions, total=False):
    """Which species to look for, in one table or in several."""

    k: Annotated[
        int | None,
        Option(None, "Number of species; default the number with the smallest BIC.", "--k", "N"),
    ]
    masses_kda: Annotated[
        Sequence[float] | None,
        Option(
            None, "Masses of the species, which are fixed [kDa].", "--masses", "M1,M2", "numbers"
        ),
    ]
    ladder: Annotated[
        float | Literal["auto"] | None,
        Option(
            None,
            "Species are oligomers of a monomer of about this mass [kDa], which is fitted; auto "
            "finds it.",
            "--ladder",
            "M1",
            "monomer",
        ),
    ]
    steps: Annotated[
        Sequence[int],
        Option(
            (), "Which oligomers, as in 1,2,4; default those found.", "--steps", "N1,N2", "whole"
        ),
    ]
    background: Annotated[
        bool,
        Option(
            True,
            "With `masses_kda` and `ladder`: whether a broad, weak background of other masses is "
            "fitted.",
            "--background/--no-background",
        ),
    ]


class SpeciesOptions(CommonSpecies, total=False):
    """How the species of a single table are found."""

    start_kda: Annotated[
        Sequence[float] | None,
        Option(
            None,
            "Masses from which the fit of as many species begins [kDa]; they are free.",
            "--start",
            "M1,M2",
            "numbers",
        ),
    ]
    offset: Annotated[bool, Option(False, "Fit an offset common to all oligomers.", "--offset")]
    hold: Annotated[bool, Option(False, "Fix the mass of the monomer at the one given.", "--hold")]
    widths: Annotated[
        Literal["free", "common"],
        Option(
            "free",
            "With `masses_kda` and `ladder`: a width for each species (default), or one for all.",
            "--widths",
        ),
    ]
    branch: Annotated[
        Literal["magnitude", "landing", "leaving"],
        Option(
            "magnitude",
            "Events to use: all, by the magnitude of their mass, or only those that land or leave.",
            "--branch",
        ),
    ]


class BindingOptions(EventOptions, total=False):
    """How an equilibrium constant is fitted."""

    masses_kda: Annotated[
        Sequence[float] | None,
        Option(
            None,
            "Approximate mass of the monomer, or of A and B [kDa], from which the fit starts. "
            "Without it the monomer is found from peaks at one mass and its double.",
            "--masses",
            "M | A,B",
            "numbers",
        ),
    ]
    landing_power: Annotated[
        float | None,
        Option(
            None,
            "Exponent P: the number of landings is proportional to concentration times mass^P. "
            "-0.167 out of a drop at rest onto an absorbing surface, -0.333 where liquid flows, 0 "
            "where all land alike; fitted, from -1/6 ± 1/6, unless given.",
            "--landing",
            "P",
        ),
    ]
    inactive: Annotated[
        bool,
        Option(False, "Fit the fraction of monomers, or of A, that does not bind.", "--inactive"),
    ]


class DayOptions(TypedDict, total=False):
    """How the movies of a day are analysed, all at once or as they come."""

    config: Annotated[
        "Source | Sequence[Source] | None", Option(None, "As for `configure`; of all movies.")
    ]
    settings: Annotated[
        Mapping[str, Any] | Iterable[str] | None,
        Option(
            None,
            "As for `configure`; they win over `config`, the day's calibrations over both, and the "
            "table over all.",
        ),
    ]
    calibration: Annotated[
        "Line | None",
        Option(
            None,
            "The mass line of all movies, as ``iscat calibrate mass`` writes it; where there are "
            "standards among the movies, it is refused.",
        ),
    ]
    standards: Annotated[
        str | Sequence[float] | None,
        Option(
            None,
            "Masses in the calibrants [kDa], beside those of the table; as text with standard "
            'errors, as in ``"66,146:1.5,480"``, otherwise 1 %.',
        ),
    ]
    kd: Annotated[
        Literal["dimer", "ab"] | None,
        Option(
            None,
            "Fit an equilibrium constant to each condition with samples of several concentrations, "
            "as `fit_kd`: of monomers in all in ``concentration_nm``, or of A and B in columns "
            "``a_nm`` and ``b_nm``.",
        ),
    ]
    kd_masses_kda: Annotated[
        Sequence[float] | None,
        Option(
            None, "About the mass of the monomer, which is found otherwise, or of A and B [kDa]."
        ),
    ]
    scheduler: Annotated[
        str,
        Option(
            "threads",
            'Where movies are analysed: ``"threads"``, here and one after the other, or the '
            'address of a Dask scheduler, as ``"tcp://10.0.0.1:8786"``, on whose workers several '
            "are at a time; the result is the same.",
        ),
    ]
    scheduler_file: Annotated[
        str | Path | None, Option(None, "File with that address, instead of `scheduler`.")
    ]


def options_of(keywords: type) -> dict[str, tuple[Any, Option]]:
    """Give type and declaration of each keyword of a group, in the order of their declaration."""
    return {
        name: (hint.__origin__, hint.__metadata__[0])
        for name, hint in keywords.__annotations__.items()
    }


def only(keywords: type, given: Any) -> dict[str, Any]:
    """Select the keywords of a group."""
    return {name: given[name] for name in options_of(keywords) if name in given}


def defaults(keywords: type) -> Any:
    """Give the defaults of a group."""
    return {name: option.default for name, (_, option) in options_of(keywords).items()}


def takes(keywords: type) -> Callable[[F], F]:
    """Give a function with ``**options`` the keywords of a group, with their defaults."""
    known = options_of(keywords)

    def expanded(work: F) -> F:
        *own, _ = inspect.signature(work).parameters.values()
        added = [
            inspect.Parameter(
                name, inspect.Parameter.KEYWORD_ONLY, default=option.default, annotation=kind
            )
            for name, (kind, option) in known.items()
        ]
        signature = inspect.Signature(
            [*own, *added], return_annotation=inspect.signature(work).return_annotation
        )

        @wraps(work)
        def run(*given: Any, **options: Any) -> Any:
            signature.bind(*given, **options)
            return work(*given, **defaults(keywords) | options)

        vars(run)["__signature__"] = signature
        about = inspect.cleandoc(work.__doc__ or "").replace("**options", _described(known))
        run.__doc__ = about + "\n"
        return run  # type: ignore[return-value]

    return expanded


def _described(known: dict[str, tuple[Any, Option]]) -> str:
    """Describe keywords as in a docstring of numpydoc."""
    parts = []
    for name, (kind, option) in known.items():
        what = "optional" if option.default is None else f"default {option.default!r}"
        text = textwrap.fill(option.help, 96, initial_indent="    ", subsequent_indent="    ")
        parts.append(f"{name} : {_written(kind)}, {what}\n{text}")
    return "\n".join(parts)


def _written(kind: Any) -> str:
    text = (
        kind.__forward_arg__ if hasattr(kind, "__forward_arg__") else inspect.formatannotation(kind)
    )
    return text.replace("collections.abc.", "").replace("typing.", "").replace(" | None", "")
