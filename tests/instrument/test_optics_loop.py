"""The loop of the learner: which pictures are collected again, and which optics are used."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.instrument import loop
from iscat_analysis.instrument.loop import Rounds, learn
from iscat_analysis.instrument.particle_image import Collected

CONFIG = Config.model_validate({"optics": {"focus_nm": -300.0}})


class _Source:
    """Gives as many pictures as there are answers of the test; raises where that is None."""

    def __init__(self, *described: bool | None) -> None:
        self.described = described
        self.ahead: list[float] = []

    def collect(self, rounds: Rounds) -> Collected | None:
        number = len(rounds.all)
        if rounds.all and rounds.next is not None:
            self.ahead.append(rounds.next.optics.focus_nm)
        if number == len(self.described):
            return None
        if self.described[number] is None:
            raise DataError("nothing can be followed")
        return Collected(CONFIG, (), found_with=rounds.next if rounds.all else CONFIG)

    def describes(self, seen: Collected) -> bool:
        assert seen.config == CONFIG
        return bool(self.described[len(self.ahead)])


def _learn(monkeypatch: pytest.MonkeyPatch, source: _Source, *good: bool) -> Rounds:
    """Learn optics of which some may be used, with a focus that rises by 10 nm every time."""
    number = iter(range(len(good)))

    def fit(*_: Any, **__: Any) -> Any:
        k = next(number)
        focus = -290.0 + 10 * k
        optics = CONFIG.optics.model_copy(update={"focus_nm": focus})
        return SimpleNamespace(
            accepted=good[k], config=CONFIG.model_copy(update={"optics": optics}),
            names=("focus_nm",), covariance=np.eye(1),
            measured=SimpleNamespace(settings={"focus_nm": focus}, refusals=("not uniform",)),
        )  # fmt: skip

    monkeypatch.setattr(loop, "fit_optics", fit)
    return learn(source, CONFIG, ("focus",), {"movie": "m"})


def _focus(rounds: Rounds) -> float | None:
    return (
        None
        if rounds.best is None or rounds.best.learned is None
        else (rounds.best.learned.optics.focus_nm)
    )


@pytest.mark.parametrize(
    ("described", "good", "focus_nm"),
    [
        ((True,), (True,), -290.0),
        ((True,), (False,), None),
        ((False, True), (True, True), -280.0),
        ((True, False), (True, True), -290.0),  # of pictures that were found with wrong optics
        ((True, True), (True, False), -290.0),
        ((True, None), (True,), -290.0),  # what was learned last finds nothing
    ],
)
def test_optics_are_used_that_were_accepted_and_learned_from_good_pictures(
    described: tuple[bool | None, ...],
    good: tuple[bool, ...],
    focus_nm: float | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rounds = _learn(monkeypatch, _Source(*described), *good)
    assert _focus(rounds) == focus_nm
    assert len(rounds.all) == len(good)


def test_pictures_are_collected_with_what_was_learned_last(monkeypatch: pytest.MonkeyPatch) -> None:
    source = _Source(True, True)
    _learn(monkeypatch, source, False, True)
    assert source.ahead[0] == -290.0


def test_a_movie_without_pictures_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DataError, match="nothing can be followed"):
        _learn(monkeypatch, _Source(None))
