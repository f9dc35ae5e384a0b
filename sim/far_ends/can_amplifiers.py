"""The amplifiers' side of CAN: CANopen nodes on a bus within this process, and adapters to it.

Objects of a node are read and written by SDO (CiA 301). 2000 has the identity: four texts, then the
versions. 2001 and 2002 have the words of the replies to GetCaps and GetStatus, one per subindex.
Uploads are expedited or segmented, downloads expedited; no object that can be written is longer
than four bytes. Far ends exchange packed frames (`drivers.wires.can_frames`), all frames of a
message together.

All other members of the bus receive a frame simultaneously. Not modelled: arbitration,
retransmission, bus-off.

Adapters use LAWICEL's serial ASCII commands (slcan), which end with CR and are acknowledged with
CR, or BELL for errors, and socketcand over TCP, with elements `< ... >`. Acceptance masks, time
stamps and polling are accepted without effect. Not modelled: modes other than raw mode, extended
identifiers, discovery by broadcast.
"""

import asyncio
import re
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence

from drivers.errors import WireCounters
from drivers.protocol.definition import (
    EVENT,
    EVENT_RECORD,
    FAULTS,
    MESSAGES,
    QUANTITIES,
    TEXTS,
    name_of,
)
from drivers.protocol.records import Values
from drivers.wires.can_frames import (
    BLOCK,
    CANOPEN,
    NODE_MAX,
    REPLY,
    REQUEST,
    SLCAN,
    SOCKETCAND,
    Assembler,
    CanFrame,
    cob_id,
    pack_frames,
    segments,
    unpack_frames,
)
from registry import threads
from sim.amplifier.simulated_amplifier import SILENCING_RAMP
from sim.bench.amplifier_device import AmplifierDevice
from sim.transport.far_end import AmplifierPort, FarEnd, SendBytes, TimedFarEnd, carry_out
from sim.transport.simulated_line import TwoWayLine

TOGGLE = 0x0503_0000
UNKNOWN_COMMAND = 0x0504_0001
READ_ONLY = 0x0601_0002
NO_OBJECT = 0x0602_0000
BAD_LENGTH = 0x0607_0010
NO_SUBINDEX = 0x0609_0011
_DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = 1, 2, 3, 4  # in the highest three bits
_EXPEDITED = 2


class SdoAbort(Exception):
    """Aborts a transfer with a code, its only argument."""


_NAMES = {index: name for name, index in CANOPEN["objects"].items()}
"""Object by index."""


class ObjectServer:
    """The objects of an amplifier at a node, served to one client.

    heartbeat: its interval [ms], 0 for none; the one object that can be written.
    """

    def __init__(self, amplifier: AmplifierPort, node: int) -> None:
        self._amplifier = amplifier
        self._node = node
        self.heartbeat: int = CANOPEN["heartbeat_ms"]
        self._object = (0, 0)  # index and subindex of the transfer
        self._unsent: bytes | None = None  # end of a segmented upload
        self._toggle = 0

    def reply(self, data: bytes, now: float) -> bytes:
        """Return the reply to a request at a time [s]; empty if the frame has not eight bytes."""
        if len(data) != BLOCK:
            return b""
        try:
            return self._carry_out(data, now)
        except SdoAbort as abort:
            self._unsent = None
            return struct.pack("<BHBL", 0x80, *self._object, *abort.args)

    def _carry_out(self, data: bytes, now: float) -> bytes:
        """Return the reply to a request of eight bytes, empty to an abort; raises SdoAbort."""
        command = data[0] >> 5
        if command in (_DOWNLOAD, _UPLOAD):
            self._unsent = None
            self._object = struct.unpack_from("<HB", data, 1)
        if command == _DOWNLOAD and data[0] & _EXPEDITED:
            return self._download(data, now)
        if command == _UPLOAD:
            return self._begin_upload(now)
        if command == _UPLOAD_SEGMENT and self._unsent is not None:
            return self._upload_segment(self._unsent, data[0] >> 4 & 1)
        if command != _ABORT:
            raise SdoAbort(UNKNOWN_COMMAND)
        self._unsent = None
        return b""

    def _download(self, data: bytes, now: float) -> bytes:
        length = 4
        if data[0] & 1:  # the length is given
            length -= data[0] >> 2 & 3
        self._write(*self._object, data[4 : 4 + length], now)
        return struct.pack("<BHB4x", 0x60, *self._object)

    def _begin_upload(self, now: float) -> bytes:
        value = self.read(*self._object, now)
        if 1 <= len(value) <= 4:
            command = 0x43 | (4 - len(value)) << 2
            return struct.pack("<BHB4s", command, *self._object, value)
        self._unsent = value
        self._toggle = 0
        return struct.pack("<BHBL", 0x41, *self._object, len(value))

    def _upload_segment(self, unsent: bytes, toggle: int) -> bytes:
        if toggle != self._toggle:
            raise SdoAbort(TOGGLE)
        segment = unsent[:7]
        is_last = len(unsent) <= 7
        self._toggle ^= 1
        self._unsent = None if is_last else unsent[7:]
        command = toggle << 4 | (7 - len(segment)) << 1 | is_last
        return struct.pack("<B7s", command, segment)

    def read(self, index: int, subindex: int, now: float) -> bytes:
        """Read an object at a time [s]; raises SdoAbort."""
        entries = self._entries(index, now)
        if subindex >= len(entries):
            raise SdoAbort(NO_SUBINDEX)
        return entries[subindex]

    def _write(self, index: int, subindex: int, data: bytes, now: float) -> None:
        self.read(index, subindex, now)
        if _NAMES[index] != "heartbeat_producer":
            raise SdoAbort(READ_ONLY)
        if len(data) != 2:
            raise SdoAbort(BAD_LENGTH)
        self.heartbeat = int.from_bytes(data, "little")

    def _entries(self, index: int, now: float) -> list[bytes]:
        """Return the subindices of an object: its value, or their number and then the values."""
        value = self._value(index, now)
        if isinstance(value, list):
            return [bytes([len(value)]), *value]
        return [value]

    def _value(self, index: int, now: float) -> bytes | list[bytes]:
        """Return an object without subindices, or a list of its subindices from 1 on."""
        identity = self._amplifier.identity
        match _NAMES.get(index):
            case "device_type":
                return _u32(CANOPEN["device_type"])
            case "error_register":
                return bytes([CANOPEN["emergencies"][self._amplifier.fault]["error_register"]])
            case "emergency_cob_id":
                return _u32(cob_id("emergency", self._node))
            case "heartbeat_producer":
                return self.heartbeat.to_bytes(2, "little")
            case "identity":
                serial_number = zlib.crc32(identity["serial_number"].encode())
                return [
                    _u32(CANOPEN["vendor_id"]),
                    _u32(CANOPEN["product_code"]),
                    _u32(CANOPEN["revision"]),
                    _u32(serial_number),
                ]
            case "texts":
                texts = [identity[field.name].encode() for field in TEXTS]
                return [*texts, identity["versions"].to_bytes(2, "little")]
            case "capabilities":
                return self._words("GetCaps", now)
            case "status":
                return self._words("GetStatus", now)
        raise SdoAbort(NO_OBJECT)

    def _words(self, name: str, now: float) -> list[bytes]:
        reply = self._amplifier.handle(name, {}, now)
        return [word.to_bytes(2, "little") for word in MESSAGES[name].reply.pack(reply)]


def _u32(value: int) -> bytes:
    return struct.pack("<L", value)


_NMT: Mapping[str, int] = CANOPEN["nmt"]
_NMT_STATES: Mapping[str, int] = CANOPEN["nmt_states"]
_OPERATIONAL = _NMT_STATES["OPERATIONAL"]
_STOPPED = _NMT_STATES["STOPPED"]
_BOOT_UP = _NMT_STATES["BOOT_UP"]
_PRE_OPERATIONAL = _NMT_STATES["PRE_OPERATIONAL"]
_LEADS_TO = {
    _NMT["stop"]: _STOPPED,
    **dict.fromkeys((_NMT["pre_operational"], _NMT["reset_communication"]), _PRE_OPERATIONAL),
}
"""The state in which a node no longer accepts requests, by the command that leads there."""
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
        kind, reply_words = carry_out(
            self._amplifier, kind, words, now, is_for_all=not number, address_max=NODE_MAX
        )
        node = self._number
        if number and reply_words:
            self._put(REPLY + node, *segments(number, kind, reply_words))
        if kind == _SET_ADDRESS:
            self._number = words[0]
        if self._number != node:
            self.boot(now)

    def _command(self, command: int, now: float) -> None:
        """Take a command of network management."""
        if command == _NMT["start"]:
            self._state = _OPERATIONAL
        elif command == _NMT["reset_node"]:
            self._amplifier.restart(now)
        elif command in _LEADS_TO:
            self._leave(_LEADS_TO[command], now)
        if command in (_NMT["reset_node"], _NMT["reset_communication"]):
            self.boot(now)

    def _leave(self, state: int, now: float) -> None:
        """Stop playback, then leave the state that accepts requests."""
        if self._amplifier.state == "OPERATION_ENABLED":
            ramp = QUANTITIES["ramp"].to_wire(SILENCING_RAMP)
            self._amplifier.handle("Stop", {"ramp": ramp}, now)
        self._state = state

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


Listener = Callable[[CanFrame], None]

_OVERHEAD = 8  # approximate bytes of a frame in addition to its data, with stuffing and gap


class CanBus:
    """A bus; each member is identified by a listener.

    bitrate [bit/s]: None for no transmission time.
    """

    def __init__(self, bitrate: int | None = None) -> None:
        self._members: list[Listener] = []
        self._bitrate = bitrate
        self._free_from = 0.0
        self._in_flight: set[asyncio.TimerHandle] = set()

    def join(self, listener: Listener) -> None:
        """Add a member."""
        self._members.append(listener)

    def leave(self, listener: Listener) -> None:
        """Remove a member, if it is one."""
        if listener in self._members:
            self._members.remove(listener)

    def send(self, frame: CanFrame, *, sender: Listener) -> None:
        """Deliver a frame to all but its sender, after the frames that were sent before."""
        if self._bitrate is None:
            self._deliver(frame, sender)
            return

        def arrive() -> None:
            self._in_flight.discard(timer)
            self._deliver(frame, sender)

        bits = 8 * (_OVERHEAD + len(frame.data))
        self._free_from = max(threads.now(), self._free_from) + bits / self._bitrate
        timer = asyncio.get_running_loop().call_at(self._free_from, arrive)
        self._in_flight.add(timer)

    def close(self) -> None:
        """Discard the frames in flight."""
        for timer in self._in_flight:
            timer.cancel()
        self._in_flight.clear()

    def _deliver(self, frame: CanFrame, sender: Listener) -> None:
        for member in tuple(self._members):
            if member != sender:
                member(frame)


class BusNodes:
    """Amplifiers on a bus, each at the node of its number, with its own faults in each direction.

    A damaged frame fails its CRC and is dropped. All amplifiers receive a frame at the same time,
    regardless of the time that the simulation needs.
    """

    def __init__(self, bus: CanBus, devices: Sequence[AmplifierDevice]) -> None:
        self._bus = bus
        self._nodes = [self._connect(device) for device in devices]
        bus.join(self._hear)

    def close(self) -> None:
        """Leave the bus and discard frames in flight."""
        self._bus.leave(self._hear)
        for line, served in self._nodes:
            line.close()
            served.close()

    def _hear(self, frame: CanFrame) -> None:
        now = threads.now()
        for line, _ in self._nodes:
            line.inward.send(pack_frames([frame]), now)

    def _leave(self, data: bytes) -> None:
        for frame in unpack_frames(data):
            self._bus.send(frame, sender=self._hear)

    def _connect(self, device: AmplifierDevice) -> tuple[TwoWayLine, TimedFarEnd]:
        def send(frames: bytes) -> None:
            for frame in unpack_frames(frames):
                line.outward.send(pack_frames([frame]))

        def boot() -> None:
            end.start(threads.now())
            served.schedule()

        line = TwoWayLine(
            to_amplifier=lambda data, now: served.receive(data, now),
            to_host=self._leave,
            faults=device.faults,
            finds_damage=True,
        )
        end = CanAmplifiers({device.address: device}, send)
        served = TimedFarEnd(end)
        device.boot_listeners.append(boot)
        boot()
        return line, served


_CR, _BELL = b"\r", b"\x07"
_MAX_LENGTH = 64  # characters; a frame has 21
_REMOTE = re.compile(rb"r[0-7][0-9A-Fa-f]{2}[0-8]|R[01][0-9A-Fa-f]{7}[0-8]")
_EXTENDED = re.compile(rb"T[01][0-9A-Fa-f]{7}[0-8](?:[0-9A-Fa-f]{2})*")
_SETTING = re.compile(rb"S[0-9]|s[0-9A-Fa-f]{4,6}|Y[0-9]|[Mm][0-9A-Fa-f]{8}|[ZX][01]|W[0-9]|")


class SlcanAdapter(FarEnd):
    """The adapter: text in, `send` called with text, frames to and from a bus."""

    def __init__(self, bus: CanBus, send: SendBytes) -> None:
        self._bus = bus
        self._send = send
        self._unfinished = b""
        self._is_open = False
        self._may_send = False
        bus.join(self._hear)

    def close(self) -> None:
        """Leave the bus."""
        self._bus.leave(self._hear)

    def receive(self, data: bytes, now: float) -> None:
        """Process text from the host."""
        *lines, self._unfinished = (self._unfinished + data).split(_CR)
        for line in lines:
            self._send(self._reply(line.strip(b"\n")))
        if len(self._unfinished) > _MAX_LENGTH:
            self._unfinished = b""
            self._send(_BELL)

    def _reply(self, line: bytes) -> bytes:
        match line:
            case b"O" | b"L" if not self._is_open:
                self._is_open = True
                self._may_send = line == b"O"
                return _CR
            case b"C":  # also when closed: hosts begin with it
                self._is_open = False
                return _CR
            case b"V" | b"v":
                return line + b"1013" + _CR
            case b"N":
                return b"NE0A1" + _CR
            case b"F" if self._is_open:
                return b"F00" + _CR
        if self._is_open and self._may_send:
            if _REMOTE.fullmatch(line) or _EXTENDED.fullmatch(line):
                return (b"z" if line[:1] == b"r" else b"Z") + _CR  # no receiver for these
            frame = SLCAN.decode(line)
            if frame:
                self._bus.send(frame, sender=self._hear)
                return b"z" + _CR
        if not self._is_open and _SETTING.fullmatch(line):
            return _CR
        return _BELL

    def _hear(self, frame: CanFrame) -> None:
        if self._is_open:
            self._send(SLCAN.encode(frame))


BUS_NAME = "can0"
_MAX_ELEMENT = 512  # characters of an element


class SocketcandClient(FarEnd):
    """One connection, through the states new, open and raw."""

    def __init__(self, bus: CanBus, send: SendBytes) -> None:
        self._bus = bus
        self._send = send
        self._unfinished = b""
        self._is_open = False
        self._is_raw = False
        send(b"< hi >")

    def close(self) -> None:
        """Leave the bus."""
        self._bus.leave(self._hear)

    def receive(self, data: bytes, now: float) -> None:
        """Process complete elements; text between them is skipped."""
        *elements, unfinished = (self._unfinished + data).split(b">")
        self._unfinished = unfinished if len(unfinished) <= _MAX_ELEMENT else b""
        for element in elements:
            _, bracket, content = element.partition(b"<")
            if bracket:
                self._element(content.strip())

    def _element(self, element: bytes) -> None:
        match element:
            case _ if not self._is_open:
                self._is_open = element == f"open {BUS_NAME}".encode()
                self._send(b"< ok >" if self._is_open else b"< error could not open bus >")
                if not self._is_open:
                    self._send(b"")
            case b"rawmode":
                self._send(b"< ok >")
                if not self._is_raw:
                    self._is_raw = True
                    self._bus.join(self._hear)
            case b"echo":
                self._send(b"< echo >")
            case _ if element.startswith(b"send "):
                frame = SOCKETCAND.decode_sent(b"<" + element)
                if frame:  # otherwise socketcand does not reply, either
                    self._bus.send(frame, sender=self._hear)
            case _:
                self._send(b"< error unknown command >")

    def _hear(self, frame: CanFrame) -> None:
        stamp = f"{threads.now():.6f}"  # only differences are meaningful
        self._send(f"< frame {frame.id:03X} {stamp} {frame.data.hex().upper()} >".encode())
