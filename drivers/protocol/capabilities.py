"""What the capabilities of an amplifier must be, beside the ranges of their quantities."""

from collections.abc import Iterator

from drivers.protocol.records import Values

_WORD = 0xFFFF


def capability_ranges(can: Values) -> Iterator[tuple[str, int, int, int]]:
    """Yield the name of each number, the least that it may be, what it is, and the most."""
    for name in ("frequency_step", "level_step", "phase_step", "level_max"):
        yield name, 1, can[name], _WORD
    yield "voices", can["layers"], can["voices"], _WORD
    for name in ("frequency", "watchdog", "envelope_step"):
        yield f"{name}_max", can[f"{name}_min"], can[f"{name}_max"], _WORD
