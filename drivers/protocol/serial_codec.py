"""Messages to frames and back, for both ends of a serial line.

Each message has its layout written down once as a pair of functions, pack and unpack. Decoding is
total: any payload becomes a message with every value in range, or `Malformed`. Encoding a set or
an envelope asks for what a guard made of it; decoding gives the plain one, which must pass a guard
before it can be sent on.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.guard import SafeCommand, SafeEnvelope
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Achieved,
    Apply,
    Arm,
    Capabilities,
    Clear,
    Commit,
    Disarm,
    Event,
    Fault,
    FaultList,
    FaultRecord,
    GetCaps,
    GetFaults,
    GetStatus,
    Hello,
    Identity,
    Loaded,
    LoadEnvelope,
    Nak,
    NakCode,
    Ping,
    Reply,
    Request,
    Stage,
    State,
    Status,
    Stop,
)
from drivers.protocol.payload import Cursor, Malformed, pack, pack_optional_channel, pack_text
from drivers.protocol.serial_frame import REPLY, Frame

_NAK = PROTOCOL.types["nak"]
_EVENT = PROTOCOL.types["event"]
_Q = PROTOCOL.quantities
_KEEP_PHASE = 0x01
_SKIP_ENDING = 0x02
_ENVELOPES = 0x04  # onset and ending follow the command
_HIGH_VOLTAGE = 0x01
_EVENTS = 0x01


def _pack_commands(commands: tuple[DriveCommand, ...]) -> bytes:
    packed = pack((_Q.channel_count, len(commands)))
    for command in commands:
        packed += pack((_Q.channel, command.channel))
        is_shaped = command.onset or command.ending
        flags = _KEEP_PHASE if command.keep_phase else 0
        flags |= _SKIP_ENDING if command.skip_ending else 0
        packed += bytes([flags | (_ENVELOPES if is_shaped else 0)])
        packed += pack(
            (_Q.frequency, command.frequency),
            (_Q.level, command.level),
            (_Q.phase, command.phase),
        )
        if is_shaped:
            packed += pack((_Q.envelope_slot, command.onset), (_Q.envelope_slot, command.ending))
    return packed


def _unpack_commands(cursor: Cursor) -> tuple[DriveCommand, ...]:
    commands: list[DriveCommand] = []
    seen: set[int] = set()
    for _ in range(cursor.integer(_Q.channel_count)):
        channel = cursor.integer(_Q.channel)
        if channel in seen:
            raise Malformed(
                f"channel {channel} is named twice", code=NakCode.BAD_CHANNEL, channel=channel
            )
        seen.add(channel)
        flags = cursor.flags(_KEEP_PHASE | _SKIP_ENDING | _ENVELOPES)
        is_shaped = bool(flags & _ENVELOPES)
        commands.append(
            DriveCommand(
                channel=channel,
                frequency=cursor.number(_Q.frequency),
                level=cursor.number(_Q.level),
                phase=cursor.number(_Q.phase),
                keep_phase=bool(flags & _KEEP_PHASE),
                onset=cursor.integer(_Q.envelope_slot) if is_shaped else 0,
                ending=cursor.integer(_Q.envelope_slot) if is_shaped else 0,
                skip_ending=bool(flags & _SKIP_ENDING),
            )
        )
    return tuple(commands)


def _pack_set(command_set: CommandSet) -> bytes:
    if type(command_set) is not SafeCommand:
        raise TypeError(
            f"only a SafeCommand goes on the wire, not a {type(command_set).__name__}: "
            "let Guard.check make one"
        )
    times = pack(
        (_Q.token, command_set.token),
        (_Q.ramp, command_set.ramp),
        (_Q.valid_for, command_set.valid_for),
    )
    return times + _pack_commands(command_set.commands)


def _unpack_set(cursor: Cursor) -> CommandSet:
    token = cursor.integer(_Q.token)
    ramp = cursor.number(_Q.ramp)
    valid_for = cursor.number(_Q.valid_for)
    return CommandSet(
        token=token, commands=_unpack_commands(cursor), ramp=ramp, valid_for=valid_for
    )


def _pack_envelope(envelope: Envelope) -> bytes:
    if type(envelope) is not SafeEnvelope:
        raise TypeError(
            f"only a SafeEnvelope goes on the wire, not a {type(envelope).__name__}: "
            "let Guard.check_envelope make one"
        )
    head = pack((_Q.envelope_slot, envelope.slot), (_Q.envelope_step, envelope.step))
    head += pack((_Q.envelope_knots, len(envelope.knots)))
    return head + b"".join(
        pack((_Q.level, knot.level), (_Q.phase, knot.phase)) for knot in envelope.knots
    )


def _unpack_envelope(cursor: Cursor) -> Envelope:
    slot = cursor.integer(_Q.envelope_slot)
    step = cursor.number(_Q.envelope_step)
    count = cursor.integer(_Q.envelope_knots)
    knots = tuple(
        Knot(level=cursor.number(_Q.level), phase=cursor.number(_Q.phase)) for _ in range(count)
    )
    return Envelope(slot=slot, step=step, knots=knots)


def _pack_identity(identity: Identity) -> bytes:
    version = pack((_Q.protocol_version, identity.protocol_version))
    texts = (identity.vendor, identity.product, identity.serial_number, identity.firmware)
    return version + b"".join(pack_text(text) for text in texts)


def _unpack_identity(cursor: Cursor) -> Identity:
    version = cursor.integer(_Q.protocol_version)
    return Identity(
        vendor=cursor.text(),
        product=cursor.text(),
        serial_number=cursor.text(),
        firmware=cursor.text(),
        protocol_version=version,
    )


def _pack_capabilities(capabilities: Capabilities) -> bytes:
    return pack(
        (_Q.channel_count, capabilities.channels),
        (_Q.frequency, capabilities.frequency_min),
        (_Q.frequency, capabilities.frequency_max),
        (_Q.frequency, capabilities.frequency_step),
        (_Q.level, capabilities.level_max),
        (_Q.level, capabilities.level_step),
        (_Q.phase_step, capabilities.phase_step),
        (_Q.ramp, capabilities.ramp_max),
        (_Q.watchdog, capabilities.watchdog_min),
        (_Q.watchdog, capabilities.watchdog_max),
        (_Q.envelope_knots, capabilities.envelope_knots),
        (_Q.envelope_slots, capabilities.envelope_slots),
        (_Q.envelope_step, capabilities.envelope_step_min),
        (_Q.envelope_step, capabilities.envelope_step_max),
    ) + bytes([_EVENTS if capabilities.events else 0])


def _unpack_capabilities(cursor: Cursor) -> Capabilities:
    return Capabilities(
        channels=cursor.integer(_Q.channel_count),
        frequency_min=cursor.number(_Q.frequency),
        frequency_max=cursor.number(_Q.frequency),
        frequency_step=cursor.number(_Q.frequency),
        level_max=cursor.number(_Q.level),
        level_step=cursor.number(_Q.level),
        phase_step=cursor.number(_Q.phase_step),
        ramp_max=cursor.number(_Q.ramp),
        watchdog_min=cursor.number(_Q.watchdog),
        watchdog_max=cursor.number(_Q.watchdog),
        envelope_knots=cursor.integer(_Q.envelope_knots),
        envelope_slots=cursor.integer(_Q.envelope_slots),
        envelope_step_min=cursor.number(_Q.envelope_step),
        envelope_step_max=cursor.number(_Q.envelope_step),
        events=bool(cursor.flags(_EVENTS)),
    )


def _pack_status(status: Status) -> bytes:
    head = bytes([status.state, status.fault]) + pack((_Q.active_token, status.token))
    head += bytes([_HIGH_VOLTAGE if status.high_voltage else 0])
    head += pack(
        (_Q.temperature, status.temperature),
        (_Q.watchdog_left, status.watchdog_left),
        (_Q.voltage, status.voltage),
        (_Q.channel_count, len(status.levels)),
    )
    return head + b"".join(pack((_Q.level, level)) for level in status.levels)


def _unpack_status(cursor: Cursor) -> Status:
    state = cursor.one_of(State)
    fault = cursor.one_of(Fault)
    token = cursor.integer(_Q.active_token)
    flags = cursor.flags(_HIGH_VOLTAGE)
    temperature = cursor.number(_Q.temperature)
    watchdog_left = cursor.number(_Q.watchdog_left)
    voltage = cursor.number(_Q.voltage)
    channels = cursor.integer(_Q.channel_count)
    return Status(
        state=state,
        fault=fault,
        token=token,
        high_voltage=bool(flags & _HIGH_VOLTAGE),
        temperature=temperature,
        watchdog_left=watchdog_left,
        voltage=voltage,
        levels=tuple(cursor.number(_Q.level) for _ in range(channels)),
    )


def _pack_achieved(achieved: Achieved) -> bytes:
    return pack((_Q.token, achieved.token)) + _pack_commands(achieved.commands)


def _unpack_achieved(cursor: Cursor) -> Achieved:
    return Achieved(token=cursor.integer(_Q.token), commands=_unpack_commands(cursor))


def _pack_faults(faults: FaultList) -> bytes:
    newest = faults.faults[: _Q.fault_count.maximum]
    packed = pack((_Q.fault_count, len(newest)))
    for record in newest:
        packed += bytes([record.fault]) + pack_optional_channel(record.channel)
        packed += pack((_Q.age, min(record.age, _Q.age.high)))
    return packed


def _unpack_faults(cursor: Cursor) -> FaultList:
    return FaultList(
        faults=tuple(
            FaultRecord(
                fault=cursor.one_of(Fault),
                channel=cursor.optional_channel(),
                age=cursor.number(_Q.age),
            )
            for _ in range(cursor.integer(_Q.fault_count))
        )
    )


@dataclass(frozen=True)
class _Layout:
    """How one message and its payload become each other."""

    message: type[Any]
    pack: Callable[[Any], bytes]
    unpack: Callable[[Cursor], Any]


def _empty(message: type[Any]) -> _Layout:
    return _Layout(message, lambda _: b"", lambda _: message())


_IDENTITY = _Layout(Identity, _pack_identity, _unpack_identity)
_CAPABILITIES = _Layout(Capabilities, _pack_capabilities, _unpack_capabilities)
_STATUS = _Layout(Status, _pack_status, _unpack_status)
_ACHIEVED = _Layout(Achieved, _pack_achieved, _unpack_achieved)
_FAULTS = _Layout(FaultList, _pack_faults, _unpack_faults)

_ARM = _Layout(
    Arm,
    lambda arm: pack((_Q.watchdog, arm.watchdog)),
    lambda cursor: Arm(watchdog=cursor.number(_Q.watchdog)),
)
_DISARM = _Layout(
    Disarm,
    lambda disarm: pack((_Q.ramp, disarm.ramp)),
    lambda cursor: Disarm(ramp=cursor.number(_Q.ramp)),
)
_STAGE = _Layout(
    Stage,
    lambda stage: _pack_set(stage.command_set),
    lambda cursor: Stage(_unpack_set(cursor)),
)
_COMMIT = _Layout(
    Commit,
    lambda commit: pack((_Q.token, commit.token)),
    lambda cursor: Commit(token=cursor.integer(_Q.token)),
)
_APPLY = _Layout(
    Apply,
    lambda apply: _pack_set(apply.command_set),
    lambda cursor: Apply(_unpack_set(cursor)),
)
_STOP = _Layout(
    Stop,
    lambda stop: pack((_Q.ramp, stop.ramp)),
    lambda cursor: Stop(ramp=cursor.number(_Q.ramp)),
)
_LOAD_ENVELOPE = _Layout(
    LoadEnvelope,
    lambda load: _pack_envelope(load.envelope),
    lambda cursor: LoadEnvelope(_unpack_envelope(cursor)),
)
_LOADED = _Layout(
    Loaded,
    lambda loaded: pack((_Q.envelope_slot, loaded.slot), (_Q.envelope_knots, loaded.knots)),
    lambda cursor: Loaded(
        slot=cursor.integer(_Q.envelope_slot), knots=cursor.integer(_Q.envelope_knots)
    ),
)
_EVENT_LAYOUT = _Layout(
    Event,
    lambda event: bytes([event.state, event.fault]) + pack_optional_channel(event.channel),
    lambda cursor: Event(
        state=cursor.one_of(State), fault=cursor.one_of(Fault), channel=cursor.optional_channel()
    ),
)

# Request and reply of every message type.
_EXCHANGES: dict[int, tuple[_Layout, _Layout]] = {
    PROTOCOL.types["hello"]: (_empty(Hello), _IDENTITY),
    PROTOCOL.types["get_caps"]: (_empty(GetCaps), _CAPABILITIES),
    PROTOCOL.types["arm"]: (_ARM, _STATUS),
    PROTOCOL.types["disarm"]: (_DISARM, _STATUS),
    PROTOCOL.types["stage"]: (_STAGE, _ACHIEVED),
    PROTOCOL.types["commit"]: (_COMMIT, _ACHIEVED),
    PROTOCOL.types["apply"]: (_APPLY, _ACHIEVED),
    PROTOCOL.types["stop"]: (_STOP, _STATUS),
    PROTOCOL.types["get_status"]: (_empty(GetStatus), _STATUS),
    PROTOCOL.types["get_faults"]: (_empty(GetFaults), _FAULTS),
    PROTOCOL.types["clear"]: (_empty(Clear), _STATUS),
    PROTOCOL.types["ping"]: (_empty(Ping), _STATUS),
    PROTOCOL.types["load_envelope"]: (_LOAD_ENVELOPE, _LOADED),
}
_TYPE_OF = {request.message: code for code, (request, _) in _EXCHANGES.items()}


def encode_request(request: Request, *, address: int, sequence: int) -> Frame:
    """The frame of a request; TypeError if a set in it has not passed a guard."""
    code = _TYPE_OF[type(request)]
    payload = _EXCHANGES[code][0].pack(request)
    return Frame(kind=code, address=address, sequence=sequence, payload=payload)


def decode_request(frame: Frame) -> Request:
    """The request in a frame; raises Malformed."""
    if frame.is_reply or frame.type not in _EXCHANGES:
        raise Malformed(f"no request has type {frame.kind:#04x}", code=NakCode.UNKNOWN_TYPE)
    request: Request = _decode(_EXCHANGES[frame.type][0], frame.payload)
    return request


def encode_reply(reply: Reply, to: Frame) -> Frame:
    """The frame that answers the request frame `to`; TypeError if this reply does not answer it."""
    if isinstance(reply, Nak):
        payload = bytes([to.type, reply.code]) + pack_optional_channel(reply.channel)
        kind = REPLY | _NAK
    else:
        layout = _EXCHANGES[to.type][1]
        if not isinstance(reply, layout.message):
            raise TypeError(f"{type(reply).__name__} does not answer message type {to.type}")
        payload = layout.pack(reply)
        kind = REPLY | to.type
    return Frame(kind=kind, address=to.address, sequence=to.sequence, payload=payload)


def decode_reply(frame: Frame, to: Frame) -> Reply:
    """The reply in a frame that carries the sequence number of the request frame `to`.

    Raises Malformed, also where the frame answers another type of request.
    """
    if frame.kind == REPLY | _NAK:
        return _decode_nak(frame.payload, to)
    if frame.kind != REPLY | to.type:
        raise Malformed(
            f"a request of type {to.type} was answered with type {frame.kind:#04x}",
            code=NakCode.UNKNOWN_TYPE,
        )
    reply: Reply = _decode(_EXCHANGES[to.type][1], frame.payload)
    return reply


def is_event(frame: Frame) -> bool:
    """Whether a frame is no answer: its sequence number counts the amplifier's events."""
    return frame.kind == REPLY | _EVENT


def encode_event(event: Event, *, address: int, sequence: int) -> Frame:
    """The frame in which an amplifier speaks unasked."""
    payload = _EVENT_LAYOUT.pack(event)
    return Frame(kind=REPLY | _EVENT, address=address, sequence=sequence, payload=payload)


def decode_event(frame: Frame) -> Event:
    """The event in a frame for which `is_event` holds; raises Malformed."""
    event: Event = _decode(_EVENT_LAYOUT, frame.payload)
    return event


def _decode_nak(payload: bytes, to: Frame) -> Nak:
    cursor = Cursor(payload)
    refused = cursor.byte()
    nak = Nak(code=cursor.one_of(NakCode), channel=cursor.optional_channel())
    cursor.end()
    if refused != to.type:
        raise Malformed(
            f"a request of type {to.type} was answered with a refusal of type {refused}",
            code=NakCode.UNKNOWN_TYPE,
        )
    return nak


def _decode(layout: _Layout, payload: bytes) -> Any:
    cursor = Cursor(payload)
    message = layout.unpack(cursor)
    cursor.end()
    return message
