"""The amplifiers' side of a CAN bus, without I/O.

Frames come and go packed (`drivers.wires.can_frames`), those of a message together.
"""

import struct
from collections.abc import Mapping

from drivers.errors import WireCounters
from drivers.protocol.definition import (
    BY_NUMBER,
    EVENT,
    EVENT_RECORD,
    FAULTS,
    HELLO,
    IDENTITY,
    NAK,
    QUANTITIES,
    nak_of,
    name_of,
    read_request,
)
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import is_earlier_part
from drivers.wires.can_frames import (
    CANOPEN,
    NODE_MAX,
    REPLY,
    REQUEST,
    Assembler,
    CanFrame,
    Message,
    cob_id,
    pack_frames,
    segments,
    unpack_frames,
)
from sim.amplifier.simulated_amplifier import SILENCING_RAMP
from sim.far_ends.can_bus.word_objects import ObjectServer
from sim.transport.far_end import AmplifierPort, FarEnd, Send

_NMT: Mapping[str, int] = CANOPEN["nmt"]
_NMT_STATES: Mapping[str, int] = CANOPEN["nmt_states"]
_OPERATIONAL, _STOPPED = _NMT_STATES["OPERATIONAL"], _NMT_STATES["STOPPED"]
_BOOT_UP, _PRE_OPERATIONAL = _NMT_STATES["BOOT_UP"], _NMT_STATES["PRE_OPERATIONAL"]
_LEADS_TO = {
    _NMT["stop"]: _STOPPED,
    **dict.fromkeys((_NMT["pre_operational"], _NMT["reset_communication"]), _PRE_OPERATIONAL),
}
"""The state in which a node no longer takes requests, by the command that leads there."""
_NMT_LENGTH = 2
_POLL = 0.05  # s; between looks whether a heartbeat is wanted again


class CanAmplifiers(FarEnd):
    """Amplifiers by their nodes on one bus; send: called with their frames."""

    def __init__(self, amplifiers: Mapping[int, AmplifierPort], send: Send) -> None:
        self._nodes = {node: _Node(amplifier, node, send) for node, amplifier in amplifiers.items()}
        self._broadcasts = Assembler(WireCounters(), is_numbered=False)

    def start(self, now: float) -> None:
        """Boot all nodes at a time [s]."""
        for node in self._nodes.values():
            node.boot(now)

    @property
    def next_event(self) -> float:
        """Time of the next heartbeat or event [s]."""
        return min(node.next_event for node in self._nodes.values())

    def tick(self, now: float) -> None:
        """Send the heartbeats and events due by now [s]."""
        for node in self._nodes.values():
            node.tick(now)

    def receive(self, data: bytes, now: float) -> None:
        """Take frames of other devices at a time [s]."""
        for frame in unpack_frames(data):
            self._receive(frame, now)

    def _receive(self, frame: CanFrame, now: float) -> None:
        number = frame.id & NODE_MAX
        node, kind = self._nodes.get(number), frame.id - number
        if frame.id == cob_id("nmt"):
            if len(frame.data) == _NMT_LENGTH:
                for each in self._nodes.values():
                    if frame.data[1] in (0, each.number):
                        each.command(frame.data[0], now)
        elif frame.id == REQUEST:
            if (message := self._broadcasts.add(frame.data, now)) is not None:
                self._broadcast(message, now)
        elif node is not None and kind == REQUEST:
            node.request(frame.data, now)
            self._note_numbers()
        elif node is not None and kind == cob_id("sdo_request"):
            node.read(frame.data, now)

    def _broadcast(self, message: Message, now: float) -> None:
        known = BY_NUMBER.get(message.type)
        if known is not None and known.is_broadcast:
            for node in self._nodes.values():
                if node.is_listening:
                    node.carry_out(message, now)
            self._note_numbers()

    def _note_numbers(self) -> None:
        """Note the numbers of nodes, which may have taken others."""
        self._nodes = {node.number: node for node in self._nodes.values()}


class _Node:
    """An amplifier at a node number."""

    def __init__(self, amplifier: AmplifierPort, number: int, send: Send) -> None:
        self._amplifier = amplifier
        self._send = send
        self.number = number
        self._was_faulty = False
        self._heartbeat_due = 0.0
        self._reset()
        amplifier.listeners.append(self._tell)

    def _reset(self) -> None:
        self._state = _PRE_OPERATIONAL
        self._requests = Assembler(WireCounters())
        self._objects = ObjectServer(self._amplifier, self.number)

    @property
    def is_listening(self) -> bool:
        """Whether it takes requests."""
        return self._state == _OPERATIONAL and self._amplifier.is_answering

    @property
    def next_event(self) -> float:
        """Time of the next heartbeat or event [s]."""
        return min(self._heartbeat_due, self._amplifier.next_event)

    def tick(self, now: float) -> None:
        """Send what is due by now."""
        self._amplifier.tick(now)
        while self._heartbeat_due <= now:
            interval = self._objects.heartbeat
            if interval and self._amplifier.is_answering:
                self._put(cob_id("heartbeat", self.number), bytes([self._state]))
            self._heartbeat_due += interval / 1000 if interval else _POLL

    def boot(self, now: float) -> None:
        """Begin anew, not operational; what the amplifier plays is its own."""
        self._reset()
        self._put(cob_id("heartbeat", self.number), bytes([_BOOT_UP]))
        self._heartbeat_due = now + self._objects.heartbeat / 1000

    def command(self, command: int, now: float) -> None:
        """Take a command of network management."""
        if not self._amplifier.is_answering:
            return
        if command == _NMT["start"]:
            self._state = _OPERATIONAL
        elif command == _NMT["reset_node"]:
            self._amplifier.restart(now)
        elif command in _LEADS_TO:
            self._leave(_LEADS_TO[command], now)
        if command in (_NMT["reset_node"], _NMT["reset_communication"]):
            self.boot(now)

    def read(self, data: bytes, now: float) -> None:
        """Take a frame to the objects."""
        is_served = self._state != _STOPPED and self._amplifier.is_answering
        if is_served and (reply := self._objects.reply(data, now)):
            self._put(cob_id("sdo_answer", self.number), reply)

    def request(self, data: bytes, now: float) -> None:
        """Take a frame of a request, and carry out the message that it completes."""
        if self.is_listening and (message := self._requests.add(data, now)) is not None:
            self.carry_out(message, now)

    def carry_out(self, message: Message, now: float) -> None:
        """Carry out a message; one without a number has no reply, nor a part of a set."""
        sender = self.number
        try:
            kind, words = message.type, self._words(message, now)
        except Refusal as refusal:
            has_reply = message.number and not is_earlier_part(message.type, message.words)
            kind, words = NAK, nak_of(refusal, message.type) if has_reply else []
        if words:
            self._put(REPLY + sender, *segments(message.number, kind, words))
        if self.number != sender:
            self.boot(now)

    def _words(self, message: Message, now: float) -> list[int]:
        """Carry out a request; returns the words of its reply, if any. Raises Refusal."""
        if message.type == HELLO:
            return IDENTITY.pack(self._amplifier.identity)
        name, values = read_request(message.type, message.words)
        if name == "SetAddress" and values["address"] > NODE_MAX:
            raise Refusal(f"address must be 1 to {NODE_MAX}, got {values['address']}")
        reply = self._amplifier.handle(name, values, now)
        if not message.number:
            self._amplifier.withdraw_status()
            reply = {}
        if name == "SetAddress":
            self.number = values["address"]
        return BY_NUMBER[message.type].reply.pack(reply) if reply else []

    def _leave(self, state: int, now: float) -> None:
        """Stop what plays, then leave the state in which there are requests."""
        if self._amplifier.state == "OPERATION_ENABLED":
            ramp = QUANTITIES["ramp"].to_wire(SILENCING_RAMP)
            self._amplifier.handle("Stop", {"ramp": ramp}, now)
        self._state = state

    def _tell(self, event: Values, now: float) -> None:
        """Send an event, with an emergency where a fault comes or goes."""
        if self.is_listening:
            self._put(REPLY + self.number, *segments(0, EVENT, EVENT_RECORD.pack(event)))
        fault = name_of(FAULTS, event["fault"])
        is_faulty = fault != "NONE"
        is_mute = self._state == _STOPPED or not self._amplifier.is_answering
        if (is_faulty or self._was_faulty) and not is_mute:
            known = CANOPEN["emergencies"][fault]
            state = event["state"] | event["fault"] << 4
            head = (known["code"], known["error_register"], state, event["channel"])
            self._put(cob_id("emergency", self.number), struct.pack("<HBBB3x", *head))
        self._was_faulty = is_faulty

    def _put(self, can_id: int, *data: bytes) -> None:
        """Send frames of one identifier."""
        self._send(pack_frames(CanFrame(can_id, each) for each in data))
