"""What can go wrong, in kinds that map onto the exit status of the commands."""

from __future__ import annotations


class IscatError(Exception):
    """Base of every error raised on purpose; its text is one line a user can act on."""

    exit_status = 1

    def __init__(self, *messages: str) -> None:
        super().__init__(*("; ".join(_lines(text)) for text in messages))


def _lines(text: str) -> list[str]:
    """Part a text, in which a value or another program may have put more than one line."""
    return [line.strip() for line in text.splitlines() if line.strip()]


class DataError(IscatError):
    """The data cannot be analysed: says which file, what is wrong and what to do (status 1)."""

    exit_status = 1


class FloodError(DataError):
    """More places pass the detection threshold than particles and expected noise explain."""


class SignError(DataError):
    """Most particles of a calibrant have the sign of those that leave."""

    def __init__(self, problem: str, advice: str) -> None:
        super().__init__(problem, advice)  # both, so that it can be pickled
        self.problem = problem

    def __str__(self) -> str:
        return ", ".join(self.args)


class ConfigError(IscatError):
    """The configuration or an argument is wrong: names key, value and remedy (status 2)."""

    exit_status = 2


class ContrastError(ConfigError):
    """The model's particles are bright where the calibration of masses has them dark, or dark."""


class SchedulerError(IscatError):
    """The cluster that does the work is gone, or was told to stop (status 1)."""
