"""Messages between the daemon and its estimator, in Python's pickle format.

A message is its length, 8 bytes, and its pickle. The estimator answers each request by one message,
a list of replies. Both sides are the same program, and no other process has their pipes.
"""

import io
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from model.identification.forward import Sensor
from model.identification.settled_patterns import SettledPattern
from model.rig.rig import Rig
from model.table.table import LocalizationTable

HEAD = 8
"""Bytes of a message's length."""


@dataclass(frozen=True, eq=False)
class Start:
    """What an estimator starts from.

    table: of the rig as built, never changed; sensors: where readings are from; drive_mode: of the
    questions that answers are prepared for; file: of what is learned.
    """

    rig: Rig
    table: LocalizationTable
    sensors: tuple[Sensor, ...]
    drive_mode: str
    file: Path


@dataclass(frozen=True, eq=False)
class Answers:
    """A table in place of the one that it corrects, prepared for its first touch.

    base: fingerprint of the table that it corrects; is_complete: whether onsets and endings are
    shaped anew for it, too.
    """

    base: str
    table: LocalizationTable
    is_complete: bool


@dataclass(frozen=True, eq=False)
class Ready:
    """The estimator takes patterns.

    settling [s]: until the plate has settled; note: why it starts anew although there is a file, or
    nothing; only_alarms: why it does not correct answers, or nothing; answers: those of the plate
    as learned before, None for the table as built; cautious: for a plate that is not known;
    change: how it had changed in a way that nothing known explains, as found then, or nothing.
    """

    settling: float
    note: str
    only_alarms: str
    answers: Answers | None
    cautious: Answers
    change: str


@dataclass(frozen=True, eq=False)
class Estimate:
    """What a pattern has shown.

    time [s]: of the pattern; alarm: whether the plate is not as known; is_held: whether answers
    wait for an explanation; explanation: what has changed, where that was found now; change: how
    the plate has changed in a way that nothing known explains, or nothing; answers: None for the
    same.
    """

    time: float
    alarm: bool
    is_held: bool
    explanation: str
    change: str
    answers: Answers | None


@dataclass(frozen=True, eq=False)
class RefreshedAnswers:
    """Answers prepared whole while nothing else was to be done, and cautious ones of that plate."""

    answers: Answers
    cautious: Answers


@dataclass(frozen=True)
class Note:
    """For the log; is_final: why the estimator cannot work."""

    text: str
    is_final: bool = False


Request: TypeAlias = Start | SettledPattern | None
"""None: to save and prepare what is due."""

Reply: TypeAlias = Ready | Estimate | RefreshedAnswers | Note


def packed(message: Request | list[Reply]) -> bytes:
    """A message with its length."""
    content = pickle.dumps(message, protocol=5)
    return len(content).to_bytes(HEAD, "big") + content


def unpacked(content: bytes) -> Any:
    """The message of a pickle; raises pickle.UnpicklingError for what an amplifier could play."""
    return _Reader(io.BytesIO(content)).load()


class _Reader(pickle.Unpickler):
    """Makes nothing of `drivers`: commands pass the guard only as calls of it."""

    def find_class(self, module: str, name: str) -> Any:
        if module.partition(".")[0] == "drivers":
            raise pickle.UnpicklingError(f"{module}.{name} must not be in a message")
        return super().find_class(module, name)
