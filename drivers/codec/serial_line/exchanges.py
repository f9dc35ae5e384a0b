"""Messages to frames and back, for both ends of a serial line.

Each message has a layout of two functions, pack and unpack (longer ones in `sets` and `reports`).
Decoding yields a message with every value in range or raises `Malformed`. Encoding requires sets
and envelopes that have passed a guard; decoding yields plain ones.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from drivers.codec.payload import Cursor, Malformed, pack, pack_optional_channel, pack_text
from drivers.codec.sensors import (
    pack_block,
    pack_get_block,
    pack_get_sensors,
    pack_measure,
    pack_reading,
    pack_sensors,
    unpack_block,
    unpack_get_block,
    unpack_get_reading,
    unpack_get_sensors,
    unpack_measure,
    unpack_reading,
    unpack_sensors,
)
from drivers.codec.serial_line.frame import NEUTRAL, REPLY, Frame
from drivers.codec.serial_line.reports import (
    pack_capabilities,
    pack_faults,
    pack_identity,
    pack_measured,
    pack_status,
    unpack_capabilities,
    unpack_faults,
    unpack_identity,
    unpack_measured,
    unpack_status,
)
from drivers.codec.serial_line.sets import (
    pack_achieved,
    pack_envelope,
    pack_set,
    unpack_achieved,
    unpack_envelope,
    unpack_set,
)
from drivers.guard import require_safe
from drivers.protocol.definition import PROTOCOL, WireQuantity
from drivers.protocol.messages import (
    Achieved,
    AddressSet,
    AmplifierEvent,
    AmplifierState,
    Apply,
    Arm,
    Capabilities,
    Clear,
    Commit,
    Disarm,
    Fault,
    FaultList,
    GetBlock,
    GetCaps,
    GetFaults,
    GetMeasured,
    GetReading,
    GetSensors,
    GetStatus,
    Hello,
    Identity,
    Loaded,
    LoadEnvelope,
    Measure,
    Measured,
    Nak,
    NakCode,
    Ping,
    Reading,
    Reply,
    Request,
    SampleBlock,
    SensorList,
    SetAddress,
    Stage,
    Status,
    Stop,
)

_HELLO = PROTOCOL.types["hello"]
_NAK = PROTOCOL.types["nak"]
_EVENT = PROTOCOL.types["event"]
_Q = PROTOCOL.quantities


@dataclass(frozen=True)
class _Layout:
    """Conversion between a message and its payload."""

    message: type[Any]
    pack: Callable[[Any], bytes]
    unpack: Callable[[Cursor], Any]


def _numbers(
    message: type[Any],
    *,
    read: Callable[[Cursor, WireQuantity], float] = Cursor.value,
    **quantities: WireQuantity,
) -> _Layout:
    """Return the layout of a message that consists of these numbers."""

    def pack_numbers(values: Any) -> bytes:
        return pack(*((quantity, getattr(values, name)) for name, quantity in quantities.items()))

    def unpack_numbers(cursor: Cursor) -> Any:
        return message(**{name: read(cursor, quantity) for name, quantity in quantities.items()})

    return _Layout(message, pack_numbers, unpack_numbers)


def _empty(message: type[Any]) -> _Layout:
    return _Layout(message, lambda _: b"", lambda _: message())


_IDENTITY = _Layout(Identity, pack_identity, unpack_identity)
_CAPABILITIES = _Layout(Capabilities, pack_capabilities, unpack_capabilities)
_STATUS = _Layout(Status, pack_status, unpack_status)
_ACHIEVED = _Layout(Achieved, pack_achieved, unpack_achieved)
_FAULTS = _Layout(FaultList, pack_faults, unpack_faults)
_MEASURED = _Layout(Measured, pack_measured, unpack_measured)
_READING = _Layout(Reading, pack_reading, unpack_reading)


def _set(message: type[Stage] | type[Apply]) -> _Layout:
    """Return the layout of a message with a set, after its session."""

    def pack_session_and_set(values: Any) -> bytes:
        return pack((_Q.held_session, values.session)) + pack_set(values.command_set)

    def unpack_session_and_set(cursor: Cursor) -> Any:
        session = cursor.integer(_Q.held_session)
        return message(unpack_set(cursor), session)

    return _Layout(message, pack_session_and_set, unpack_session_and_set)


_LOAD_ENVELOPE = _Layout(
    LoadEnvelope,
    lambda load: pack_envelope(load.envelope),
    lambda cursor: LoadEnvelope(unpack_envelope(cursor)),
)
_SET_ADDRESS = _Layout(
    SetAddress,
    lambda change: pack((_Q.address, change.address)) + pack_text(change.serial_number),
    lambda cursor: SetAddress(cursor.integer(_Q.address), cursor.text()),
)
_EVENT_LAYOUT = _Layout(
    AmplifierEvent,
    lambda event: bytes([event.state, event.fault]) + pack_optional_channel(event.channel),
    lambda cursor: AmplifierEvent(
        state=cursor.one_of(AmplifierState),
        fault=cursor.one_of(Fault),
        channel=cursor.optional_channel(),
    ),
)

# Request and reply of every message type.
_EXCHANGES: dict[int, tuple[_Layout, _Layout]] = {
    _HELLO: (_empty(Hello), _IDENTITY),
    PROTOCOL.types["get_caps"]: (_empty(GetCaps), _CAPABILITIES),
    PROTOCOL.types["arm"]: (
        _numbers(Arm, watchdog=_Q.watchdog, session=_Q.session),
        _STATUS,
    ),
    PROTOCOL.types["disarm"]: (_numbers(Disarm, read=Cursor.nearest, ramp=_Q.ramp), _STATUS),
    PROTOCOL.types["stage"]: (_set(Stage), _ACHIEVED),
    PROTOCOL.types["commit"]: (
        _numbers(Commit, session=_Q.held_session, token=_Q.token),
        _ACHIEVED,
    ),
    PROTOCOL.types["apply"]: (_set(Apply), _ACHIEVED),
    PROTOCOL.types["stop"]: (_numbers(Stop, read=Cursor.nearest, ramp=_Q.ramp), _STATUS),
    PROTOCOL.types["get_status"]: (_empty(GetStatus), _STATUS),
    PROTOCOL.types["get_faults"]: (_empty(GetFaults), _FAULTS),
    PROTOCOL.types["clear"]: (_numbers(Clear, latch=_Q.latch), _STATUS),
    PROTOCOL.types["ping"]: (
        _numbers(Ping, session=_Q.held_session),
        _STATUS,
    ),
    PROTOCOL.types["load_envelope"]: (
        _LOAD_ENVELOPE,
        _numbers(Loaded, slot=_Q.envelope_slot, knots=_Q.envelope_knots),
    ),
    PROTOCOL.types["get_measured"]: (_empty(GetMeasured), _MEASURED),
    PROTOCOL.types["get_sensors"]: (
        _Layout(GetSensors, pack_get_sensors, unpack_get_sensors),
        _Layout(SensorList, pack_sensors, unpack_sensors),
    ),
    PROTOCOL.types["measure"]: (_Layout(Measure, pack_measure, unpack_measure), _READING),
    PROTOCOL.types["get_reading"]: (
        _Layout(GetReading, pack_get_sensors, unpack_get_reading),
        _READING,
    ),
    PROTOCOL.types["get_block"]: (
        _Layout(GetBlock, pack_get_block, unpack_get_block),
        _Layout(SampleBlock, pack_block, unpack_block),
    ),
    PROTOCOL.types["set_address"]: (_SET_ADDRESS, _numbers(AddressSet, address=_Q.address)),
}
_TYPE_OF = {request.message: code for code, (request, _) in _EXCHANGES.items()}


def encode_request(request: Request, *, address: int, sequence: int) -> Frame:
    """Encode a request; TypeError if a set in it has not passed a guard."""
    require_safe(request)
    code = _TYPE_OF[type(request)]
    payload = _EXCHANGES[code][0].pack(request)
    return Frame(code, address, sequence, payload, _version(code))


def decode_request(frame: Frame) -> Request:
    """Decode a request; raises Malformed. A Hello may have any version and payload."""
    if frame.kind == _HELLO:
        return Hello()
    if frame.version != PROTOCOL.version:
        raise Malformed(f"version {frame.version}", code=NakCode.UNSUPPORTED_VERSION)
    if frame.is_reply or frame.type not in _EXCHANGES:
        raise Malformed(f"unknown request type {frame.kind:#04x}", code=NakCode.UNKNOWN_TYPE)
    cursor = Cursor(frame.payload)
    request: Request = _EXCHANGES[frame.type][0].unpack(cursor)
    cursor.end()
    return request


def encode_reply(reply: Reply, to: Frame) -> Frame:
    """Encode the reply to the request frame `to`; TypeError for a reply of another type."""
    if isinstance(reply, Nak):
        payload = bytes([to.type, reply.code]) + pack_optional_channel(reply.channel)
        kind = REPLY | _NAK
        version = NEUTRAL if reply.code is NakCode.UNSUPPORTED_VERSION else _version(to.type)
    else:
        layout = _EXCHANGES[to.type][1]
        if not isinstance(reply, layout.message):
            raise TypeError(f"{type(reply).__name__} is not a reply to message type {to.type}")
        payload = layout.pack(reply)
        kind, version = REPLY | to.type, _version(to.type)
    return Frame(kind, to.address, to.sequence, payload, version)


def decode_reply(frame: Frame, to: Frame) -> Reply:
    """Decode the reply to the request frame `to`, which has its sequence number.

    What follows the known fields is ignored. Raises Malformed, also for a reply to another type of
    request or of another version.
    """
    if frame.version not in (NEUTRAL, PROTOCOL.version):
        raise Malformed(
            f"version must be {PROTOCOL.version}, got {frame.version}",
            code=NakCode.UNSUPPORTED_VERSION,
        )
    if frame.kind == REPLY | _NAK:
        return _decode_nak(frame.payload, to)
    if frame.kind != REPLY | to.type:
        raise Malformed(
            f"reply to request type {to.type} has type {frame.kind:#04x}",
            code=NakCode.UNKNOWN_TYPE,
        )
    reply: Reply = _EXCHANGES[to.type][1].unpack(Cursor(frame.payload))
    return reply


def _version(code: int) -> int:
    """Return the version of the frames of a message type."""
    return NEUTRAL if code == _HELLO else PROTOCOL.version


def is_event(frame: Frame) -> bool:
    """Whether a frame is an event; its sequence number counts the amplifier's events."""
    return frame.kind == REPLY | _EVENT


def encode_event(event: AmplifierEvent, *, address: int, sequence: int) -> Frame:
    """Encode an unsolicited event."""
    payload = _EVENT_LAYOUT.pack(event)
    return Frame(kind=REPLY | _EVENT, address=address, sequence=sequence, payload=payload)


def decode_event(frame: Frame) -> AmplifierEvent:
    """Decode an event (see `is_event`); raises Malformed."""
    event: AmplifierEvent = _EVENT_LAYOUT.unpack(Cursor(frame.payload))
    return event


def _decode_nak(payload: bytes, to: Frame) -> Nak:
    cursor = Cursor(payload)
    refused = cursor.byte()
    nak = Nak(code=cursor.one_of(NakCode), channel=cursor.optional_channel())
    if refused != to.type:
        raise Malformed(
            f"reply to request type {to.type} is a refusal of type {refused}",
            code=NakCode.UNKNOWN_TYPE,
        )
    return nak
