"""Numbers that follow each other: tokens of sets, and latches of stops and faults."""

from drivers.protocol.table import QUANTITIES

_SPAN = 1 << 16
_LAST = QUANTITIES["token"].maximum


def token_after(number: int) -> int:
    """Return the number after this one, 0 before the first: 1..65535, then 1 again."""
    return number % _LAST + 1


def is_newer_token(number: int, than: int) -> bool:
    """Whether one follows another by less than half of 2^16 (RFC 1982); any follows 0, none."""
    return than == 0 or 0 < (number - than) % _SPAN < _SPAN // 2
