"""Where messages are in the registers of a unit, for both ends; no I/O.

Message n is written from register 256 n on (tag, words), its reply read from 256 n + 128 on (tag,
result, words).
"""

import struct
from collections.abc import Mapping, Sequence

from drivers.protocol.records import TEXT_MAX, Values
from drivers.protocol.table import MAX_WORDS, TEXTS

BOX, REPLY, HEAD = 256, 128, 2
"""Registers of a message, offset of its reply, registers of that before its words."""
AREA = HEAD + MAX_WORDS
"""Registers of a reply, with zeros behind it."""
IDENTITY, IDENTITY_COUNT = 1065, 2 + len(TEXTS) * TEXT_MAX // 2
"""First register of the identity (tag 0, versions, texts padded with zeros), and their number."""
PRESENT = ("GetCaps", "GetStatus", "GetFaults")
"""Messages whose replies are of the moment at which they are read, written before or not."""
EXCEPTIONS: Mapping[int, str] = {
    **dict.fromkeys((1, 2), "UNKNOWN_TYPE"),
    3: "BAD_LENGTH",
    **dict.fromkeys((5, 6), "BUSY"),
}
"""Refusals that exceptions stand for."""


def pack_identity(identity: Values) -> Sequence[int]:
    """Return the registers of an identity."""
    texts = b"".join(field.encoded(identity).ljust(TEXT_MAX, b"\0") for field in TEXTS)
    return (0, identity["versions"], *struct.unpack(f">{len(texts) // 2}H", texts))


def unpack_identity(registers: Sequence[int]) -> Values:
    """Read the registers of an identity; raises Refusal."""
    raw = struct.pack(f">{len(registers)}H", *registers)
    identity: Values = {"versions": registers[1]}
    for number, field in enumerate(TEXTS):
        text = raw[4 + number * TEXT_MAX :][:TEXT_MAX].rstrip(b"\0")
        field.read(text, len(text), identity)
    return identity
