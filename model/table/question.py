"""What is asked of a localization table: who shall feel it, who must not, how strongly, and how."""

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from model.config.points import in_metres
from model.counting import counted
from model.drive_modes import DRIVE_MODES
from model.errors import InputError
from model.finger.fingertip import FINGERTIP_RADIUS
from model.finger.perception import STRONG_DB_SL
from model.structure.plate import Plate

Point: TypeAlias = tuple[float, float]
"""x, y [m]."""

MAX_CONTACTS = 10

MIN_LEVEL_DB_SL, MAX_LEVEL_DB_SL = -100.0, 200.0
"""Below lies nothing that a channel can play, above nothing that a plate survives."""


@dataclass(frozen=True)
class Question:
    """Contacts and a wanted level in; `LocalizationTable.ask` gives a pattern out.

    targets: where fingers shall feel it, one or more; quiet: where fingers must not; level_db_sl:
    wanted at every target; softer_db: by how much less each of them wants than that, empty for
    nothing; drive_mode: a name in DRIVE_MODES, None for the table's own; playable: the modes that
    the amplifiers can play; frequencies: the lowest and highest they can [Hz]; eras_at_most: how
    many ERAs `switched` may drive, beyond two by exact search, which is not for live use and ends
    after search_time [s] at the latest, with a bound in place of a proof; envelopes: whether the
    amplifiers play any (`model.table.timing`).

    Where targets are not wanted alike, contrast and level of the answer are those of the target
    that has least of what it wants, as if it wanted the full level.
    """

    targets: tuple[Point, ...]
    quiet: tuple[Point, ...] = ()
    level_db_sl: float = STRONG_DB_SL
    softer_db: tuple[float, ...] = ()
    drive_mode: str | None = None
    playable: tuple[str, ...] = tuple(DRIVE_MODES)
    frequencies: tuple[float, float] = (0.0, math.inf)
    eras_at_most: int = 2
    search_time: float = 10.0
    envelopes: bool = False

    def __post_init__(self) -> None:
        """Refuse what has no answer on any plate."""
        if not self.targets:
            raise InputError("nobody is to feel anything: name at least one target")
        if len(self.targets) + len(self.quiet) > MAX_CONTACTS:
            raise InputError(
                f"{len(self.targets) + len(self.quiet)} contacts are more than ten fingers; "
                f"leave out all but {MAX_CONTACTS}"
            )
        low, high = MIN_LEVEL_DB_SL, MAX_LEVEL_DB_SL
        if not low <= self.level_db_sl <= high:  # not true of NaN either
            raise InputError(
                f"a level of {self.level_db_sl:g} dB SL is none that can be asked for; 20 is "
                f"strong, 12 is felt, 0 is just detected: give one from {low:g} to {high:g}"
            )
        if self.softer_db and len(self.softer_db) != len(self.targets):
            raise InputError(
                f"{counted(len(self.softer_db), 'level')} for "
                f"{counted(len(self.targets), 'target')}; give each its own, or none"
            )
        for softer in self.softer_db:
            if not 0 <= softer <= MAX_LEVEL_DB_SL:  # not true of NaN either
                raise InputError(
                    f"a target cannot be softer than the level asked for by {softer} dB; take the "
                    "highest for the level, and say by how much the others are below it"
                )
        if not self.search_time >= 0:
            raise InputError(f"a search cannot end after {self.search_time} s; give it 0 or more")
        if self.eras_at_most < 1:
            raise InputError(f"{self.eras_at_most} ERAs cannot move anything; allow at least one")
        for what, contacts in (("target", self.targets), ("quiet finger", self.quiet)):
            for number, contact in enumerate(contacts):
                if contact in contacts[:number]:
                    raise InputError(
                        f"the {what} ({contact[0]:g}, {contact[1]:g}) m is given twice; two "
                        "fingers are at two places, so give each once"
                    )
        if self.drive_mode is not None and self.drive_mode not in DRIVE_MODES:
            raise InputError(
                f"unknown drive mode {self.drive_mode!r}; known: {', '.join(DRIVE_MODES)}"
            )
        for target in self.targets:
            for position in self.quiet:
                if math.dist(position, target) < FINGERTIP_RADIUS:
                    raise InputError(
                        f"target ({target[0]:g}, {target[1]:g}) m lies within the quiet fingertip "
                        f"at ({position[0]:g}, {position[1]:g}) m; keep them "
                        f"{1000 * FINGERTIP_RADIUS:g} mm apart at least"
                    )

    @property
    def gains(self) -> tuple[np.float32, ...]:
        """What each target's field is multiplied with: a softer one counts as that much louder.

        Then all want the same.
        """
        softer = self.softer_db or (0.0,) * len(self.targets)
        return tuple(np.float32(10 ** (each / 20)) for each in softer)

    def check_on(self, plate: Plate) -> None:
        """Raise InputError for a contact off the plate, or one that is no place."""
        for what, contacts in (("target", self.targets), ("quiet", self.quiet)):
            for x, y in contacts:
                if not plate.contains(x, y):  # not true of NaN either
                    raise InputError(
                        f"{what} ({x:g}, {y:g}) m is not on the plate, which reaches from (0, 0) "
                        f"to ({plate.length:g}, {plate.width:g}) m"
                        f"{in_metres(x, y, length=plate.length, width=plate.width)}"
                    )

    def drive_mode_on(self, own: str, *, era_count: int) -> str:
        """The mode to answer in on a table of so many ERAs, whose own mode is given.

        Raises InputError if it is not playable, and for a number of ERAs that it cannot keep to.
        """
        drive_mode = self.drive_mode or own
        if self.eras_at_most > max(2, era_count):
            raise InputError(
                f"the table has {counted(era_count, 'ERA')}, of which up to {self.eras_at_most} "
                f"cannot be driven; allow {era_count} at the most"
            )
        if self.eras_at_most != 2 and drive_mode != "switched":
            raise InputError(
                f"how many ERAs are driven is a matter of mode switched; mode {drive_mode} drives "
                "all of them: ask for mode switched, or leave the number of ERAs out"
            )
        if drive_mode not in self.playable:
            raise InputError(
                f"these amplifiers cannot play mode {drive_mode}, only {', '.join(self.playable)}; "
                f"ask for one of these, or build a table for them: era table build --mode"
            )
        return drive_mode
