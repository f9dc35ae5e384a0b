"""Amplifiers of an older and a newer edition of the protocol, with another number of status words.

The added reading can be 0 or less: -12 to 60 V in steps of 10 mV, of which 1 on the wire is -12 V.
"""

from collections.abc import Iterator
from typing import Any

import pytest

from drivers.protocol.definition import STATUS as DEFINITION_STATUS
from drivers.protocol.definition import status_reading
from drivers.protocol.records import Record, Values
from drivers.wires.wire import reply_words
from sim.amplifier.simulated_amplifier import SimulatedAmplifier

LATER = status_reading("later_voltage", "of another supply", -1200, 6000, 100, "V", is_added=True)
WORD = 1201
"""That it states: 0 V."""
AGES = ("older", "same", "newer")
"""Of an amplifier beside its host or its judge."""


def make_of_age(age: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make simulated amplifiers an edition older or newer than who reads them, or the same."""
    later = Record(*DEFINITION_STATUS.fields, LATER)
    if age == "newer":
        monkeypatch.setattr(
            DEFINITION_STATUS, "pack", lambda values: later.pack(values | {LATER.name: WORD})
        )
        return
    for name, value in vars(later).items():
        monkeypatch.setattr(DEFINITION_STATUS, name, value)
    status = SimulatedAmplifier.status
    if age == "same":

        def stating(amplifier: SimulatedAmplifier, now: float) -> Values:
            return {**status(amplifier, now), LATER.name: WORD}

        monkeypatch.setattr(SimulatedAmplifier, "status", stating)


@pytest.fixture(params=AGES)
def age(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The age of simulated amplifiers beside who reads them: one word less, as many, one more."""
    make_of_age(request.param, monkeypatch)
    reply_words.cache_clear()
    yield request.param
    reply_words.cache_clear()
