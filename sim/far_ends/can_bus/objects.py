"""The object dictionary of a simulated amplifier.

Indices and ranges are those of protocol.yaml; the encoding shares no code with the host's side.
"""

import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from typing import Any

from drivers.command import Envelope, Knot
from drivers.protocol.definition import PROTOCOL, WireQuantity
from drivers.protocol.messages import (
    AddressSet,
    FaultList,
    Feature,
    GetFaults,
    GetMeasured,
    LoadEnvelope,
    Measured,
    Nak,
    NakCode,
    SetAddress,
    Status,
)
from sim.bench.simulated_device import SimulatedDevice
from sim.far_ends.can_bus.sdo import (
    BAD_LENGTH,
    NO_OBJECT,
    NO_SUBINDEX,
    READ_ONLY,
    WRITE_ONLY,
    SdoAbort,
)
from sim.far_ends.can_bus.sensor_objects import SensorObjects
from sim.far_ends.can_bus.set_buffer import NO_CHANNEL

CANOPEN: Mapping[str, Any] = PROTOCOL.canopen
IDS: Mapping[str, int] = CANOPEN["cob_ids"]
_Q = PROTOCOL.quantities
_INDEX = {name: declared["index"] for name, declared in CANOPEN["objects"].items()}
_ABORTS = {NakCode[name]: code for name, code in CANOPEN["aborts"].items()}
_WIDTH = {"u8": "<B", "u16": "<H", "u32": "<L", "i16": "<h"}
_EVENT_DRIVEN = 255
_RPDO, _RPDO_MAP, _TPDO, _TPDO_MAP = 0x1400, 0x1600, 0x1800, 0x1A00
_REQUEST_PDO, _SLOTS_PDO = 16, 17  # RPDO 17, 18, ..., for any number of channels
_SLOTS = 63


def channel_ids(node: int, channels: int) -> dict[int, int]:
    """Channel by RPDO identifier of a node."""
    return {
        IDS["command"] + 0x100 * (channel % 4) + node + channel // 4: channel
        for channel in range(channels)
    }


def sent_ids(node: int, channels: int) -> tuple[int, ...]:
    """TPDO identifiers of a node: reply, status, then levels of four channels each."""
    levels = (IDS["levels"] + node + group for group in range(-(-channels // 4)))
    return (IDS["answer"] + node, IDS["condition"] + node, *levels)


def flags_of(status: Status) -> int:
    """The flags of a status."""
    return status.high_voltage | status.interlock_open << 1


class ObjectDictionary:
    """The objects of one amplifier; pdo_written: called when an RPDO object is written.

    host: node whose heartbeat feeds the watchdog, 0 for none; heartbeat [ms]: its own interval.
    """

    def __init__(
        self, device: SimulatedDevice, node: int, *, pdo_written: Callable[[int, bytes], None]
    ) -> None:
        self._device = device
        self._node = node
        self._pdo_written = pdo_written
        self._channels = device.capabilities.channels
        self.achieved = b""
        self.blocks: dict[int, bytes] = {}  # last data by PDO identifier
        self.next_node = node  # from the next reset of communication on
        self.reset()
        self._reads: dict[tuple[int, int], Callable[[], bytes]] = {}
        self._writes: dict[tuple[int, int], Callable[[bytes], None]] = {}
        self._communication()
        self._identity()
        self._status()
        self._pdos()
        self._reads[_INDEX["envelope"], 0] = lambda: bytes([_SLOTS])
        if Feature.ADDRESS in device.capabilities.features:
            self._writes[_INDEX["set_address"], 0] = self._set_address
        for slot in range(1, _SLOTS + 1):
            self._writes[_INDEX["envelope"], slot] = partial(self._load, slot)

    def reset(self) -> None:
        """Reset the communication objects."""
        self.host = 0
        self.watchdog = 0
        self.heartbeat = int(CANOPEN["heartbeat_ms"])

    def read(self, index: int, subindex: int) -> bytes:
        """Read an object; raises SdoAbort."""
        found = self._reads.get((index, subindex))
        if found is None:
            is_other = (index, subindex) in self._writes
            raise SdoAbort(WRITE_ONLY if is_other else self._missing(index))
        return found()

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Write an object; raises SdoAbort."""
        found = self._writes.get((index, subindex))
        if found is None:
            is_other = (index, subindex) in self._reads
            raise SdoAbort(READ_ONLY if is_other else self._missing(index))
        found(data)

    def _missing(self, index: int) -> int:
        known = any(index == other for other, _ in (*self._reads, *self._writes))
        return NO_SUBINDEX if known else NO_OBJECT

    def _communication(self) -> None:
        self._constant(_INDEX["device_type"], 0, _pack("u32", CANOPEN["device_type"]))
        self._reads[_INDEX["error_register"], 0] = lambda: bytes(
            [CANOPEN["emergencies"][self._device.status().fault.name]["error_register"]]
        )
        emergency = IDS["emergency"] + self._node
        self._constant(_INDEX["emergency_cob_id"], 0, _pack("u32", emergency))
        consumer, producer = _INDEX["heartbeat_consumer"], _INDEX["heartbeat_producer"]
        self._count(consumer, 1)
        self._reads[consumer, 1] = lambda: _pack("u32", self.host << 16 | self.watchdog)
        self._writes[consumer, 1] = self._set_consumer
        self._reads[producer, 0] = lambda: _pack("u16", self.heartbeat)
        self._writes[producer, 0] = self._set_producer

    def _identity(self) -> None:
        identity = self._device.identity
        numbers = [CANOPEN["vendor_id"], CANOPEN["product_code"], CANOPEN["revision"]]
        numbers.append(zlib.crc32(identity.serial_number.encode()))
        self._record(_INDEX["identity"], [_pack("u32", value) for value in numbers])
        texts = (identity.vendor, identity.product, identity.serial_number, identity.firmware)
        versions = _pack("u16", sum(2**version for version in identity.versions))
        self._record(_INDEX["texts"], [*(text.encode() for text in texts), versions])
        capabilities = self._device.capabilities
        values = asdict(capabilities)
        kinds = CANOPEN["objects"]["capabilities"]["types"]
        self._record(
            _INDEX["capabilities"],
            [_scaled(getattr(_Q, kind), values[name]) for name, kind in kinds.items()],
        )
        limits = capabilities.limits_of_channels
        for name, quantity in (
            ("frequency_min", _Q.frequency),
            ("frequency_max", _Q.frequency),
            ("level_max", _Q.level),
        ):
            each = [_scaled(quantity, getattr(one, name)) for one in limits]
            self._record(_INDEX[f"channel_{name}"], each)

    def _status(self) -> None:
        status, index = self._device.status, _INDEX["status"]
        self._count(index, 7)
        self._reads[index, 1] = lambda: bytes([status().state])
        self._reads[index, 2] = lambda: bytes([status().fault])
        self._reads[index, 3] = lambda: _pack("u16", status().token)
        self._reads[index, 4] = lambda: bytes([flags_of(status())])
        self._reads[index, 5] = lambda: _scaled(_Q.voltage, status().voltage)
        self._reads[index, 6] = lambda: _scaled(_Q.temperature, status().temperature)
        self._reads[index, 7] = lambda: _scaled(_Q.watchdog_left, status().watchdog_left)
        levels = _INDEX["channel_levels"]
        self._count(levels, self._channels)
        for channel in range(self._channels):
            self._reads[levels, channel + 1] = partial(
                lambda channel: _scaled(_Q.level, status().levels[channel]), channel
            )
        if Feature.ELECTRICAL in self._device.capabilities.features:
            self._measurements()
        if Feature.SENSORS in self._device.capabilities.features:
            self._sensors = SensorObjects(self._device)
            self._reads |= self._sensors.reads()
            self._writes |= self._sensors.writes()
        self._reads[_INDEX["achieved"], 0] = lambda: self.achieved
        self._reads[_INDEX["faults"], 0] = self._faults

    def _measurements(self) -> None:
        for name, quantity in (("voltage", _Q.channel_voltage), ("current", _Q.channel_current)):
            index = _INDEX[f"channel_{name}"]
            self._count(index, self._channels)
            for channel in range(self._channels):
                self._reads[index, channel + 1] = partial(self._measured, channel, name, quantity)

    def _measured(self, channel: int, name: str, quantity: WireQuantity) -> bytes:
        reply = self._device.exchange(GetMeasured())
        channels = reply.channels if isinstance(reply, Measured) else ()
        return _scaled(quantity, getattr(channels[channel], name) if channels else 0.0)

    def _pdos(self) -> None:
        """The fixed PDOs, and the objects that they map."""
        command, request, slots = _INDEX["command"], _INDEX["order"], _INDEX["slots"]
        groups = -(-self._channels // 4)
        self._count(command, self._channels)
        self._count(slots, groups)
        for cob_id, channel in channel_ids(self._node, self._channels).items():
            self._received_pdo(channel, cob_id, command, channel + 1)
        self._received_pdo(_REQUEST_PDO, IDS["order"] + self._node, request, 0)
        for group in range(groups):
            self._received_pdo(_SLOTS_PDO + group, IDS["slots"] + self._node, slots, group + 1)
        sent = [("answer", 0), ("condition", 0), *(("levels", 1 + n) for n in range(groups))]
        self._count(_INDEX["levels"], groups)
        sent_by = sent_ids(self._node, self._channels)
        for number, (cob_id, (name, subindex)) in enumerate(zip(sent_by, sent, strict=True)):
            self._pdo(_TPDO + number, _TPDO_MAP + number, cob_id, _INDEX[name], subindex)

    def _received_pdo(self, number: int, cob_id: int, index: int, subindex: int) -> None:
        self._pdo(_RPDO + number, _RPDO_MAP + number, cob_id, index, subindex)
        self._writes[index, subindex] = partial(self._write_pdo, cob_id)

    def _pdo(self, parameter: int, mapping: int, cob_id: int, index: int, subindex: int) -> None:
        self._record(parameter, [_pack("u32", cob_id), bytes([_EVENT_DRIVEN])])
        self._record(mapping, [_pack("u32", index << 16 | subindex << 8 | 64)])
        self._reads[index, subindex] = lambda: self.blocks.get(cob_id, bytes(8))

    def _write_pdo(self, cob_id: int, data: bytes) -> None:
        if len(data) != 8:
            raise SdoAbort(BAD_LENGTH)
        self.blocks[cob_id] = data
        self._pdo_written(cob_id, data)

    def _set_consumer(self, data: bytes) -> None:
        value = _unpack("u32", data)
        self.watchdog, self.host = value & 0xFFFF, value >> 16 & 0x7F

    def _set_producer(self, data: bytes) -> None:
        self.heartbeat = _unpack("u16", data)

    def _faults(self) -> bytes:
        reply = self._device.exchange(GetFaults())
        return b"".join(
            struct.pack(
                "<BBL",
                record.fault,
                NO_CHANNEL if record.channel is None else record.channel,
                min(round(record.age * 1000), _Q.age.maximum),
            )
            for record in (reply.faults if isinstance(reply, FaultList) else ())
        )

    def _load(self, slot: int, data: bytes) -> None:
        reply = self._device.exchange(LoadEnvelope(_envelope_of(slot, data)))
        if isinstance(reply, Nak):
            raise SdoAbort(_ABORTS[reply.code])

    def _set_address(self, data: bytes) -> None:
        if len(data) < 2:
            raise SdoAbort(BAD_LENGTH)
        if not 1 <= data[0] <= CANOPEN["node_max"]:
            raise SdoAbort(_ABORTS[NakCode.BAD_VALUE])
        wanted = SetAddress(data[0], data[1:].decode(errors="replace"))
        reply = self._device.exchange(wanted)
        if not isinstance(reply, AddressSet):
            code = reply.code if isinstance(reply, Nak) else NakCode.BAD_VALUE
            raise SdoAbort(_ABORTS[code])
        self.next_node = reply.address

    def _record(self, index: int, values: list[bytes]) -> None:
        self._count(index, len(values))
        for subindex, value in enumerate(values, start=1):
            self._constant(index, subindex, value)

    def _count(self, index: int, count: int) -> None:
        self._constant(index, 0, bytes([count]))

    def _constant(self, index: int, subindex: int, value: bytes) -> None:
        self._reads[index, subindex] = lambda: value


def _envelope_of(slot: int, data: bytes) -> Envelope:
    """Decode an envelope written to a slot; raises SdoAbort."""
    if len(data) < 3 or len(data) != 3 + 4 * data[2]:
        raise SdoAbort(BAD_LENGTH)
    step, _ = struct.unpack_from("<HB", data)
    pairs = list(struct.iter_unpack("<Hh", data[3:]))
    if not _Q.envelope_step.holds(step) or not all(
        _Q.level.holds(level) and _Q.phase.holds(phase) for level, phase in pairs
    ):
        raise SdoAbort(_ABORTS[NakCode.BAD_VALUE])
    knots = tuple(Knot(level / 10_000, phase / 100) for level, phase in pairs)
    return Envelope(slot, step / 10_000, knots)


def _scaled(quantity: WireQuantity, value: float) -> bytes:
    return _pack(quantity.wire, quantity.to_wire(min(max(value, quantity.low), quantity.high)))


def _pack(kind: str, value: int) -> bytes:
    return struct.pack(_WIDTH[kind], value)


def _unpack(kind: str, data: bytes) -> int:
    if len(data) != struct.calcsize(_WIDTH[kind]):
        raise SdoAbort(BAD_LENGTH)
    (value,) = struct.unpack(_WIDTH[kind], data)
    return int(value)
