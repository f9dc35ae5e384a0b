"""Tones on every wire: amplitude, frequency and phase of each channel, decoded by hand.

A host plays a set through its whole stack, from the URL to the bytes of the line. The decoders in
this file follow docs/reference (protocol.md, serial.md, modbus.md, can.md) and use no code of
`drivers`. A wrong tone fails with its channel, the quantity, and by how much it differs.
"""

import asyncio
import os
import re
import struct
import zlib
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import asynccontextmanager
from typing import NamedTuple
from unittest.mock import Mock

import can
import pytest

from drivers.host.amplifier import Amplifier
from drivers.host.group import Group
from drivers.host.line import Line
from drivers.host.requests import Priority
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.records import Values
from drivers.protocol.sets import Envelope
from drivers.wires.can_bus import CanWire
from drivers.wires.can_frames import CanFrame, pack_frames
from drivers.wires.can_interfaces import BusPort, Interface
from kit.clock import run_virtual
from kit.wires import LIMITS, WIRES, rig_on_wire
from model.rig.rig import Rig
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.can_amplifiers import CanAmplifiers


class Tone(NamedTuple):
    """The tones of one channel in one layer."""

    amplitude: float  # of full stroke
    frequency: float  # Hz
    phase: float  # degrees


UNITS = Tone("of full stroke", "Hz", "degrees")  # type: ignore[arg-type]
STEPS = Tone(0.0001, 0.05, 0.01)
"""One step of each number, from the table of numbers in protocol.md."""
Tones = Mapping[tuple[int, int], Tone]
"""Tones by layer and channel."""

ONE_LAYER: Tones = {
    (3, 0): Tone(0.11, 110.05, 12.5),
    (3, 1): Tone(0.23, 173.4, -76.25),
    (3, 2): Tone(0.35, 241.75, 134.5),
    (3, 3): Tone(0.47, 399.1, -161.75),
}
TWO_LAYERS: Tones = {
    **ONE_LAYER,
    (1, 0): Tone(0.0511, 88.15, -3.01),
    (1, 1): Tone(0.0622, 95.6, 44.44),
    (1, 2): Tone(0.0733, 333.3, -99.99),
    (1, 3): Tone(0.0844, 512.2, 179.99),
}
LONG_ONSET = Envelope(20, ((100, 0),) * 24)  # 50 words, so that the set does not fit into one part


class Case(NamedTuple):
    """A set, and in how many parts it is sent."""

    tones: Tones
    onset: Envelope | None
    parts: int


CASES = {"one part": Case(ONE_LAYER, None, 1), "four parts": Case(TWO_LAYERS, LONG_ONSET, 4)}


class Message(NamedTuple):
    """A request of the host: the number of its type, and its words."""

    type: int
    words: tuple[int, ...]


def messages_on_serial(sent: bytes) -> Iterator[Message]:
    """Decode frames of a serial line: COBS between zeros, CRC-32, words with the low byte first."""
    for stuffed in filter(None, sent.split(b"\0")):
        body = bytearray()
        remainder = stuffed
        while remainder:
            block_end = remainder[0]
            body += remainder[1:block_end] + b"\0"
            remainder = remainder[block_end:]
        body.pop()  # the last block has no zero behind it
        payload = body[5:-4]  # type, version, address and sequence before it, the CRC behind it
        assert zlib.crc32(body[:-4]) == int.from_bytes(body[-4:], "little")
        if body[0] != 1:  # the payload of Hello is no words
            yield Message(body[0], struct.unpack(f"<{len(payload) // 2}H", payload))


def messages_on_modbus(pdus: Iterator[bytes]) -> Iterator[Message]:
    """Decode writes: from register 256 n on, a tag and the words of message n, high byte first."""
    for pdu in pdus:
        if pdu[0] == 16:
            address, count = struct.unpack_from(">HH", pdu, 1)
            _, *words = struct.unpack_from(f">{count}H", pdu, 6)
            yield Message(address // 256, tuple(words))


def messages_on_rtu(sent: bytes) -> Iterator[Message]:
    """Decode Modbus RTU: unit, PDU and CRC-16."""

    def pdus() -> Iterator[bytes]:
        remainder = sent
        while remainder:
            size = 9 + remainder[6] if remainder[1] == 16 else 8
            yield remainder[1 : size - 2]
            remainder = remainder[size:]

    return messages_on_modbus(pdus())


def messages_on_tcp(sent: bytes) -> Iterator[Message]:
    """Decode Modbus TCP: transaction, 0, length, unit and PDU."""

    def pdus() -> Iterator[bytes]:
        remainder = sent
        while remainder:
            size = 6 + int.from_bytes(remainder[4:6], "big")
            yield remainder[7:size]
            remainder = remainder[size:]

    return messages_on_modbus(pdus())


def messages_on_can(frames: Iterator[tuple[int, bytes]]) -> Iterator[Message]:
    """Decode frames to node 1: number, index, then type, count and words with the low byte first.

    The first frame of a message has two words, each other one has three.
    """
    words: list[int] = []
    message_type = word_count = 0
    for identifier, data in frames:
        if identifier != 0x201:
            continue
        if data[1] == 0:
            message_type, word_count = data[2], data[3]
            words = [*struct.unpack_from("<2H", data, 4)]
        else:
            words += struct.unpack_from("<3H", data, 2)
        if len(words) >= word_count:
            yield Message(message_type, tuple(words[:word_count]))


def messages_in_text(pattern: bytes) -> Callable[[bytes], Iterator[Message]]:
    """Return a decoder of CAN frames as text; pattern: of identifier and data of a frame."""

    def decode(sent: bytes) -> Iterator[Message]:
        frames = re.findall(pattern, sent)
        return messages_on_can(
            (int(number, 16), bytes.fromhex(data.decode())) for number, data in frames
        )

    return decode


PYTHON_CAN = "can+python-can"
DECODERS: Mapping[str, Callable[[bytes], Iterator[Message]]] = {
    "serial": messages_on_serial,
    "modbus+rtu": messages_on_rtu,
    "modbus+tcp": messages_on_tcp,
    "can+slcan": messages_in_text(rb"\bt([0-9A-F]{3})8([0-9A-F]{16})\r"),
    "can+socketcand": messages_in_text(rb"< send ([0-9A-F]+) 8 ([0-9a-f ]+) >"),
    PYTHON_CAN: messages_in_text(rb"([0-9A-F]{3})#([0-9a-f]{16})\n"),
}
"""What decodes the bytes of each wire; of python-can the messages are noted as candump does."""


def test_every_wire_has_a_decoder_of_its_bytes() -> None:
    """A new wire needs one here, made from its page and not from its code."""
    assert DECODERS.keys() == {*WIRES, PYTHON_CAN}


def tones_in(stream: tuple[int, ...]) -> Tones:
    """Decode the stream of a set: layers of commands, with onsets and endings behind each."""
    tones: dict[tuple[int, int], Tone] = {}
    words = list(stream)
    while words:
        head, _ramp, _valid_for = words[:3]
        del words[:3]
        layer = head >> 7 & 15
        for _ in range(head & 31):
            flags, frequency, level, phase = words[:4]
            del words[:4]
            tones[layer, flags >> 4 & 15] = tone_of(level, frequency, phase)
            for _ in range((flags & 3).bit_count()):
                del words[: 2 + 2 * words[0]]  # the number of knots, their step, and the knots
    return tones


def tone_of(level: int, frequency: int, phase: int) -> Tone:
    """Convert the numbers of the wire; a phase is two's complement."""
    signed_phase = (phase + 0x8000) % 0x10000 - 0x8000
    return Tone(level * STEPS[0], frequency * STEPS[1], signed_phase * STEPS[2])


def sent_tones(messages: Iterator[Message], parts: int) -> Tones:
    """Join the parts of the only set that was sent, and decode it."""
    sets = [message.words for message in messages if message.type == 5]
    assert [words[2] >> 8 for words in sets] == [*range(parts)]
    stream = [word for words in sets for word in words[3:]]
    return tones_in(tuple(stream))


def tones_achieved(layer: int, reply: Values) -> Tones:
    """Convert what an amplifier reports that a layer plays."""
    return {
        (layer, row["channel"]): tone_of(row["level"], row["frequency"], row["phase"])
        for row in reply["commands"]
    }


def differences(expected: Tones, actual: Tones) -> list[str]:
    """Describe each amplitude, frequency and phase that is not as expected."""
    texts = []
    for key, tone in expected.items():
        layer, channel = key
        where = f"channel {channel} of layer {layer}"
        if key not in actual:
            texts.append(f"{where}: must play, got no tone")
            continue
        for quantity, unit, step in zip(Tone._fields, UNITS, STEPS, strict=True):
            wanted = getattr(tone, quantity)
            got = getattr(actual[key], quantity)
            if abs(got - wanted) > step / 2:
                off = f"off by {got - wanted:+.4g}"
                texts.append(f"{where}: {quantity} must be {wanted:g} {unit}, got {got:g} ({off})")
    for layer, channel in actual.keys() - expected.keys():
        texts.append(f"channel {channel} of layer {layer}: must be silent, got a tone")
    return texts


def assert_same_tones(expected: Tones, actual: Tones, context: str) -> None:
    """Fail with one line for each quantity of a channel that differs."""
    texts = differences(expected, actual)
    if texts:
        raise AssertionError(f"{context}: {'; '.join(texts)}")


def layers_of(case: Case) -> list[AmplifierLayer]:
    """Return a set as the host takes it."""
    layers = []
    for number in dict.fromkeys(layer for layer, _ in case.tones):
        tones = [
            AmplifierTone(channel, tone.frequency, tone.amplitude, tone.phase, onset=case.onset)
            for (layer, channel), tone in case.tones.items()
            if layer == number
        ]
        layers.append(AmplifierLayer(number, tuple(tones), 0.02))
    return layers


@asynccontextmanager
async def group_on(wire: str, rig: Rig, sent: bytearray) -> AsyncIterator[Group]:
    """An armed group of one amplifier on a wire; sent: where messages of python-can are noted."""
    if wire == PYTHON_CAN:
        async with group_behind_python_can(sent) as group:
            yield group
        return
    async with rig_on_wire(rig, WIRES[wire]) as hosted:
        await hosted.group.arm()
        yield hosted.group


@asynccontextmanager
async def group_behind_python_can(sent: bytearray) -> AsyncIterator[Group]:
    """An armed group of one amplifier, whose frames pass through messages of python-can."""
    loop = asyncio.get_running_loop()
    line = Line(CanWire(500_000, sequence=0), "can0")
    far_end = CanAmplifiers({1: SimulatedAmplifier("main", channels=4)}, line.received)
    read_end, write_end = os.pipe()

    def send(message: can.Message) -> None:
        data = bytes(message.data)
        sent.extend(f"{message.arbitration_id:03X}#{data.hex()}\n".encode())
        frames = pack_frames([CanFrame(message.arbitration_id, data)])
        loop.call_soon(far_end.receive, frames, loop.time())

    bus = Mock(send=send, recv=lambda timeout: None, fileno=lambda: read_end)
    interface = Interface(is_watched=True, sends_at_once=True)
    port = BusPort(bus, "can0", line.received, pytest.fail, interface)
    line.open(port)
    group = Group({"main": Amplifier(line, 1, LIMITS, name="main")})
    try:
        await group.open()
        await group.arm()
        yield group
    finally:
        port.close()
        await port.wait_closed()
        os.close(read_end)
        os.close(write_end)


async def play(group: Group, case: Case) -> Tones:
    """Play a set, and read back the achieved tones."""
    ((name, amplifier),) = group.amplifiers.items()
    await group.apply({name: layers_of(case)})
    achieved: dict[tuple[int, int], Tone] = {}
    for layer in {layer for layer, _ in case.tones}:
        reply = await amplifier.request("GetAchieved", {"layer": layer}, Priority.OTHER)
        achieved.update(tones_achieved(layer, reply))
    return achieved


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("wire", DECODERS)
def test_wire_carries_amplitude_frequency_and_phase_of_every_channel(
    wire: str, case: str, coarse_rig: Rig
) -> None:
    """The bytes of a set, decoded by the pages of the protocol, have the tones of the command.

    The achieved tones of a simulated amplifier are the same.
    """
    sent = bytearray()

    def note(link: str, toward: str, data: bytes) -> None:
        if toward == "amplifier":
            sent.extend(data)

    async def run() -> Tones:
        async with group_on(wire, coarse_rig, sent) as group:
            return await play(group, CASES[case])

    achieved = run_virtual(run(), seen=note)
    expected = CASES[case].tones
    decoded = sent_tones(DECODERS[wire](bytes(sent)), CASES[case].parts)
    assert_same_tones(expected, decoded, f"sent over {wire}")
    assert_same_tones(expected, achieved, f"achieved over {wire}")
