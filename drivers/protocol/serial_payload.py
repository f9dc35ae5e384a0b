"""Hello and its reply on a serial line, which keep their bytes in every version of the protocol.

versions u16 · vendor · product · serial number · firmware, each a length u8 and UTF-8
"""

import struct
from collections.abc import Sequence

from drivers.protocol.records import Refusal, Values

HELLO = 1
"""Its number."""
BROADCAST = 0
"""The address of all amplifiers on a line."""
_TEXTS = ("vendor", "product", "serial_number", "firmware")
_TEXT_MAX = 32


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
    raw = [identity[name].encode()[:_TEXT_MAX].decode(errors="ignore").encode() for name in _TEXTS]
    texts = b"".join(bytes([len(text)]) + text for text in raw)
    return int(identity["versions"]).to_bytes(2, "little") + texts


def unpack_identity(payload: bytes) -> Values:
    """Read the payload; what follows is ignored. Raises Refusal."""
    identity: Values = {"versions": int.from_bytes(payload[:2], "little")}
    at = 2
    for name in _TEXTS:
        end = at + 1 + payload[at] if at < len(payload) else at
        if end > len(payload) or end == at or end - at > _TEXT_MAX + 1:
            raise Refusal(f"{name} must have at most {_TEXT_MAX} bytes", "BAD_LENGTH")
        try:
            identity[name] = payload[at + 1 : end].decode("utf-8")
        except UnicodeDecodeError:
            raise Refusal(f"{name} must be UTF-8") from None
        if not identity[name].isprintable():
            raise Refusal(f"{name} must not have control characters")
        at = end
    return identity


def speaks(identity: Values, version: int) -> bool:
    """Whether an amplifier speaks a version: bit n is version n."""
    return bool(identity["versions"] >> version & 1)
