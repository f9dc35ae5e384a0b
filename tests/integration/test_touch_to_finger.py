"""From a touch stream to what each finger felt, over every wire, by the same checks.

In virtual time, so that times are asserted as well as what is felt.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from felt_assertions import CHECKS, Truth, response_differences, rounding
from felt_chain import Chain, Played
from heard import Heard
from long_form import shortly
from model.finger.grid import Grid
from model.rig.file import load_rig
from model.table.build import build_table
from rig_files import write_rig
from touch_stream import Stream

PLACES = {
    "A": (0.07, 0.06),
    "B": (0.04, 0.17),
    "C": (0.16, 0.19),
    "D": (0.05, 0.05),
    "E": (0.24, 0.08),
    "F": (0.26, 0.11),
}
STREAM = Stream(
    PLACES,
    [
        (0.1, {1: "B", 2: "C"}),  # two at once on a plate at rest: the second is the target
        (0.8, {1: "B", 2: "C", 3: "D", 4: "E"}),  # three are to be quiet
        (1.4, {1: "B", 2: "C", 3: "D", 4: "F"}),  # the target moves by 36 mm
        (2.0, {1: "B", 2: "C", 3: "D"}),  # it lifts: the one before is the target again
        (2.6, {}),  # the last up
        (2.9, {5: "A"}),  # one finger
        (3.5, {}),
        (3.8, {}),
    ],
)
SHORT = Stream(PLACES, [*STREAM.changes[:1], (0.8, {}), (1.1, {})])
"""Stream for the other wires, since the daemon's decisions do not depend on the wire."""

# In 10 ms Modbus RTU at 115 200 baud carries some 47 words and CAN at 500 kbit/s some 109. Four
# channels with an onset and room for an ending need 38 words, and 8 more for each knot.
KNOTS = {"modbus-rtu": 1, "slcan": 8, "socketcand": 8}
WIRES = ("serial", "modbus-tcp", "modbus-rtu", "slcan", "socketcand", "sim")
SHORTLY = ("serial", "modbus-rtu", "socketcand")

SWAPPED = (
    ("amplifier: main, channel: 1", "amplifier: main, channel: 9"),
    ("amplifier: main, channel: 3", "amplifier: main, channel: 1"),
    ("amplifier: main, channel: 9", "amplifier: main, channel: 3"),
)


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    """The true rig and its table, without the chain."""
    rig = load_rig(write_rig(tmp_path_factory.mktemp("truth") / "rig.yaml", mesh="auto"))
    table = build_table(rig, frequencies=np.arange(80.0, 321.0, 40.0), grid=Grid(4, 3))
    return Truth(rig, table, STREAM)


def chain(
    truth: Truth, folder: Path, wire: str, *, wiring: Collection[tuple[str, str]] = ()
) -> Chain:
    """A chain over a wire; wiring: changes of the plate's, which the controller does not know."""
    rig_file = write_rig(folder / "rig.yaml")
    return Chain(
        load_rig(rig_file),
        truth.table,
        load_rig(write_rig(folder / "plate.yaml", *wiring)),
        None if wire == "sim" else {"main": wire},
        rig_file,
    )


@pytest.fixture(scope="module")
def played(truth: Truth, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Played]:
    """Result over a wire: of the full stream over the first, of the short one over the others."""
    folder = tmp_path_factory.mktemp("wires")

    @cache
    def over(wire: str) -> Played:
        return chain(truth, folder, wire).play(STREAM if wire == WIRES[0] else SHORT)

    return over


@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize("wire", shortly(WIRES, SHORTLY))
def test_fingers_feel_the_commanded_pattern(
    played: Callable[[str], Played], truth: Truth, wire: str, check: str
) -> None:
    """Every check passes over every wire."""
    if wire != "sim":
        assert played(wire).frames > 50
    CHECKS[check](played(wire), replace(truth, onset_knots=KNOTS.get(wire)))


def _drives(heard: Heard) -> list[Mapping[str, object]]:
    """The drive by ERA of each pattern of a situation."""
    return [pattern["drive"] for pattern in heard.patterns]


@pytest.mark.parametrize("wire", shortly(WIRES[1:], SHORTLY))
def test_plate_response_is_equal_over_all_wires(
    played: Callable[[str], Played], truth: Truth, wire: str
) -> None:
    """Responses differ at most by the rounding of levels to 1e-4 and phases to 0.01 degrees.

    All wires round alike: drives agree to the last digit. Compared while the streams are the same.
    """
    mine, yours = (replace(played(each), heard=played(each).heard[:1]) for each in (wire, WIRES[0]))
    for one, other in zip(mine.heard, yours.heard, strict=True):
        assert one.situation.fingers == other.situation.fingers
        assert _drives(one) == _drives(other)
    apart = response_differences(mine, yours)
    assert len(apart) == 1
    for share, limit in zip(apart, rounding(mine, truth), strict=True):
        assert share <= 2 * limit


def test_checks_detect_another_wiring(truth: Truth, tmp_path: Path) -> None:
    """Of a plate whose channels are swapped, those checks fail that see the plate."""
    played = chain(truth, tmp_path, "serial", wiring=SWAPPED).play(SHORT)
    failed = set()
    for name, check in CHECKS.items():
        try:
            check(played, replace(truth, stream=SHORT))
        except AssertionError:
            failed.add(name)
    assert failed >= {"plate_response_matches_model", "localization_matches_prediction"}
