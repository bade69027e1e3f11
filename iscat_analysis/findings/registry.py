"""The registry of findings: each kind has a code of its own, and a sentence that takes values."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from string import Formatter
from typing import Any, Protocol, TypeVar

Value = float | int | str

_STOP = re.compile(r"[:;] |\. |, (?:and|as|which|so|because|where) ")
_FEW_LETTERS = 12


class Severity(StrEnum):
    """How much a finding changes what a reader may conclude, least first."""

    NOTE = "note"
    """Something was learned or left out; the numbers are right as they stand."""
    CAUTION = "caution"
    """Numbers may be wrong by more than their errors, or some are missing."""
    FAULT = "fault"
    """Numbers are wrong unless the remedy is taken."""


class Subject(StrEnum):
    """What a finding is about: a reader asks whether to believe each of these."""

    CAMERA = "camera"
    """Camera, light, file and frames."""
    OPTICS = "optics"
    """Microscope, and whether the pictures are as it makes them."""
    ERRORS = "errors"
    """Errors of single particles, and whether the particles that remain are a fair sample."""
    SCALE = "scale"
    """What makes a mass or a diameter of a contrast."""


@dataclass(frozen=True)
class FindingKind:
    """What all findings of one code have in common.

    Attributes
    ----------
    code : str
        Words joined by hyphens; never changed, because programs test it.
    severity : Severity
        How much it matters.
    sentence : str
        What was found, with the names of values in braces, formatted as by `str.format`.
    remedy : str
        What the user can do, in the same way; empty where nothing is to be done.
    page : str
        Page of the manual that explains it, as ``"howto/focus"``.
    subject : Subject
        What it is about.
    """

    code: str
    severity: Severity
    sentence: str
    remedy: str = ""
    page: str = ""
    subject: Subject = Subject.ERRORS

    @property
    def names(self) -> frozenset[str]:
        """Names of the values that sentence and remedy need."""
        parts = [*Formatter().parse(self.sentence), *Formatter().parse(self.remedy)]
        return frozenset(name for _, name, _, _ in parts if name)

    def __call__(
        self,
        values: Mapping[str, Value] | None = None,
        *,
        where: str = "",
        frames: tuple[int, int] | None = None,
    ) -> Finding:
        """Make a finding; values that the sentence does not name go to ``summary.json`` alone."""
        values = dict(values or {})
        if missing := self.names - values.keys():
            raise KeyError(f"{self.code}: no value for {', '.join(sorted(missing))}")
        return Finding(self, values, where, frames)


KINDS: dict[str, FindingKind] = {}
"""All kinds of finding that were defined, by code."""


def define(
    severity: Severity,
    code: str,
    sentence: str,
    remedy: str = "",
    page: str = "",
    *,
    subject: Subject,
) -> FindingKind:
    """Register a kind of finding; a code that is taken is refused at import."""
    if code in KINDS:
        raise ValueError(f"the finding {code!r} is defined twice")
    KINDS[code] = FindingKind(code, severity, sentence, remedy, page, subject)
    return KINDS[code]


def makers(subject: Subject) -> Iterator[Callable[..., FindingKind]]:
    """Give what registers kinds of note, caution and fault, about a subject unless they say so."""
    return (partial(define, severity, subject=subject) for severity in Severity)


@dataclass(frozen=True)
class Finding:
    """One thing that was found, with the values of its sentence.

    Attributes
    ----------
    kind : FindingKind
        Its code, severity, sentence and remedy.
    values : mapping
        Numbers and words of the sentence, and others that a program may want.
    where : str
        The movie or table that it is about; empty if that is plain.
    frames : (int, int) or None
        First frame, and the one after the last, where it is about some frames only.
    """

    kind: FindingKind
    values: Mapping[str, Value] = field(default_factory=dict)
    where: str = ""
    frames: tuple[int, int] | None = None

    @property
    def code(self) -> str:
        """Code of its kind."""
        return self.kind.code

    @property
    def severity(self) -> Severity:
        """How much it matters."""
        return self.kind.severity

    @property
    def remedy(self) -> str:
        """What the user can do; empty where nothing is to be done."""
        return self.kind.remedy.format(**self.values)

    @property
    def text(self) -> str:
        """The whole sentence, as it is printed."""
        where = f"{self.where}: " if self.where else ""
        remedy = f"; {self.remedy}" if self.kind.remedy else ""
        return where + self.kind.sentence.format(**self.values) + remedy

    @property
    def brief(self) -> tuple[str, str]:
        """The sentence to the first stop after its first number; and the remedy, or the rest."""
        text = self.kind.sentence.format(**self.values)
        number = re.search(r"\d", text)
        stop = _STOP.search(text, max(_FEW_LETTERS, number.start() if number else 0))
        first, rest = (text[: stop.start()], text[stop.end() :]) if stop else (text, "")
        return capital(first.rstrip(".")), capital(self.remedy or rest)

    @property
    def summary(self) -> dict[str, Any]:
        """Its entry in ``findings`` of ``summary.json``."""
        return {
            "code": self.code,
            "severity": str(self.severity),
            "values": dict(self.values),
            "frames": None if self.frames is None else list(self.frames),
            "text": self.text,
            "remedy": self.remedy,
        }


@dataclass
class Findings:
    """The findings of a run, in the order in which they were made."""

    made: list[Finding] = field(default_factory=list)

    def add(self, *findings: Finding | None) -> None:
        """Keep findings; what is None was not found."""
        self.made.extend(existing(findings))

    @property
    def summary(self) -> list[dict[str, Any]]:
        """``findings`` of ``summary.json``, the most severe first."""
        return [finding.summary for finding in worst_first(self.made)]


def capital(text: str) -> str:
    """Begin a text with a capital letter, unless it begins with a key or a symbol."""
    first = text.split(" ")[0]
    return text if set('._`"σ') & set(first) else text[:1].upper() + text[1:]


class Judged(Protocol):
    """What has a severity."""

    @property
    def severity(self) -> Severity:
        """How much it matters."""


J = TypeVar("J", bound=Judged)


def worst_first(judged: Iterable[J]) -> list[J]:
    """Put the most severe first, and leave what is alike in its order."""
    order = list(Severity)[::-1]
    return sorted(judged, key=lambda one: order.index(one.severity))


def unreported(finding: Finding) -> None:
    """Drop a finding."""


def printing(notify: Callable[[str], None] | None) -> Callable[[Finding], None]:
    """Report findings as their sentences; to nobody if `notify` is None."""
    return unreported if notify is None else lambda finding: notify(finding.text)


def warnings_in(findings: Iterable[Finding]) -> list[str]:
    """Sentences of the findings that are more than a note."""
    return [finding.text for finding in findings if finding.severity is not Severity.NOTE]


class Noted:
    """A result with findings."""

    findings: tuple[Finding, ...]

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences of the findings."""
        return tuple(finding.text for finding in self.findings)


def existing(findings: Iterable[Finding | None]) -> list[Finding]:
    """Leave out what was looked for and not found."""
    return [finding for finding in findings if finding is not None]
