"""What was used last is held, and what nobody asked for goes first."""

from __future__ import annotations

from iscat_analysis.last_used import LastUsed


def test_what_was_asked_for_stays() -> None:
    held: LastUsed[str] = LastUsed(30)
    for name in "abc":
        held.hold(name, name.upper(), 10)
    assert held.get("a") == "A"
    held.hold("d", "D", 10)
    assert [held.get(name) for name in "abcd"] == ["A", None, "C", "D"]


def test_a_value_takes_the_place_of_the_one_before() -> None:
    held: LastUsed[str] = LastUsed(30)
    for size in (10, 25, 5):
        held.hold("a", str(size), size)
    held.hold("b", "B", 25)
    assert (held.get("a"), held.get("b")) == ("5", "B")
    held.hold("c", "C", 1)
    assert (held.get("a"), held.get("b"), held.get("c")) == (None, "B", "C")


def test_the_last_one_is_held_whatever_it_takes() -> None:
    held: LastUsed[str] = LastUsed(30)
    held.hold("a", "A", 10)
    held.hold("b", "B", 1000)
    assert (held.get("a"), held.get("b")) == (None, "B")
