"""The example bytes on docs/reference/{protocol,serial,modbus,can}.md.

They show a set with its commit, and other requests, exchanged between the host's code for a wire
and a simulated amplifier.
"""

import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import MESSAGES, QUANTITIES, clock_at, high_word
from drivers.protocol.records import Bits, Number, Numbers, Record, Rest, Rows, Values
from drivers.protocol.sets import Command, Envelope, LayerSet, is_last, pack_layers, parts
from drivers.wires.can_bus import CanWire
from drivers.wires.can_frames import unpack_frames
from drivers.wires.modbus import ModbusWire
from drivers.wires.serial_line import SerialWire
from drivers.wires.wire import Continuation, Wire
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.can_amplifiers import CanAmplifiers
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from sim.far_ends.serial_amplifiers import SerialAmplifiers

SESSION, TOKEN = 0x2A17, 0x0102
_NOW = 7.5
"""Time [s] of all examples: three eighths of a turn of the clock."""
_BYTES_PER_LINE = 32

# The example of protocol.md: frequency, then level and phase of each channel.
_TONES = (
    (110.0, ((0.2, 0.0), (0.11, -90.0))),
    (240.0, ((0.25, 0.0), (0.12, -10.0))),
)
_BEFORE = ((0, 110.0, (0.22, 0.1)), (2, 150.0, (0.04, 0.2)), (3, 190.0, (0.07, 0.02)))
"""Layers that already play: number, frequency, levels."""
_ONSET = (0.005, ((0.1, 90.0), (0.3, -0.01)))
"""Step and knots of the new tone on channel 0."""


def _integer(name: str, value: float) -> int:
    return QUANTITIES[name].to_wire(value)


def _wire_set(layers: Sequence[AmplifierLayer]) -> list[LayerSet]:
    """Return layers in integers of the wire."""

    def command(tone: AmplifierTone) -> Command:
        level, phase = _integer("level", tone.level), _integer("phase", tone.phase)
        frequency = _integer("frequency", tone.frequency)
        return Command(tone.channel, frequency, level, phase, keep_phase=tone.keep_phase)

    return [
        LayerSet(
            *(each.number, _integer("ramp", each.ramp), _integer("valid_for", each.valid_for)),
            tuple(map(command, each.tones)),
        )
        for each in layers
    ]


def _joined() -> list[LayerSet]:
    """Return a set: layer 0 changes, 1 starts with an onset, 2 is silenced, 3 is renewed."""
    changed, begun = _wire_set(
        [
            AmplifierLayer(
                number,
                tuple(
                    AmplifierTone(channel, frequency, level, phase, keep_phase=number == 0)
                    for channel, (level, phase) in enumerate(tones)
                ),
                *(0.02, 0.5),
            )
            for number, (frequency, tones) in enumerate(_TONES)
        ]
    )
    step, knots = _ONSET
    onset = Envelope(
        _integer("envelope_step", step),
        tuple((_integer("level", level), _integer("phase", phase)) for level, phase in knots),
    )
    first, *others = begun.commands
    begun = replace(begun, commands=(replace(first, onset=onset), *others))
    return [changed, begun, LayerSet(2, 10, 0), LayerSet(3, 0, 800, renew=True)]


def _parts() -> list[tuple[Values, Sequence[LayerSet]]]:
    """Return the parts of the set with their layers; the first part has one layer."""
    first, *others = _joined()
    head = {"session": SESSION, "token": TOKEN, "parts": 2, "now": 0}
    return [
        ({**head, "index": index, "stream": pack_layers(layers)}, layers)
        for index, layers in enumerate(([first], others))
    ]


_PARTS = _parts()
_ARM = {"session": SESSION, "watchdog": 250, "shift": 0}
_COMMIT = {"session": SESSION, "token": TOKEN, "at": high_word(clock_at(_NOW))}
_STOP = {"ramp": 5}


class _Exchange:
    """A host's wire and a simulated amplifier with four channels, at a fixed time; logs all bytes.

    kind: serial, tcp, rtu or can; number: sequence, tag or number of the last request.
    """

    def __init__(self, kind: str, number: int) -> None:
        self.amplifier = SimulatedAmplifier("a", channels=4)
        self._lines: list[str] = []
        self._is_can, self._is_tcp = kind == "can", kind == "tcp"
        far = {1: self.amplifier}
        self._wire: Wire
        self._end: SerialAmplifiers | ModbusAmplifiers | CanAmplifiers
        if kind == "serial":
            self._wire = SerialWire(921_600, sequence=number)
            self._end = SerialAmplifiers(far, self._replied)
        elif self._is_can:
            self._wire = CanWire(500_000, sequence=number)
            self._end = CanAmplifiers(far, self._replied)
        else:
            is_rtu = kind == "rtu"
            self._wire = ModbusWire(115_200 if is_rtu else 0, is_rtu=is_rtu, number=number)
            self._end = ModbusAmplifiers(far, self._replied, is_rtu=is_rtu)

    def request(self, name: str, values: Values, address: int = 1) -> list[str]:
        """Send a request; return the frames in both directions, a line for each."""
        self._lines = []
        has_reply = address > 0 and (name != "Set" or is_last(values))
        self._send(self._wire.request(address, name, values, has_reply=has_reply))
        return self._lines

    def _send(self, data: bytes) -> None:
        self._note(">", data)
        self._end.receive(data, _NOW)

    def _replied(self, data: bytes) -> None:
        self._note("<", data)
        for arrival in self._wire.received(data):
            if isinstance(arrival, Continuation):
                self._send(arrival.data)

    def _note(self, direction: str, data: bytes) -> None:
        frames = [(each.id, each.data) for each in unpack_frames(data)] if self._is_can else []
        for identifier, content in frames:
            self._lines.append(f"{direction} {identifier:03X} {content.hex(' ').upper()}")
        while data and not self._is_can:
            # TCP can join messages; a message contains the number of bytes after its sixth.
            size = 6 + int.from_bytes(data[4:6], "big") if self._is_tcp else len(data)
            self._lines.append(f"{direction} {data[:size].hex(' ').upper()}")
            data = data[size:]


def _vibrating(kind: str, number: int, *before: str) -> _Exchange:
    """Return an exchange with an armed amplifier that plays three layers, after requests."""
    exchange = _Exchange(kind, number)
    exchange.amplifier.handle("Arm", _ARM, _NOW)
    layers = [
        AmplifierLayer(
            number,
            tuple(AmplifierTone(at, frequency, level) for at, level in enumerate(levels)),
            0.0,
        )
        for number, frequency, levels in _BEFORE
    ]
    (part,) = parts(pack_layers(_wire_set(layers)), session=SESSION, token=TOKEN - 1, now=True)
    exchange.amplifier.handle("Set", part, _NOW)
    for name in before:
        exchange.request(name, {})
    return exchange


def _block(shown: Mapping[str, Sequence[str]]) -> str:
    """Return the frames of requests, below their titles, as a code block."""
    lines = list[str]()
    for title, frames in shown.items():
        lines.append(f"# {title}")
        for frame in frames:
            lines += textwrap.wrap(frame, 2 + 3 * _BYTES_PER_LINE, subsequent_indent="  ")
    return textwrap.indent("\n".join(lines), "    ")


_KINDS: Mapping[str, str] = {"serial": "serial", "modbus": "tcp", "can": "can"}
_FIRST: Mapping[str, tuple[int, str]] = {
    **{"serial": (7, ""), "modbus": (65533, "GetCaps"), "can": (6, "Hello")}
}
"""Last number before the set, and requests before it that the page omits."""


def _join(page: str) -> str:
    """Return the set and its commit."""
    number, before = _FIRST[page]
    exchange = _vibrating(_KINDS[page], number, *before.split())
    first, last = (exchange.request("Set", part) for part, _ in _PARTS)
    return _block(
        {
            "Set, part 0 of 2, without a reply": first,
            "Set, part 1 of 2": last,
            "Commit": exchange.request("Commit", _COMMIT),
        }
    )


def _rtu() -> str:
    """Return the commit on Modbus RTU, and a broadcast."""
    exchange = _vibrating("rtu", 65533, "GetCaps")
    for part, _ in _PARTS:
        exchange.amplifier.handle("Set", part, _NOW)
    return _block(
        {
            "The commit on RTU": exchange.request("Commit", _COMMIT),
            "Stop with a ramp of 5 ms, to all, on RTU": exchange.request("Stop", _STOP, 0),
        }
    )


_MORE: Mapping[str, Sequence[str]] = {
    "serial": ("", ": an Event, then the reply", "", ": an Event, no reply"),
    "modbus": (": the identity is read", "", ": code 10, no channel"),
    "can": (
        ": NMT start, object 2000 subindex 5, the message",
        *(": an Event, then the reply", "", ": an Event, no reply"),
    ),
}
"""Remarks about Hello, Arm, Ping and Stop on each wire."""


def _more(page: str) -> str:
    """Return requests to an initially disarmed amplifier."""
    requests: Sequence[tuple[str, str, Values, int]] = (
        ("Hello", "Hello", {}, 1),
        (f"Arm with session {SESSION:04X}, watchdog 250 ms", "Arm", _ARM, 1),
        ("Ping of another session, refused", "Ping", {"session": 7, "rate": 0}, 1),
        ("Stop with a ramp of 5 ms, to all", "Stop", _STOP, 0),
    )
    number, before = _FIRST[page]
    exchange = _Exchange(_KINDS[page], number if page == "modbus" else 5)
    if page == "modbus":
        exchange.request(before, {})
    return _block(
        {
            title + seen: exchange.request(name, values, address)
            for (title, name, values, address), seen in zip(requests, _MORE[page], strict=False)
        }
    )


_READINGS: Sequence[tuple[str, Values]] = (
    ("GetCaps", {}),
    ("GetStatus", {}),
    ("GetFaults", {}),
    ("GetAchieved", {"layer": 0}),
)
"""Requests that an amplifier answers before it is armed."""


def _readings() -> str:
    """Return the readings of a disarmed amplifier on a serial line, and the words of replies."""
    exchange = _Exchange("serial", 9)
    frames = {name: exchange.request(name, values) for name, values in _READINGS}
    rows = list[tuple[Sequence[int], str]]()
    for name, values in _READINGS:
        reply = exchange.amplifier.handle(name, values, _NOW)
        rows += _titled(_REPLY_NAMES[name], MESSAGES[name].reply, reply)
    return f"{_block(frames)}\n\n{_words(rows)}"


_REPLY_NAMES = {
    "GetCaps": "Capabilities",
    "GetStatus": "Status",
    "GetFaults": "Faults",
    "GetAchieved": "Achieved",
}


def _words(rows: Iterable[tuple[Sequence[int], str]]) -> str:
    """Return rows of words with their explanations, as a code block."""
    shown = [(" ".join(f"{word % 0x10000:04X}" for word in words), text) for words, text in rows]
    width = max(len(words) for words, _ in shown)
    return "\n".join(f"    {words:{width}}   {text}" for words, text in shown)


def _stream(layers: Iterable[LayerSet]) -> Iterator[tuple[Sequence[int], str]]:
    """Yield the words of a stream with their meaning, by layer, command and envelope."""
    for layer in layers:
        stream = pack_layers([layer])
        head, at = stream[:3], 3
        count = len(layer.commands)
        yield (
            head,
            " · ".join(
                [
                    f"layer {layer.layer}"
                    + (
                        ", renewed"
                        if layer.renew
                        else f", {count} commands"
                        if count
                        else ", silenced"
                    ),
                    *([] if layer.renew else [f"ramp {layer.ramp} ms"]),
                    *([f"valid for {layer.valid_for} ms"] if layer.valid_for else []),
                ]
            ),
        )
        for command in layer.commands:
            yield stream[at : at + 4], _meaning(command)
            at += 4
            for name, shape in (("onset", command.onset), ("ending", command.ending)):
                if shape is not None:
                    size = 2 + 2 * len(shape.knots)
                    knots = "".join(
                        f" · {_level(level)} at {_phase(phase)}" for level, phase in shape.knots
                    )
                    step = 1000 * QUANTITIES["envelope_step"].from_wire(shape.step)
                    yield stream[at : at + size], f"{name}, a knot every {step:g} ms{knots}"
                    at += size


def _meaning(command: Command) -> str:
    frequency = QUANTITIES["frequency"].from_wire(command.frequency)
    keep = ", keep phase" if command.keep_phase else ""
    tone = f"{frequency:g} Hz · {_level(command.level)} · {_phase(command.phase)}"
    return f"channel {command.channel}{keep} · {tone}"


def _level(level: int) -> str:
    return f"level {QUANTITIES['level'].from_wire(level):g}"


def _phase(phase: int) -> str:
    return f"{QUANTITIES['phase'].from_wire(phase):g}°"


def _fields(record: Record, values: Values) -> Iterator[tuple[Sequence[int], str]]:
    """Yield the words of a record with the names of its fields, and the values of numbers."""
    words, at = record.pack(values), 0
    for field in record.fields:
        match field:
            case Number(name=name, quantity=quantity):
                size = 2 if quantity.wire == "u32" else 1
                number = f"{quantity.from_wire(values[name]):.10g} {quantity.unit}".strip()
                is_code = quantity.name in ("session", "token", "played_token", "clock", "at")
                text = f"{name} {f'{values[name]:0{4 * size}X}' if is_code else number}"
            case Bits(parts=parts):
                size, text = 1, ", ".join(f"{name} {values.get(name, 0):d}" for name, _ in parts)
            case Numbers(name=name, count=count):
                size, text = values[count], name
            case Rows(name=name, record=row_record):
                for row_number, row in enumerate(values[name]):
                    row_text = ", ".join(text for _, text in _fields(row_record, row))
                    yield row_record.pack(row), f"{name} {row_number}: {row_text}"
                continue
            case Rest():
                continue
            case _:
                raise TypeError(type(field))
        yield words[at : at + size], text
        at += size


def _in_lines(rows: Iterable[tuple[Sequence[int], str]]) -> Iterator[tuple[Sequence[int], str]]:
    """Join rows of a single word to lines of four words."""
    words, texts = list[int](), list[str]()
    for more, text in rows:
        if words and (len(words) == 4 or len(more) > 1):
            yield words, " · ".join(texts)
            words, texts = [], []
        if len(more) > 1:
            yield more, text
        else:
            words, texts = [*words, *more], [*texts, text]
    if words:
        yield words, " · ".join(texts)


def _join_words() -> str:
    """Return the words of the set, its commit, and both replies."""
    handle = _vibrating("serial", 7).amplifier.handle
    rows = list[tuple[Sequence[int], str]]()
    for part, layers in _PARTS:
        taken = handle("Set", part, _NOW)
        rows += [*_titled("Set", MESSAGES["Set"].request, part), *_stream(layers)]
    status = handle("Commit", _COMMIT, _NOW)
    return _words(
        [
            *rows,
            *_titled("Taken", MESSAGES["Set"].reply, taken),
            *_titled("Commit", MESSAGES["Commit"].request, _COMMIT),
            *_titled("Status", MESSAGES["Commit"].reply, status),
        ]
    )


def _titled(title: str, record: Record, values: Values) -> list[tuple[Sequence[int], str]]:
    (words, text), *others = _in_lines(_fields(record, values))
    return [(words, f"{title}: {text}"), *others]


BYTES: Mapping[str, Mapping[str, Callable[[], str]]] = {
    "protocol": {"join": _join_words},
    "serial": {
        "join": partial(_join, "serial"),
        "more": partial(_more, "serial"),
        "readings": _readings,
    },
    "modbus": {**{"join": partial(_join, "modbus"), "more": partial(_more, "modbus"), "rtu": _rtu}},
    "can": {"join": partial(_join, "can"), "more": partial(_more, "can")},
}
"""Writers of the blocks of bytes, by page and part."""
