"""Drive modes: the freedom with which ERAs are driven.

This is the only list of the modes. The help, the pages, the daemon and the Python API read it.
"""

from dataclasses import dataclass

from model.errors import InputError, shown


@dataclass(frozen=True)
class DriveMode:
    """A way to drive ERAs."""

    name: str
    """Name in options, files and the API."""
    meaning: str
    """How it drives the ERAs, for help and pages."""
    needs_phases: bool
    """Whether amplifiers must set levels and phases, rather than switch channels on and off."""


_MODES = (
    DriveMode(
        "switched",
        "one or two ERAs at full level, without phases, one vibration at a time",
        needs_phases=False,
    ),
    DriveMode("phased", "any levels and phases", needs_phases=True),
)
"""All modes, from the least freedom to the most."""

DRIVE_MODES = tuple(mode.name for mode in _MODES)
"""Names of the drive modes, from the least freedom to the most."""

UNRESTRICTED = "phased"
"""The drive mode with arbitrary weights, the only one with several vibrations at a time."""

MAX_PHASE_STEP = 10.0
"""Maximum phase step [degrees] of amplifiers that set phases; its RMS error is 3 degrees."""


def checked_mode(name: str, what: str = "drive mode") -> str:
    """Return the name of a drive mode; raises InputError for any other.

    what: its name in the message.
    """
    if name not in DRIVE_MODES:
        raise InputError(f"{what} must be one of {', '.join(DRIVE_MODES)}, got {shown(name)}")
    return name


def playable_drive_modes(*, level_step: float, phase_step: float) -> tuple[str, ...]:
    """Return the drive modes that an amplifier with steps of level and phase [degrees] can play.

    A level step of 1 means on or off.
    """
    sets_phases = level_step < 1 and phase_step <= MAX_PHASE_STEP
    return tuple(mode.name for mode in _MODES if sets_phases or not mode.needs_phases)


def drive_modes_in_words() -> str:
    """Return the drive modes with their meaning, for help texts, the default first."""
    return ", or ".join(f"{mode.name} ({mode.meaning})" for mode in reversed(_MODES))


def drive_mode_table() -> str:
    """Return a table of the drive modes for pages, as Markdown."""
    rows = [f"| `{mode.name}` | {mode.meaning} |" for mode in reversed(_MODES)]
    return "\n".join(["| drive mode | how the ERAs are driven |", "|---|---|", *rows])
