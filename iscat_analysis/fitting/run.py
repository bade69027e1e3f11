"""One run of the main job: messages, progress, times and finished parts."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from iscat_analysis.executors import Executor
from iscat_analysis.findings import Finding, Findings, existing, remark
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.inference.heights import has_prior
from iscat_analysis.inference.noise import compile_kernels, parts_of
from iscat_analysis.records import FREE_PARAMETERS, Progress

Notify = Callable[[str], None]


def notify_nobody(text: str) -> None:
    """Drop a message."""


class Clock:
    """Measures the seconds of each stage."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.seconds: dict[str, float] = {}

    def lap(self, name: str) -> None:
        """Store the time since the last call under a name."""
        now = time.perf_counter()
        self.seconds[name] = now - self._last
        self._last = now


@dataclass(frozen=True)
class Run:
    """The settings of one run, and the findings that it collects."""

    notify: Notify
    progress: Progress
    partial: Path | None
    executor: Executor
    inject: int
    clock: Clock = field(default_factory=Clock)
    findings: Findings = field(default_factory=Findings)

    def report(self, *findings: Finding | None) -> None:
        """Print findings, and keep them for the result; what is None was not found."""
        for finding in existing(findings):
            self.findings.add(finding)
            self.notify(finding.text)

    def warn(self, text: str) -> None:
        """Report a sentence that has no code yet."""
        self.report(remark(text))

    def warm_up(self, context: AnalysisContext) -> None:
        """Load or compile the kernels of fits."""
        config = context.config
        parts = parts_of(
            FREE_PARAMETERS[context.mode],
            heights=has_prior(config),
            posteriors=config.samples_posterior,
        )
        compile_kernels(context.model, parts)
