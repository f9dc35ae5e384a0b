"""Payloads of identity, capabilities, status and faults on a serial line: pack and unpack.

Unpacking yields values in range or raises Malformed.
"""

from collections.abc import Mapping
from functools import lru_cache
from operator import truediv
from typing import Any

from drivers.codec.payload import (
    Cursor,
    Row,
    flags_of,
    member,
    pack,
    pack_optional_channel,
    pack_text,
    status_flags,
    versions_mask,
    versions_of,
)
from drivers.protocol.definition import PROTOCOL, WireQuantity
from drivers.protocol.messages import (
    AmplifierState,
    Capabilities,
    ChannelLimits,
    Fault,
    FaultList,
    FaultRecord,
    Feature,
    Identity,
    Measured,
    Measurement,
    Status,
)

_Q = PROTOCOL.quantities
_MEASURED = (_Q.temperature, _Q.watchdog_left, _Q.voltage)
_BYTE = WireQuantity("byte", "u8", 1, "", 0, 255)
_STATUS = Row(  # up to its levels
    *(_BYTE, _BYTE, _Q.active_token, _BYTE, *_MEASURED),
    *(_Q.latch, _Q.channel_count),
)
_PER_UNIT = tuple(each.per_unit for each in _MEASURED)
_CAPABILITIES: Mapping[str, WireQuantity] = {  # in the order of the payload; the limits follow
    "channels": _Q.channel_count,
    "frequency_min": _Q.frequency,
    "frequency_max": _Q.frequency,
    "frequency_step": _Q.frequency,
    "level_max": _Q.level,
    "level_step": _Q.level,
    "phase_step": _Q.phase_step,
    "ramp_max": _Q.ramp,
    "watchdog_min": _Q.watchdog,
    "watchdog_max": _Q.watchdog,
    "envelope_knots": _Q.envelope_knots,
    "envelope_slots": _Q.envelope_slots,
    "envelope_step_min": _Q.envelope_step,
    "envelope_step_max": _Q.envelope_step,
    "features": _Q.features,
    "voices": _Q.voices,
}
_LIMITS: Mapping[str, WireQuantity] = {  # of a channel, in the order of the payload
    "frequency_min": _Q.frequency,
    "frequency_max": _Q.frequency,
    "level_max": _Q.level,
}


def pack_identity(identity: Identity) -> bytes:
    """Pack an identity."""
    version = pack((_Q.versions, versions_mask(identity.versions)))
    texts = (identity.vendor, identity.product, identity.serial_number, identity.firmware)
    return version + b"".join(pack_text(text) for text in texts)


def unpack_identity(cursor: Cursor) -> Identity:
    """Unpack an identity."""
    versions = versions_of(cursor.integer(_Q.versions))
    return Identity(
        vendor=cursor.text(),
        product=cursor.text(),
        serial_number=cursor.text(),
        firmware=cursor.text(),
        versions=versions,
    )


def pack_capabilities(capabilities: Capabilities) -> bytes:
    """Pack capabilities."""
    numbers = [(quantity, getattr(capabilities, name)) for name, quantity in _CAPABILITIES.items()]
    limits = [
        (quantity, getattr(channel, name))
        for channel in capabilities.limits_of_channels
        for name, quantity in _LIMITS.items()
    ]
    return pack(*numbers, *limits)


def unpack_capabilities(cursor: Cursor) -> Capabilities:
    """Unpack capabilities."""
    values: dict[str, Any] = {
        name: cursor.value(quantity) for name, quantity in _CAPABILITIES.items()
    }
    values["features"] = Feature(values["features"])
    limits = tuple(
        ChannelLimits(**{name: cursor.number(quantity) for name, quantity in _LIMITS.items()})
        for _ in range(values["channels"])
    )
    return Capabilities(**values, channel_limits=limits)


@lru_cache
def _levels(channels: int) -> Row:
    return Row(*(_Q.level,) * channels)


def pack_status(status: Status) -> bytes:
    """Pack a status."""
    head = _STATUS.pack(
        *(status.state, status.fault, status.token, status_flags(status)),
        *(status.temperature, status.watchdog_left, status.voltage),
        *(status.latch, len(status.levels)),
    )
    return head + _levels(len(status.levels)).pack(*status.levels)


def unpack_status(cursor: Cursor) -> Status:
    """Unpack a status."""
    state, fault, token, flags, *measured, latch, channels = cursor.integers(_STATUS)
    temperature, watchdog_left, voltage = map(truediv, measured, _PER_UNIT)
    return Status(
        state=member(AmplifierState, state),
        fault=member(Fault, fault),
        token=token,
        temperature=temperature,
        watchdog_left=watchdog_left,
        voltage=voltage,
        latch=latch,
        levels=tuple(cursor.numbers(_levels(channels))),
        **flags_of(flags),
    )


def pack_measured(measured: Measured) -> bytes:
    """Pack measurements; what is beyond the range is its end."""
    packed = pack((_Q.channel_count, len(measured.channels)))
    for one in measured.channels:
        packed += pack(
            (_Q.channel_voltage, min(one.voltage, _Q.channel_voltage.high)),
            (_Q.channel_current, min(one.current, _Q.channel_current.high)),
        )
    return packed


def unpack_measured(cursor: Cursor) -> Measured:
    """Unpack measurements."""
    return Measured(
        tuple(
            Measurement(cursor.number(_Q.channel_voltage), cursor.number(_Q.channel_current))
            for _ in range(cursor.integer(_Q.channel_count))
        )
    )


def pack_faults(faults: FaultList) -> bytes:
    """Pack the newest faults, as many as fit."""
    newest = faults.faults[: _Q.fault_count.maximum]
    packed = pack((_Q.fault_count, len(newest)))
    for record in newest:
        packed += bytes([record.fault]) + pack_optional_channel(record.channel)
        packed += pack((_Q.age, min(record.age, _Q.age.high)))
    return packed


def unpack_faults(cursor: Cursor) -> FaultList:
    """Unpack faults."""
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
