"""The pages of protocol 3: their bytes, worked out by hand, against the codecs of both ends."""

import re
from collections.abc import Sequence
from pathlib import Path

import canopen
import cantools
import pytest

from drivers.playing.contents import Layer, Tone
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, Envelope, LayerSet, pack_layers, parts, unpack_layers
from drivers.protocol.table import MESSAGES, QUANTITIES
from drivers.wires.can_bus.frames import unpack_frames
from drivers.wires.can_bus.host import CanWire
from drivers.wires.modbus.host import ModbusWire
from drivers.wires.serial_line.host import SerialWire
from drivers.wires.wire import More, Wire
from protocol_tables import FILES, PARTS, WRITER, written
from sim.amplifier.contract import Amplifier
from sim.far_ends.can_bus.amplifiers import CanAmplifiers
from sim.far_ends.can_bus.word_objects import ObjectServer
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from sim.far_ends.serial_amplifiers import SerialAmplifiers

DOCS = Path(__file__).parents[2] / "docs" / "reference"
SESSION, TOKEN = 0x2A17, 0x0102
Lines = list[tuple[str, str]]  # "<" or ">", and bytes as text

# What protocol.md says in words: frequency, then level and phase of each channel.
TONES = (
    (110.0, ((0.2, 0.0), (0.11, -90.0), (0.06, 135.0), (0.04, 20.5))),
    (150.0, ((0.05, 60.0), (0.18, 0.0), (0.09, -45.0), (0.07, 170.0))),
    (190.0, ((0.08, -120.0), (0.03, 15.0), (0.21, 0.0), (0.1, 75.0))),
    (240.0, ((0.06, 90.0), (0.12, -10.0), (0.05, -60.25), (0.25, 0.0))),
)
BEFORE = ((0.22, 0.1, 0.05, 0.03), (0.04, 0.2, 0.08, 0.06), (0.07, 0.02, 0.23, 0.09))


def page(name: str) -> str:
    """The text of a page."""
    return (DOCS / f"{name}.md").read_text("utf-8")


def shown(text: str) -> dict[str, Lines]:
    """What goes over the line on a page, by title."""
    found: dict[str, Lines] = {}
    for line in text.splitlines():
        if line.startswith("    # "):
            lines = found.setdefault(line.removeprefix("    # "), [])
        elif line.startswith(("    > ", "    < ")):
            lines.append((line[4], line[6:]))
        elif found and re.fullmatch(r"      [0-9A-F ]+", line):
            direction, data = lines.pop()
            lines.append((direction, f"{data} {line.strip()}"))
    return found


def wire_set(layers: Sequence[Layer]) -> Sequence[LayerSet]:
    """Layers in units of the wire, by the steps of the table."""
    wire = QUANTITIES

    def command(tone: Tone) -> Command:
        numbers = (
            wire[name].to_wire(getattr(tone, name)) for name in ("frequency", "level", "phase")
        )
        return Command(tone.channel, *numbers, keep_phase=tone.keep_phase)

    return [
        LayerSet(
            *(each.number, wire["ramp"].to_wire(each.ramp)),
            *(wire["valid_for"].to_wire(each.valid_for), tuple(map(command, each.tones))),
        )
        for each in layers
    ]


class Exchange:
    """A host's wire and a simulated amplifier of four channels, at one moment; notes all bytes."""

    def __init__(self, kind: str, number: int) -> None:
        self.lines: Lines = []
        self.amplifier = Amplifier("a", channels=4)
        self.kind = kind
        is_rtu = kind == "rtu"
        far = {1: self.amplifier}
        self.wire: Wire
        self.end: SerialAmplifiers | ModbusAmplifiers | CanAmplifiers
        if kind == "serial":
            self.wire = SerialWire(921_600, sequence=number)
            self.end = SerialAmplifiers(far, self._replied)
        elif kind == "can":
            self.wire = CanWire(500_000, sequence=number)
            self.end = CanAmplifiers(far, self._replied)
        else:
            self.wire = ModbusWire(115_200 if is_rtu else 0, is_rtu=is_rtu, number=number)
            self.end = ModbusAmplifiers(far, self._replied, is_rtu=is_rtu)

    def request(self, name: str, values: Values, address: int = 1) -> Lines:
        """Send a request; what went over the line, this request's alone."""
        self.lines = []
        self._send(self.wire.request(address, name, values))
        return self.lines

    def _send(self, data: bytes) -> None:
        self._note(">", data)
        self.end.receive(data, 0.0)

    def _replied(self, data: bytes) -> None:
        self._note("<", data)
        for arrival in self.wire.received(data):
            if isinstance(arrival, More):
                self._send(arrival.data)

    def _note(self, direction: str, data: bytes) -> None:
        if self.kind != "can":
            self.lines.append((direction, data.hex(" ").upper()))
            return
        for frame in unpack_frames(data):
            self.lines.append((direction, f"{frame.id:03X} {frame.data.hex(' ').upper()}"))


def vibrating(kind: str, number: int, *before: str) -> Exchange:
    """Armed, three layers vibrate; then requests of which the page says nothing."""
    exchange = Exchange(kind, number)
    exchange.amplifier.handle("Arm", {"session": SESSION, "watchdog": 250}, 0.0)
    layers = [
        Layer(number, tuple(Tone(channel, TONES[number][0], level) for channel, level in rows), 0.0)
        for number, rows in enumerate(map(enumerate, BEFORE))
    ]
    (part,) = parts(pack_layers(wire_set(layers)), session=SESSION, token=TOKEN - 1, now=True)
    exchange.amplifier.handle("Set", part, 0.0)
    for name in before:
        exchange.request(name, JOIN_SET if name == "Set" else {})
    return exchange


LAYERS = [
    Layer(
        number,
        tuple(
            Tone(channel, frequency, level, phase, keep_phase=number < 3)
            for channel, (level, phase) in enumerate(tones)
        ),
        *(0.02, 0.5),
    )
    for number, (frequency, tones) in enumerate(TONES)
]
(JOIN_SET,) = parts(pack_layers(wire_set(LAYERS)), session=SESSION, token=TOKEN, now=False)
COMMIT = {"session": SESSION, "token": TOKEN}
STOP = {"ramp": 5}
MORE: tuple[tuple[str, Values, int], ...] = (
    ("Hello", {}, 1),
    ("Arm", {"session": SESSION, "watchdog": 250}, 1),
    ("Ping", {"session": 7}, 1),
)


def played(kind: str) -> list[Lines]:
    """All that a page shows, in its order, by both codecs."""
    more = [*MORE]
    if kind == "modbus":  # the host knows the size of a status once it has read the capabilities
        first, second = vibrating("tcp", 65533, "GetCaps"), Exchange("tcp", 65533)
        second.request("GetCaps", {})
        rtu = vibrating("rtu", 65531, "GetCaps", "Set")
        tail = [rtu.request("Commit", COMMIT), rtu.request("Stop", STOP, 0)]
    else:
        hello = ("Hello",) if kind == "can" else ()
        first, second, tail = vibrating(kind, 7 - len(hello), *hello), Exchange(kind, 5), []
        more.append(("Stop", STOP, 0))
    join = [first.request("Set", JOIN_SET), first.request("Commit", COMMIT)]
    return [*join, *(second.request(*each) for each in more), *tail]


@pytest.mark.parametrize("kind", ["serial", "modbus", "can"])
def test_bytes_of_the_pages_are_those_of_both_codecs(kind: str) -> None:
    """Every byte of host and amplifier; the pages were written by hand from the decision."""
    assert [*shown(page(kind)).values()] == played(kind)


def words_of(block: str) -> list[int]:
    """Words in hexadecimal, without what stands behind them."""
    found = []
    for line in block.splitlines():
        for piece in (
            line.split("·") if " · " in line and re.search(r"· [0-9A-F]{4} ", line) else [line]
        ):
            match = re.match(r"\s*((?:[0-9A-F]{4}(?:\s|$))+)", piece)
            found += [] if match is None else [int(word, 16) for word in match[1].split()]
    return found


def test_words_of_the_first_page_are_the_set() -> None:
    """79 words, those of the message; the reply and the status are those of the serial page."""
    text = page("protocol")
    blocks = re.findall(r"\n\n((?:    .+\n)+)", text[: text.index("## Words")])
    assert words_of(blocks[0]) == MESSAGES["Set"].request.pack(JOIN_SET)
    assert len(words_of(blocks[0])) == 79
    amplifier = vibrating("serial", 0, "Set").amplifier
    status = amplifier.handle("Commit", COMMIT, 0.0)
    assert words_of(blocks[1]) == MESSAGES["Commit"].reply.pack(status)


def test_stream_of_the_first_page_means_what_stands_beside_it() -> None:
    """Two commands, one with an onset; a layer that ends; one that is renewed."""
    text = page("protocol")
    (block,) = re.findall(r"\n\n((?:    .+\n)+)", text[text.index("## Sets") :])[:1]
    onset = Envelope(50, ((1000, 9000), (10000, -1)))
    commands = (
        Command(0, 2200, 2000, 0),
        Command(3, 5010, 10000, -9000, keep_phase=True, onset=onset),
    )
    assert unpack_layers(words_of(block)) == (
        LayerSet(0, 20, 500, commands),
        LayerSet(2, 10, 0),
        LayerSet(3, 0, 800, renew=True),
    )


@pytest.mark.parametrize("name", PARTS)
def test_tables_of_the_pages_are_those_of_the_definition(name: str) -> None:
    """Written anew by the program that stands in the page."""
    text = (DOCS / name).read_text("utf-8")
    assert written(text, name) == text, f"python {WRITER} docs/reference"


@pytest.mark.parametrize("name", FILES)
def test_data_sheets_are_those_of_the_definition(name: str) -> None:
    """Written anew by the same program."""
    assert (DOCS / name).read_text("utf-8") == FILES[name](), f"python {WRITER} docs/reference"


def test_monitor_reads_the_frames_of_the_page_by_the_dbc() -> None:
    """`cantools` finds type, number of words and every word of the set."""
    database = cantools.database.load_file(DOCS / "amplifier.dbc")
    words: dict[str, object] = {}
    for direction, frame in shown(page("can"))["Set: 27 frames"]:
        if direction == ">":
            identifier, data = int(frame[:3], 16), bytes.fromhex(frame[4:])
            words |= database.decode_message(identifier, data)
    assert (words["number"], words["type"], words["words"]) == (8, "Set", 79)
    assert [words[f"word_{at}"] for at in range(79)] == MESSAGES["Set"].request.pack(JOIN_SET)


def test_master_finds_the_objects_of_the_eds_in_the_amplifier() -> None:
    """`canopen` reads it; every object has the subindices and sizes that the far end serves."""
    sheet = canopen.import_od(str(DOCS / "amplifier.eds"), node_id=1)
    objects = ObjectServer(Amplifier("a", channels=4), 1)
    for index, entry in sheet.items():
        if index < 0x1000:
            continue
        if isinstance(entry, canopen.objectdictionary.ODVariable):
            assert len(objects.read(index, 0, 0.0)) == len(entry) // 8
            continue
        assert objects.read(index, 0, 0.0)[0] == len(entry) - 1 == max(entry)
        for subindex, each in entry.items():
            served = objects.read(index, subindex, 0.0)
            if each.data_type != canopen.objectdictionary.VISIBLE_STRING:
                assert len(served) == len(each) // 8
    number = list(sheet[0x2001].names).index("limits 3 level_max")
    limits = objects.read(0x2001, number, 0.0)
    assert int.from_bytes(limits, "little") == 10000
