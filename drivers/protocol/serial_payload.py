"""Hello and its reply on a serial line, which keep their bytes in every version of the protocol.

versions u16 · vendor · product · serial number · firmware, each a length u8 and UTF-8
"""

import struct
from collections.abc import Sequence

from drivers.protocol.records import Refusal, Text, Values
from drivers.protocol.table import IDENTITY

HELLO = 1
"""Its number."""
BROADCAST = 0
"""The address of all amplifiers on a line."""
TEXTS = [field for field in IDENTITY.fields if isinstance(field, Text)]
"""Of an identity, in their order."""


def pack_words(words: Sequence[int]) -> bytes:
    """Return the payload of words."""
    return struct.pack(f"<{len(words)}H", *words)


def unpack_words(payload: bytes) -> tuple[int, ...]:
    """Return the words of a payload; Refusal for half a word."""
    if len(payload) % 2:
        raise Refusal("payload must have an even number of bytes", "BAD_LENGTH")
    return struct.unpack(f"<{len(payload) // 2}H", payload)


def pack_identity(identity: Values) -> bytes:
    """Return the payload of the reply; texts are cut at 32 bytes."""
    texts = [field.encoded(identity) for field in TEXTS]
    return int(identity["versions"]).to_bytes(2, "little") + b"".join(
        bytes([len(text)]) + text for text in texts
    )


def unpack_identity(payload: bytes) -> Values:
    """Read the payload; what follows is ignored. Raises Refusal."""
    identity: Values = {"versions": int.from_bytes(payload[:2], "little")}
    at = 2
    for field in TEXTS:
        if at >= len(payload):
            raise Refusal(f"{field.name} must not be missing", "BAD_LENGTH")
        end = at + 1 + payload[at]
        field.read(payload[at + 1 : end], payload[at], identity)
        at = end
    return identity


def speaks(identity: Values, version: int) -> bool:
    """Whether an amplifier speaks a version: bit n is version n."""
    return bool(identity["versions"] >> version & 1)
