"""DOMAIN objects: the achieved set, the fault history, and envelopes."""

import struct
from collections.abc import Sequence

from drivers.command import Envelope, Knot
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Achieved, FaultRecord, NakCode
from sim.far_ends.can_bus.sdo import BAD_LENGTH, SdoAbort
from sim.far_ends.can_bus.set_buffer import NO_CHANNEL

ABORTS = {NakCode[name]: code for name, code in PROTOCOL.canopen["aborts"].items()}
_Q = PROTOCOL.quantities


def achieved_domain(achieved: Achieved) -> bytes:
    """The object `achieved`."""
    data = struct.pack("<HB", achieved.token, len(achieved.commands))
    for command in achieved.commands:
        flags = command.keep_phase | command.skip_ending << 1 | command.channel << 4
        flags |= bool(command.onset or command.ending) << 2
        data += struct.pack(
            "<HHhBxBB",
            _Q.frequency.to_wire(command.frequency),
            _Q.level.to_wire(command.level),
            _Q.phase.to_wire(command.phase),
            flags,
            command.onset,
            command.ending,
        )
    return data


def faults_domain(records: Sequence[FaultRecord]) -> bytes:
    """The object `faults`."""
    max_age = _Q.age.maximum
    return b"".join(
        struct.pack(
            "<BBL",
            record.fault,
            NO_CHANNEL if record.channel is None else record.channel,
            min(round(record.age * 1000), max_age),
        )
        for record in records
    )


def envelope_of(slot: int, data: bytes) -> Envelope:
    """Decode an envelope written to a slot; raises SdoAbort."""
    if len(data) < 3 or len(data) != 3 + 4 * data[2]:
        raise SdoAbort(BAD_LENGTH)
    step, _ = struct.unpack_from("<HB", data)
    pairs = list(struct.iter_unpack("<Hh", data[3:]))
    if not _Q.envelope_step.holds(step) or not all(
        _Q.level.holds(level) and _Q.phase.holds(phase) for level, phase in pairs
    ):
        raise SdoAbort(ABORTS[NakCode.BAD_VALUE])
    knots = tuple(Knot(level / 10_000, phase / 100) for level, phase in pairs)
    return Envelope(slot, step / 10_000, knots)
