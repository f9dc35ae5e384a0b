"""Every rule of the witness, on conversations written by hand."""

import re
from pathlib import Path
from typing import Any

import pytest

import amplifier_violations
import hand_written as hand
import host_violations
from hand_written_talk import Talk

BROKEN = {**host_violations.BROKEN, **amplifier_violations.BROKEN}
PAGE = Path(__file__).parents[3] / "docs" / "reference" / "witness.md"


@pytest.mark.parametrize("name", BROKEN)
def test_witness_finds_a_broken_rule(name: str) -> None:
    """The conversation breaks one rule, and no other."""
    rule, talk = BROKEN[name]
    assert {*talk().found} == {rule}


def test_every_rule_of_the_page_is_found_broken() -> None:
    """By a conversation of its own."""
    rules = PAGE.read_text(encoding="utf-8").partition("## The rules")[2].partition("## In tests")
    listed = set(re.findall(r"^\| (\w+) \|", rules[0], flags=re.M)) - {"name"}
    assert {rule for rule, _ in BROKEN.values()} == listed


def test_sound_conversation_breaks_no_rule() -> None:
    """Armed, played in two layers, achieved, silenced, stopped, cleared, armed again, disarmed."""
    talk = Talk().armed().playing()
    talk.staged(6, hand.layer(1, hand.tone(1, 150, 0.3, 90.0), valid_for=200))
    talk.committed(6, levels=(5000, 30), tokens=(5, 6, 0, 0)).rest(0.03)
    both: dict[str, Any] = {"token": 6, "levels": (5000, 3000)}
    talk.says(**both | {"tokens": (5, 6, 0, 0)})
    achieved = [6, *hand.layer(1, hand.tone(1, 150, 0.3, 90.0), valid_for=200)]
    talk.exchange(hand.GET_ACHIEVED, (1,), achieved)
    talk.exchange(hand.SET, hand.part(7, hand.layer(1, valid_for=300, renew=True)), hand.taken(7))
    talk.committed(7, levels=(5000, 3000), tokens=(5, 6, 0, 0))
    talk.rest(0.2).says(**both | {"token": 7, "tokens": (5, 6, 0, 0)})
    talk.rest(0.2).says(token=7, levels=(5000, 0), tokens=(5, 0, 0, 0))
    talk.exchange(hand.SILENCE, (9, 5), hand.status(token=7, levels=(5000, 0)))
    talk.rest(0.02).says(token=7)
    talk.exchange(hand.STOP, (5,), hand.status(hand.STOPPED, latch=1, token=7))
    talk.exchange(hand.CLEAR, (1,), hand.status(hand.SWITCHED_OFF, latch=1, token=7))
    talk.exchange(hand.ARM, (10, 250), hand.status(latch=1))
    talk.exchange(hand.DISARM, (50,), hand.status(hand.SWITCHED_OFF, latch=1))
    assert talk.found == []
