"""Drive modes: which frequencies, amplitudes and phases the ERAs may have.

`switched` drives one or two ERAs at full stroke, each at a frequency of its own; `phased` all ERAs
at one frequency with any weights (`model.drive_modes.coherent`).

Symbols here and in `model.table`: f frequencies, p points under the fingers, q quiet fingertips, r
reduced modal coordinates; h field of an ERA at a point, R Hermitian form of the expected power at
the quiet fingertips, c right-hand side from the targets, w complex weights of the ERAs. In
`model.transients`, q are the modal coordinates and z those of the eigenvectors in time.
"""

from model.arguments import shown
from model.errors import InputError

MAX_PHASE_STEP = 10.0
"""Largest phase step [degrees] for `phased`: its rms error of 3 degrees is within the allowance."""

DRIVE_MODES = ("switched", "phased")
"""Drive modes, from the least freedom to the most."""

UNRESTRICTED = "phased"
"""The mode of any weights."""


def checked_mode(name: str, what: str = "drive mode") -> str:
    """Return the name of a drive mode; raises InputError for any other; what: its name there."""
    if name not in DRIVE_MODES:
        raise InputError(f"{what} must be one of {', '.join(DRIVE_MODES)}, got {shown(name)}")
    return name


def playable_drive_modes(*, level_step: float, phase_step: float) -> tuple[str, ...]:
    """Return the modes that an amplifier with such steps of level and phase [degrees] can play.

    A level step of 1 is on or off.
    """
    return DRIVE_MODES if level_step < 1 and phase_step <= MAX_PHASE_STEP else DRIVE_MODES[:1]
