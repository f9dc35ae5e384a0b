"""Whether an amplifier is the expected one, and its capabilities leave something to play."""

from drivers.errors import LinkError
from drivers.protocol.records import Values, bits_of
from drivers.protocol.serial_payload import speaks
from drivers.protocol.table import VERSION, has_feature

_POSITIVE = ("frequency_step", "level_step", "phase_step")
_FULL_LEVEL = ("motion of a stiff source", "output of a linear amplifier")


def check_identity(identity: Values, name: str, serial_number: str | None) -> None:
    """Raise LinkError unless an amplifier of a name speaks this version and is the expected one.

    serial_number: the expected one, None for any.
    """
    if not speaks(identity, VERSION):
        spoken = map(str, bits_of(identity["versions"]))
        raise LinkError(
            f"amplifier {name} speaks protocol {', '.join(spoken) or 'none'}, needs {VERSION}; "
            "update it"
        )
    serial = identity["serial_number"]
    if serial_number not in (None, serial):
        raise LinkError(
            f"amplifier {name}: serial number must be {serial_number}, got {serial}; connect the "
            "expected amplifier, or restart with this one"
        )


def check_capabilities(can: Values, name: str, *, is_output: bool | None) -> None:
    """Raise LinkError for capabilities that no amplifier can have, or other than the rig's.

    is_output: what the rig says of full level: the output of a linear amplifier, else a motion;
    None where there is no rig.
    """
    for each in _POSITIVE:
        if not can[each] > 0:
            raise LinkError(f"amplifier {name}: {each} must be above 0, got {can[each]}")
    for each in ("watchdog", "envelope_step", "frequency"):
        low, high = can[f"{each}_min"], can[f"{each}_max"]
        if low > high:
            raise LinkError(
                f"amplifier {name}: {each}_min must be at most {each}_max, got {low} and {high}"
            )
    has_output = has_feature(can, "output")
    if is_output is not None and has_output is not is_output:
        raise LinkError(
            f"amplifier {name}: full level must be {_FULL_LEVEL[is_output]} as in the rig file, "
            f"got {_FULL_LEVEL[has_output]}; correct the rig file, or connect another amplifier"
        )
