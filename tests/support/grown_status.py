"""Status with one word more than the table has: what a later edition of the protocol adds."""

from collections.abc import Iterator
from typing import Any

import pytest

from drivers.protocol.records import Number, Record, Values, WireQuantity
from drivers.protocol.table import STATUS
from drivers.wires.wire import reply_words
from sim.amplifier.contract import Amplifier

LATER = Number(
    "later_voltage", WireQuantity("later_voltage", "u16", 100, "V", 1, 65535), is_added=True
)
WORD = 2400
"""That it states: 24 V."""
AGES = ("older", "same", "newer")
"""Of an amplifier beside its host, its judge or the witness."""


def make_of_age(age: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make simulated amplifiers an edition older or newer than who reads them, or the same."""
    if age == "newer":
        pack = STATUS.pack
        monkeypatch.setattr(STATUS, "pack", lambda values: [*pack(values), WORD])
        return
    for name, value in vars(Record(*STATUS.fields, LATER)).items():
        monkeypatch.setattr(STATUS, name, value)
    status = Amplifier.status
    if age == "same":

        def stating(amplifier: Amplifier, now: float) -> Values:
            return {**status(amplifier, now), LATER.name: WORD}

        monkeypatch.setattr(Amplifier, "status", stating)


@pytest.fixture(params=AGES)
def age(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The age of simulated amplifiers beside who reads them: one word less, as many, one more."""
    make_of_age(request.param, monkeypatch)
    reply_words.cache_clear()
    yield request.param
    reply_words.cache_clear()
