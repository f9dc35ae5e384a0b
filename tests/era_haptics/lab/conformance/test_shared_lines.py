"""Conformance on lines with other amplifiers, to which nothing is said that could change them."""

from collections.abc import Callable, Mapping
from functools import partial

import pytest

from cases import shortly
from drivers.protocol.records import Values
from drivers.wires.can_frames import unpack_frames
from kit.clock import JUDGED_LINE_KINDS, JudgedLine, judged, varied
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers

SKIPPED = {"steps_as_stated", "limited"}
FOR_ALL = {
    "serial": {"broadcasts", "discarded_frames"},
    "rtu": {"broadcasts", "present_areas", "events"},
    "tcp": {"events"},
    "can": {"broadcasts", "network_management"},
}
"""Checks by the kind of wire that leave out what would reach others, or have no Events."""
NEXT, HIGHEST, PRE_OPERATIONAL = 2, {"can": 127}, 127
GATEWAY_WAITS = 1.0  # s; for a unit that is not there


class Neighbor(SimulatedAmplifier):
    """An amplifier that notes what it is asked to do; identities and objects are read without."""

    def __init__(self, name: str) -> None:
        self.got: list[str] = []
        super().__init__(name, channels=2)

    def handle(self, name: str, values: Values, now: float) -> Values:
        """Carry out a request, and note it."""
        self.got.append(name)
        return super().handle(name, values, now)

    def restart(self, now: float) -> None:
        """Begin anew, and note it."""
        self.got.append("restart")
        super().restart(now)


def neighbors_of(kind: str) -> dict[int, Neighbor]:
    """Return amplifiers at the next and at the highest address."""
    return {each: Neighbor(f"at {each}") for each in (NEXT, HIGHEST.get(kind, 247))}


OTHER_ADDRESSES = [
    "damaged_frames",
    "doubled_frames",
    "broadcasts",
    "present_areas",
    "events",
    "addresses",
    "network_management",
    "exceptions",
    "limited",
    "discarded_frames",
]
"""Checks that send what others hear, or listen to what all may say; and one that is skipped."""


@pytest.mark.parametrize("names", shortly([[], OTHER_ADDRESSES], [OTHER_ADDRESSES]))
@pytest.mark.parametrize("kind", JUDGED_LINE_KINDS)
def test_conforming_amplifier_passes_on_a_shared_line(
    kind: str, names: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its neighbors get nothing, and nodes on CAN stay out of operation, by their heartbeats."""
    others, beats, send = neighbors_of(kind), set[bytes](), JudgedLine.send

    def heard(line: JudgedLine, data: bytes) -> None:
        if kind == "can":
            frames = unpack_frames(data)
            beats.update(each.data for each in frames if each.id & 127 in others)
        send(line, data)

    monkeypatch.setattr(JudgedLine, "send", heard)
    results = judged(kind, names, neighbors=others)
    failed = [f"{each.check.name}: {each.reason}" for each in results if each.result == "failed"]
    assert not failed, failed
    skipped = {each.check.name: each.reason for each in results if each.result == "skipped"}
    assert skipped.keys() == ({"limited"} if names else SKIPPED) | FOR_ALL[kind]
    where = ", ".join(map(str, sorted(others)))
    assert all(where in skipped[name] for name in FOR_ALL[kind] - {"events"})
    assert [each.got for each in others.values()] == [[], []]
    assert {each.state for each in others.values()} == {"SWITCH_ON_DISABLED"}
    assert {each for each in beats if len(each) == 1} <= {b"\0", bytes([PRE_OPERATIONAL])}


class Gateway:
    """Units behind a gateway: it asks one after the other, and replies for those that do not."""

    def __init__(
        self, units: Mapping[int, SimulatedAmplifier], send: Callable[[bytes], None]
    ) -> None:
        self._units, self._send = units, send
        self._end = ModbusAmplifiers(units, self._replied, is_rtu=False)
        self._waiting: list[bytes] = []
        self._until = 0.0

    def receive(self, data: bytes, now: float) -> None:
        """Take whole frames of the host at a time [s]."""
        while data:
            size = 6 + int.from_bytes(data[4:6], "big")
            self._waiting.append(data[:size])
            data = data[size:]
        self.tick(now)

    def tick(self, now: float) -> None:
        """Ask for what waits, unless a unit is still awaited."""
        for each in self._units.values():
            each.tick(now)
        while self._waiting and now >= self._until:
            frame = self._waiting[0]
            self._is_replied = False
            self._end.receive(frame, now)
            if not self._is_replied and not self._until:
                self._until = now + GATEWAY_WAITS
                return
            if not self._is_replied:
                self._send(frame[:4] + b"\0\3" + bytes([frame[6], frame[7] | 0x80, 11]))
            self._until = 0.0
            del self._waiting[0]

    def _replied(self, data: bytes) -> None:
        self._is_replied = True
        self._send(data)


def test_units_behind_one_gateway() -> None:
    """The gateway replies for absent units after a second, and lets what comes behind wait."""
    others = neighbors_of("tcp")
    units: dict[int, SimulatedAmplifier] = {1: varied(), **others}
    names = ["identity", "obeys_in_time", "damaged_frames", "addresses"]
    results = judged("tcp", names, far=partial(Gateway, units))
    assert [each.result for each in results] == ["passed"] * len(names), results
    assert [each.got for each in others.values()] == [[], []]
