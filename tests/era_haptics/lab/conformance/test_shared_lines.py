"""Conformance on lines with other amplifiers, to which nothing is said that could change them."""

from collections import deque
from collections.abc import Callable, Mapping
from functools import partial

import pytest

from cases import shortly
from drivers.protocol.records import Values
from drivers.wires.can_frames import CanFrame, unpack_frames
from kit.judged_lines import (
    JUDGED_LINE_KINDS,
    JudgedLine,
    judged,
    varied,
)
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers

SKIPPED = {"steps_as_stated", "limited"}
REACHES_NEIGHBORS = {
    "serial": {"broadcasts", "discarded_frames"},
    "rtu": {"broadcasts", "present_areas"},
    "tcp": set(),
    "can": {"broadcasts", "network_management"},
}
"""Checks by the kind of wire that leave out requests that would reach others."""
WITHOUT_EVENTS = ("rtu", "tcp")
NEXT = 2
HIGHEST = {"serial": 247, "rtu": 247, "tcp": 247, "can": 127}
BOOT_UP, PRE_OPERATIONAL = b"\0", b"\x7f"
GATEWAY_WAITS = 1.0  # s; for a unit that is not there


class Neighbor(SimulatedAmplifier):
    """An amplifier that records its requests; identities and objects are read without."""

    def __init__(self, name: str) -> None:
        self.requests: list[str] = []
        super().__init__(name, channels=2)

    def handle(self, name: str, values: Values, now: float) -> Values:
        """Carry out a request, and record it."""
        self.requests.append(name)
        return super().handle(name, values, now)

    def restart(self, now: float) -> None:
        """Restart, and record it."""
        self.requests.append("restart")
        super().restart(now)


@pytest.fixture
def neighbors(kind: str) -> dict[int, Neighbor]:
    """Amplifiers at the next and at the highest address."""
    return {address: Neighbor(f"at {address}") for address in (NEXT, HIGHEST[kind])}


CHECKS_OF_ADDRESSES = [
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
"""Checks that send messages that others hear, or listen to them; and one that is skipped."""


@pytest.mark.parametrize("names", shortly([[], CHECKS_OF_ADDRESSES], [CHECKS_OF_ADDRESSES]))
@pytest.mark.parametrize("kind", JUDGED_LINE_KINDS)
def test_conforming_amplifier_passes_on_a_shared_line(
    kind: str,
    names: list[str],
    neighbors: dict[int, Neighbor],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its neighbors get nothing, and nodes on CAN stay out of operation, by their heartbeats."""
    sent: list[bytes] = []
    send = JudgedLine.send

    def record(line: JudgedLine, data: bytes) -> None:
        sent.append(data)
        send(line, data)

    monkeypatch.setattr(JudgedLine, "send", record)

    results = judged(kind, names, neighbors=neighbors)

    failures = {result.check.name: result.reason for result in results if result.result == "failed"}
    skipped = {result.check.name: result.reason for result in results if result.result == "skipped"}
    assert failures == {}
    expected = {"limited"} if names else SKIPPED
    if kind in WITHOUT_EVENTS:
        expected = {*expected, "events"}
    assert set(skipped) == expected | REACHES_NEIGHBORS[kind]
    addresses = ", ".join(map(str, sorted(neighbors)))
    for name in REACHES_NEIGHBORS[kind]:
        assert addresses in skipped[name]
    for address, neighbor in neighbors.items():
        assert neighbor.requests == [], address
        assert neighbor.state == "SWITCH_ON_DISABLED", address
    if kind == "can":
        frames: list[CanFrame] = [frame for data in sent for frame in unpack_frames(data)]
        heartbeats = {frame.data for frame in frames if frame.id & 127 in neighbors}
        states = {data for data in heartbeats if len(data) == 1}
        assert states <= {BOOT_UP, PRE_OPERATIONAL}


class Gateway:
    """Units behind a gateway, which requests one after the other and replies for absent ones."""

    def __init__(
        self, units: Mapping[int, SimulatedAmplifier], send: Callable[[bytes], None]
    ) -> None:
        self._units = units
        self._send = send
        self._end = ModbusAmplifiers(units, self._reply, is_rtu=False)
        self._waiting = deque[bytes]()
        self._until = 0.0
        self._has_reply = False

    def receive(self, data: bytes, now: float) -> None:
        """Take whole frames of the host at a time [s]."""
        while data:
            size = 6 + int.from_bytes(data[4:6], "big")
            self._waiting.append(data[:size])
            data = data[size:]
        self.tick(now)

    def tick(self, now: float) -> None:
        """Pass on the next frame, unless a unit has time to reply."""
        for unit in self._units.values():
            unit.tick(now)
        while self._waiting and now >= self._until:
            frame = self._waiting[0]
            self._has_reply = False
            self._end.receive(frame, now)
            if not self._has_reply and not self._until:
                self._until = now + GATEWAY_WAITS
                return
            if not self._has_reply:
                header = frame[:4] + b"\0\3"
                self._send(header + bytes([frame[6], frame[7] | 0x80, 11]))
            self._until = 0.0
            self._waiting.popleft()

    def _reply(self, data: bytes) -> None:
        self._has_reply = True
        self._send(data)


@pytest.mark.parametrize("kind", ["tcp"])
def test_units_behind_one_gateway(kind: str, neighbors: dict[int, Neighbor]) -> None:
    """The gateway replies for absent units after a second, and lets other requests wait."""
    units: dict[int, SimulatedAmplifier] = {1: varied(), **neighbors}
    names = ["identity", "obeys_in_time", "damaged_frames", "addresses"]

    results = judged(kind, names, far=partial(Gateway, units))

    assert [result.result for result in results] == ["passed"] * len(names), results
    for address, neighbor in neighbors.items():
        assert neighbor.requests == [], address
