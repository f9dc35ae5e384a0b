"""Classes of amplifiers, and the page that says what follows from each lack."""

from dataclasses import replace
from pathlib import Path

import pytest

from classes_page import WRITER, classes_table
from drivers.protocol.classes import amplifier_class, missing
from drivers.protocol.messages import Feature
from page_part import insert
from sim.amplifier.amplifier import capabilities

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "amplifier-classes.md"
WHOLE = capabilities(4)


@pytest.mark.parametrize(
    ("lacking", "expected"),
    [
        (Feature(0), "A"),
        (Feature.EVENTS | Feature.BROADCAST | Feature.INTERLOCK, "A"),
        (Feature.STAGING, "B"),
        (Feature.VALID_FOR, "B"),
        (Feature.PHASE, "B"),
        (Feature.WATCHDOG, "C"),
        (Feature.WHOLE, "C"),
    ],
)
def test_class_follows_from_the_features(lacking: Feature, expected: str) -> None:
    """The gravest lack counts."""
    assert amplifier_class(replace(WHOLE, features=WHOLE.features & ~lacking)) == expected


def test_class_a_has_envelopes() -> None:
    """Which have no bit of their own."""
    plain = replace(WHOLE, envelope_knots=0)
    assert amplifier_class(plain) == "B"
    assert [lack.name for lack in missing(plain)] == ["envelopes"]


def test_two_voices_are_named_and_leave_the_class() -> None:
    """An amplifier of two oscillators a channel may be of class A."""
    small = replace(WHOLE, voices=2)
    assert amplifier_class(small) == "A"
    assert [lack.name for lack in missing(small)] == ["8 voices"]
    assert missing(WHOLE) == ()


def test_page_has_the_table_of_the_code() -> None:
    """Written anew by the program that the page names."""
    page = PAGE.read_text("utf-8")
    assert insert(page, classes_table(), writer=WRITER) == page, f"python {WRITER} {PAGE.name}"
