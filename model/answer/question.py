"""Questions to a localization table: contacts, level and drive mode."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from model.arrays import Point
from model.config.points import in_metres
from model.drive_modes import DRIVE_MODES
from model.errors import InputError
from model.finger import MAX_CONTACTS
from model.finger.fingertip import FINGERTIP_RADIUS
from model.finger.perception import STRONG_DB_SL
from model.structure.attachments import check_loads
from model.structure.plate import Plate

MIN_LEVEL_DB_SL, MAX_LEVEL_DB_SL = -100.0, 200.0
"""Below the smallest amplitude of a channel, and above what a plate survives."""

SHAPED_FROM = 0.2
"""Shortest duration [s] of an effect with a shaped onset, which settles in half of it."""


@dataclass(frozen=True)
class Question:
    """Contacts and a level for `LocalizationTable.query`.

    targets: fingers that feel it, one or more; quiet: fingers that must not; level_db_sl: at every
    target; drive_mode: a name in DRIVE_MODES, None for the table's own; playable: drive modes of
    the amplifiers; frequencies: their lowest and highest [Hz]; envelopes: whether amplifiers play
    any (`model.answer.timing`); loads: of each contact relative to the rig's fingertip
    (`Fingertip.scaled`), targets first; empty for 1.
    """

    targets: tuple[Point, ...]
    quiet: tuple[Point, ...] = ()
    level_db_sl: float = STRONG_DB_SL
    drive_mode: str | None = None
    playable: tuple[str, ...] = DRIVE_MODES
    frequencies: tuple[float, float] = (0.0, math.inf)
    envelopes: bool = False
    loads: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Check everything that does not depend on the table."""
        count = len(self.targets) + len(self.quiet)
        if not self.targets:
            raise InputError("a question must have at least one target, got none")
        if count > MAX_CONTACTS:
            raise InputError(f"a question must have up to {MAX_CONTACTS} contacts, got {count}")
        low, high = MIN_LEVEL_DB_SL, MAX_LEVEL_DB_SL
        if not low <= self.level_db_sl <= high:  # False for NaN
            raise InputError(
                f"level must be between {low:g} and {high:g} dB SL, got {self.level_db_sl:g}; 20 "
                "is strong, 12 is felt, 0 is the threshold"
            )
        if self.loads and len(self.loads) != count:
            raise InputError(
                f"loads must have one value per contact ({count}), got {len(self.loads)}"
            )
        check_loads(self.loads)
        for what, contacts in (("target", self.targets), ("quiet finger", self.quiet)):
            for x, y in contacts:
                if contacts.count((x, y)) > 1:
                    raise InputError(f"{what} ({x:g}, {y:g}) m must be given once, got two")
        if self.drive_mode is not None:
            checked_mode(self.drive_mode)
        for target in self.targets:
            for position in self.quiet:
                if math.dist(position, target) < FINGERTIP_RADIUS:
                    raise InputError(
                        f"target ({target[0]:g}, {target[1]:g}) m must be at least "
                        f"{1000 * FINGERTIP_RADIUS:g} mm from the quiet finger at "
                        f"({position[0]:g}, {position[1]:g}) m"
                    )

    @property
    def contacts(self) -> tuple[Point, ...]:
        """All contacts [m], targets first."""
        return (*self.targets, *self.quiet)

    def check_on(self, plate: Plate) -> None:
        """Raise InputError for a contact off the plate."""
        check_on_plate("target", self.targets, plate)
        check_on_plate("quiet finger", self.quiet, plate)

    def drive_mode_on(self, own: str) -> str:
        """Return the drive mode on a table of a default mode; raises InputError if unplayable."""
        drive_mode = self.drive_mode or own
        if drive_mode not in self.playable:
            raise InputError(
                f"drive mode must be one that these amplifiers play, {', '.join(self.playable)}, "
                f"got {drive_mode}; build a table for them: era table build --mode"
            )
        return drive_mode


def checked_mode(name: str) -> str:
    """Return the name of a drive mode; raises InputError for any other."""
    if name not in DRIVE_MODES:
        raise InputError(f"drive mode must be one of {', '.join(DRIVE_MODES)}, got {name!r}")
    return name


def check_on_plate(what: str, places: Iterable[Point], plate: Plate) -> None:
    """Raise InputError for a finger off the plate; what: the finger's name."""
    length, width = plate.length, plate.width
    for x, y in places:
        if not (0 <= x <= length and 0 <= y <= width):  # False for NaN
            raise InputError(
                f"{what} ({x:g}, {y:g}) m must be on the plate, from (0, 0) to "
                f"({length:g}, {width:g}) m{in_metres(x, y, length=length, width=width)}"
            )
