"""Simulated amplifiers as CANopen nodes, without I/O: frames in, frames out.

A node obeys network management (NMT), takes requests while it is operational, sends heartbeats, and
an emergency object with the event of a fault. Its objects are in `sim.far_ends.canopen_objects`.
Frames are packed (`drivers.wires.can_frames`), all frames of a message together.
"""

import struct
from collections.abc import Mapping

from drivers.errors import WireCounters
from drivers.protocol.definition import (
    EVENT,
    EVENT_RECORD,
    FAULTS,
    MESSAGES,
    QUANTITIES,
    name_of,
)
from drivers.protocol.records import Values
from drivers.wires.can_frames import (
    CANOPEN,
    NODE_MAX,
    REPLY,
    REQUEST,
    Assembler,
    CanFrame,
    cob_id,
    pack_frames,
    segments,
    unpack_frames,
)
from sim.amplifier.simulated_amplifier import SILENCING_RAMP
from sim.far_ends.canopen_objects import ObjectServer
from sim.transport.far_end import AmplifierPort, FarEnd, SendBytes, carry_out

_NMT: Mapping[str, int] = CANOPEN["nmt"]
_NMT_STATES: Mapping[str, int] = CANOPEN["nmt_states"]
_OPERATIONAL = _NMT_STATES["OPERATIONAL"]
_STOPPED = _NMT_STATES["STOPPED"]
_BOOT_UP = _NMT_STATES["BOOT_UP"]
_PRE_OPERATIONAL = _NMT_STATES["PRE_OPERATIONAL"]
_STATE_AFTER = {
    _NMT["stop"]: _STOPPED,
    _NMT["pre_operational"]: _PRE_OPERATIONAL,
    _NMT["reset_communication"]: _PRE_OPERATIONAL,
}
"""The state of a node after a command by which it no longer accepts requests."""
_NMT_LENGTH = 2
_SET_ADDRESS = MESSAGES["SetAddress"].number
_POLL = 0.05  # s; between checks whether the heartbeat has been switched on again


class CanAmplifiers(FarEnd):
    """Amplifiers by node on one bus; send: called with their frames."""

    def __init__(self, amplifiers: Mapping[int, AmplifierPort], send: SendBytes) -> None:
        self._nodes = [_Node(amplifier, node, send) for node, amplifier in amplifiers.items()]

    def start(self, now: float) -> None:
        """Boot all nodes at a time [s]."""
        for node in self._nodes:
            node.boot(now)

    def close(self) -> None:
        """Send no more events."""
        for node in self._nodes:
            node.close()

    @property
    def next_event(self) -> float:
        """Time of the next heartbeat or event [s]."""
        return min(node.next_event for node in self._nodes)

    def tick(self, now: float) -> None:
        """Send the heartbeats and events due at now [s]."""
        for node in self._nodes:
            node.tick(now)

    def receive(self, data: bytes, now: float) -> None:
        """Take frames of other devices at a time [s]."""
        for frame in unpack_frames(data):
            for node in self._nodes:
                node.take(frame, now)


class _Node:
    """An amplifier at a node number."""

    def __init__(self, amplifier: AmplifierPort, number: int, send: SendBytes) -> None:
        self._amplifier = amplifier
        self._send = send
        self._number = number
        self._was_faulty = False
        self._heartbeat_due = 0.0
        self._reset()
        amplifier.listeners.append(self._send_event)

    def close(self) -> None:
        """Send no more events."""
        self._amplifier.listeners.remove(self._send_event)

    def _reset(self) -> None:
        self._state = _PRE_OPERATIONAL
        self._requests = {
            REQUEST: Assembler(WireCounters(), is_numbered=False),
            REQUEST + self._number: Assembler(WireCounters()),
        }
        self._objects = ObjectServer(self._amplifier, self._number)

    @property
    def next_event(self) -> float:
        """Time of the next heartbeat or event [s]."""
        return min(self._heartbeat_due, self._amplifier.next_event)

    def tick(self, now: float) -> None:
        """Send everything due at now."""
        self._amplifier.tick(now)
        while self._heartbeat_due <= now:
            interval = self._objects.heartbeat
            if interval and self._amplifier.is_answering:
                self._put(cob_id("heartbeat", self._number), bytes([self._state]))
            self._heartbeat_due += interval / 1000 if interval else _POLL

    def boot(self, now: float) -> None:
        """Restart, not operational; the amplifier's playback is not affected."""
        self._reset()
        self._put(cob_id("heartbeat", self._number), bytes([_BOOT_UP]))
        self._heartbeat_due = now + self._objects.heartbeat / 1000

    def take(self, frame: CanFrame, now: float) -> None:
        """Take a frame of another device; a message without a node number is for all nodes."""
        if not self._amplifier.is_answering:
            return
        data = frame.data
        if frame.id == cob_id("nmt"):
            if len(data) == _NMT_LENGTH and data[1] in (0, self._number):
                self._command(data[0], now)
        elif frame.id == cob_id("sdo_request", self._number):
            if self._state != _STOPPED:
                self._serve_object(data, now)
        elif self._state == _OPERATIONAL and frame.id in self._requests:
            self._take_request(self._requests[frame.id], data, now)

    def _serve_object(self, data: bytes, now: float) -> None:
        """Reply to a request of SDO."""
        reply = self._objects.reply(data, now)
        if reply:
            self._put(cob_id("sdo_answer", self._number), reply)

    def _take_request(self, requests: Assembler, data: bytes, now: float) -> None:
        """Take a segment of a request, carry out the request if complete, and reply."""
        message = requests.add(data, now)
        if message is None:
            return
        number, kind, words = message
        reply_kind, reply_words = carry_out(
            self._amplifier, kind, words, now, is_for_all=not number, address_max=NODE_MAX
        )
        node = self._number
        if number and reply_words:
            self._put(REPLY + node, *segments(number, reply_kind, reply_words))
        if reply_kind == _SET_ADDRESS:  # it was not refused
            self._number = words[0]
        if self._number != node:
            self.boot(now)

    def _command(self, command: int, now: float) -> None:
        """Take a command of network management."""
        if command == _NMT["start"]:
            self._state = _OPERATIONAL
        elif command == _NMT["reset_node"]:
            self._amplifier.restart(now)
        elif command in _STATE_AFTER:
            self._stop_playback(now)
            self._state = _STATE_AFTER[command]
        if command in (_NMT["reset_node"], _NMT["reset_communication"]):
            self.boot(now)

    def _stop_playback(self, now: float) -> None:
        """Stop the amplifier if it is armed, since it will take no further requests."""
        if self._amplifier.state == "OPERATION_ENABLED":
            ramp = QUANTITIES["ramp"].to_wire(SILENCING_RAMP)
            self._amplifier.handle("Stop", {"ramp": ramp}, now)

    def _send_event(self, event: Values, now: float) -> None:
        """Send an event, with an emergency message if a fault starts or ends."""
        is_answering = self._amplifier.is_answering
        if is_answering and self._state == _OPERATIONAL:
            self._put(REPLY + self._number, *segments(0, EVENT, EVENT_RECORD.pack(event)))
        fault = name_of(FAULTS, event["fault"])
        is_faulty = fault != "NONE"
        if (is_faulty or self._was_faulty) and is_answering and self._state != _STOPPED:
            emergency = CANOPEN["emergencies"][fault]
            state_and_fault = event["state"] | event["fault"] << 4
            data = struct.pack(
                "<HBBB3x",
                emergency["code"],
                emergency["error_register"],
                state_and_fault,
                event["channel"],
            )
            self._put(cob_id("emergency", self._number), data)
        self._was_faulty = is_faulty

    def _put(self, can_id: int, *data: bytes) -> None:
        """Send frames with an identifier."""
        self._send(pack_frames([CanFrame(can_id, frame_data) for frame_data in data]))
