"""The pages of protocol 4: a frame of each wire by hand, the files for masters and monitors."""

import re
import textwrap
from pathlib import Path

import canopen
import cantools
import pytest

from protocol_bytes import BYTES
from sim.amplifier.contract import Amplifier
from sim.far_ends.can_bus.word_objects import ObjectServer

DOCS = Path(__file__).parents[2] / "docs" / "reference"

# Worked out from docs/decisions/0061-protocol-3.md and the standards, not by our codecs.
BY_HAND = {
    ("serial", "Set: 170 bytes"): """
> 00 05 05 03 01 08 06 17 2A 02 01 02 02 04 02 14 04 F4 01 08 05 98 08 D0 07 01 02 18 08 98 08 4C
  04 D8 DC 28 08 98 08 58 02 BC 34 38 08 98 08 90 01 02 08 84 02 14 04 F4 01 08 08 B8 0B F4 01 70
  17 18 05 B8 0B 08 07 01 02 28 08 B8 0B 84 03 6C EE 38 0A B8 0B BC 02 68 42 04 01 14 04 F4 01 08
  08 D8 0E 20 03 20 D1 18 08 D8 0E 2C 01 DC 05 28 05 D8 0E 34 08 01 02 38 0A D8 0E E8 03 4C 1D 84
  01 14 03 F4 01 01 08 C0 12 58 02 28 23 10 08 C0 12 B0 04 18 FC 20 08 C0 12 F4 01 77 E8 30 05 C0
  12 C4 09 01 05 96 30 CC 9C 00
< 00 05 85 03 01 08 04 02 01 06 01 01 05 A3 4B 5B 17 00
""",
    ("modbus", "Set: written, then its reply read"): """
> 00 01 00 00 00 A7 01 10 05 00 00 50 A0 00 01 2A 17 01 02 00 02 00 04 00 14 01 F4 00 08 08 98 07
  D0 00 00 00 18 08 98 04 4C DC D8 00 28 08 98 02 58 34 BC 00 38 08 98 01 90 08 02 00 84 00 14 01
  F4 00 08 0B B8 01 F4 17 70 00 18 0B B8 07 08 00 00 00 28 0B B8 03 84 EE 6C 00 38 0B B8 02 BC 42
  68 01 04 00 14 01 F4 00 08 0E D8 03 20 D1 20 00 18 0E D8 01 2C 05 DC 00 28 0E D8 08 34 00 00 00
  38 0E D8 03 E8 1D 4C 01 84 00 14 01 F4 00 00 12 C0 02 58 23 28 00 10 12 C0 04 B0 FC 18 00 20 12
  C0 01 F4 E8 77 00 30 12 C0 09 C4 00 00
< 00 01 00 00 00 06 01 10 05 00 00 50
> 00 02 00 00 00 06 01 04 05 80 00 05
< 00 02 00 00 00 0D 01 04 0A 00 01 00 00 01 02 00 06 00 00
""",
    ("modbus", "The commit on RTU"): """
> 01 10 06 00 00 03 06 00 01 2A 17 01 02 FD 85
< 01 10 06 00 00 03 80 80
""",
    ("can", "Set: 27 frames"): """
> 201 08 00 05 4F 17 2A 02 01
> 201 08 01 02 00 04 00 14 00
> 201 08 02 F4 01 08 00 98 08
> 201 08 03 D0 07 00 00 18 00
> 201 08 04 98 08 4C 04 D8 DC
> 201 08 05 28 00 98 08 58 02
> 201 08 06 BC 34 38 00 98 08
> 201 08 07 90 01 02 08 84 00
> 201 08 08 14 00 F4 01 08 00
> 201 08 09 B8 0B F4 01 70 17
> 201 08 0A 18 00 B8 0B 08 07
> 201 08 0B 00 00 28 00 B8 0B
> 201 08 0C 84 03 6C EE 38 00
> 201 08 0D B8 0B BC 02 68 42
> 201 08 0E 04 01 14 00 F4 01
> 201 08 0F 08 00 D8 0E 20 03
> 201 08 10 20 D1 18 00 D8 0E
> 201 08 11 2C 01 DC 05 28 00
> 201 08 12 D8 0E 34 08 00 00
> 201 08 13 38 00 D8 0E E8 03
> 201 08 14 4C 1D 84 01 14 00
> 201 08 15 F4 01 00 00 C0 12
> 201 08 16 58 02 28 23 10 00
> 201 08 17 C0 12 B0 04 18 FC
> 201 08 18 20 00 C0 12 F4 01
> 201 08 19 77 E8 30 00 C0 12
> 201 08 1A C4 09 00 00 00 00
< 181 08 00 05 03 02 01 06 00
< 181 08 01 00 00 00 00 00 00
""",
}


def frames(text: str) -> list[str]:
    """What goes over the line, a string for each frame; long ones go on in lines of their own."""
    return re.sub(r"\n {2}", " ", text).strip().splitlines()


def shown(page: str, title: str) -> list[str]:
    """The frames that `make pages` writes below a title of a page."""
    text = "\n".join(textwrap.dedent(write()) for write in BYTES[page].values())
    return frames(text.split(f"# {title}\n")[1].partition("\n#")[0])


@pytest.mark.parametrize(("page", "title"), BY_HAND)
def test_frames_by_hand_are_those_of_both_codecs(page: str, title: str) -> None:
    """A message with many words, its reply, and a checksum where the wire has one."""
    by_hand = frames(BY_HAND[page, title])
    assert shown(page, title)[: len(by_hand)] == by_hand


def test_monitor_reads_the_frames_of_the_page_by_the_dbc() -> None:
    """`cantools` finds type, number and words of the set, as protocol.md lists them."""
    database = cantools.database.load_file(DOCS / "amplifier.dbc")
    words: dict[str, object] = {}
    for frame in shown("can", "Set: 27 frames"):
        if frame.startswith(">"):
            identifier, data = int(frame[2:5], 16), bytes.fromhex(frame[6:])
            words |= database.decode_message(identifier, data)
    assert (words["number"], words["type"], words["words"]) == (8, "Set", 79)
    listed = re.findall(r"^    ((?:[0-9A-F]{4} )+)", BYTES["protocol"]["set"](), re.MULTILINE)
    expected = [int(word, 16) for words in listed for word in words.split()]
    assert [words[f"word_{at}"] for at in range(79)] == expected


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
