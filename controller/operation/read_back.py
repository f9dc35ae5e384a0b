"""Read-back of disarmed amplifiers: silent and without a fault."""

from collections.abc import Mapping

from drivers.host.amplifier import Amplifier
from drivers.protocol.definition import FAULTS, STATES, name_of
from drivers.protocol.records import Values

READ_BACK_INTERVAL = 0.02  # s

_ENABLED = STATES["OPERATION_ENABLED"]
_DISARMED = (STATES["SWITCH_ON_DISABLED"],)


def are_silent(statuses: Mapping[str, Values], amplifiers: Mapping[str, Amplifier]) -> bool:
    """Whether all amplifiers report that nothing plays, and nothing can before they are armed."""
    return not is_any_armed(statuses) and all(
        amplifiers[name].is_silent(status) for name, status in statuses.items()
    )


def is_any_armed(statuses: Mapping[str, Values]) -> bool:
    """Whether an amplifier reports that it is armed."""
    return any(each["state"] == _ENABLED for each in statuses.values())


def find_problem(statuses: Mapping[str, Values], amplifiers: Mapping[str, Amplifier]) -> str | None:
    """Describe the first amplifier that is not disarmed, not at level zero or in a fault."""
    for name, status in statuses.items():
        if status["state"] not in _DISARMED or status["fault"]:
            fault = f", fault {name_of(FAULTS, status['fault'])}" if status["fault"] else ""
            return f"amplifier {name} is in {name_of(STATES, status['state'])}{fault}"
        if not amplifiers[name].is_silent(status):
            return (
                f"amplifier {name}: levels of all channels must be 0 while it is disarmed, got "
                f"{status['levels']}"
            )
    return None
