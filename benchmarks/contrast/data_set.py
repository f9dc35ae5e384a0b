"""The data set of the contrast benchmark: plates with their rigs, and sets of fingers on them.

One JSON file, `localization-1.json` beside this module. Another version is another file.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from model.answer.stimulus import Placement
from model.arrays import Point
from model.config.document import parse_document
from model.rig.rig import Rig
from model.rig.rig_file import rig_of

VERSION = 1
CHECKSUM = "ba4469e87f93685903c0d2095d9dc62f2ae3a56c617015744030eaefa7fc4ada"
"""SHA-256 of the file of this version."""

FILE = Path(__file__).with_name(f"localization-{VERSION}.json")


@dataclass(frozen=True)
class ContactSet:
    """Fingers [m] on a plate, the target first; number: its place in the file, from 0."""

    name: str
    number: int
    contacts: tuple[Point, ...]

    @property
    def quiet_count(self) -> int:
        """Number of fingers that shall feel nothing."""
        return len(self.contacts) - 1

    @property
    def placement(self) -> Placement:
        """The target, and the others."""
        return Placement(self.contacts[:1], self.contacts[1:])


@dataclass(frozen=True, eq=False)
class BenchmarkPlate:
    """A plate of the data set, its rig, and sets of fingers on it."""

    name: str
    rig: Rig
    rig_text: str
    sets: Sequence[ContactSet]


@dataclass(frozen=True, eq=False)
class DataSet:
    """The data set.

    level_db_sl: that nine of ten plates must reach at the target; draws, seed: of held-out plates
    for each set; in_time: seeds of plates in time, by turns.
    """

    level_db_sl: float
    draws: int
    seed: int
    in_time: Sequence[int]
    plates: Mapping[str, BenchmarkPlate]


@cache
def data_set() -> DataSet:
    """Read the data set of this version."""
    document = json.loads(FILE.read_text(encoding="utf-8"))
    plates = {}
    number = 0
    for name, plate in document["plates"].items():
        sets = []
        for key, contacts in plate["sets"].items():
            sets.append(ContactSet(key, number, tuple((x, y) for x, y in contacts)))
            number += 1
        rig = rig_of(parse_document(f"{name}.yaml", plate["rig"]))
        plates[name] = BenchmarkPlate(name, rig, plate["rig"], sets)
    held_out = document["held_out"]
    return DataSet(
        document["level_db_sl"],
        held_out["draws"],
        held_out["seed"],
        held_out["seeds_in_time"],
        plates,
    )


def checksum() -> str:
    """SHA-256 of the file that `data_set` reads."""
    return hashlib.sha256(FILE.read_bytes()).hexdigest()
