"""What a movie, a table or a day tells beside its numbers: findings with a code, and what to do.

A finding of each kind is defined once, in the module of what it is about, as photutils defines its
flags: severity, code, sentence, remedy and page of the manual.  Whoever makes one gives the values
that stand in the sentence.  One place prints them, the page sorts them by severity, and
``summary.json`` lists them with their values, so that a program can act on a code.
"""

from iscat_analysis.findings import camera, files, optics, particles, results, setup, tables, tracks
from iscat_analysis.findings.registry import (
    KINDS,
    Finding,
    FindingKind,
    Findings,
    Noted,
    Severity,
    Subject,
    Value,
    capital,
    existing,
    printing,
    unreported,
    warnings_in,
    worst_first,
)
