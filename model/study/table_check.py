"""The check of a table by what is measured, by the package that knows sound cards."""

from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Protocol

from model.processes import Progress
from model.rig.rig import Channel, Rig
from model.study.promise_at_sensors import MeasuredVerification
from model.table.table import LocalizationTable
from registry.limits import GuardLimits


@dataclass(frozen=True)
class CheckSettings:
    """What `era table verify --device` was given.

    sensors_file: of accelerometers; device: that records them and plays, unless url is an amplifier
    that does; samples: promises to play; level: of the loudest ERA, None: half of what the rig's
    limits allow.
    """

    device: str
    sensors_file: Path
    url: str | None
    samples: int
    seed: int
    level: float | None


class TableCheck(Protocol):
    """Plays promises of a table and measures them."""

    def __call__(
        self,
        table: LocalizationTable,
        rig: Rig,
        settings: CheckSettings,
        *,
        progress: Progress,
    ) -> MeasuredVerification:
        """Raises InputError, LinkError."""


_CHECK = "sim.desk.measuring.table_check:check_table"
"""By name: this package does not import the one beside it."""


def check_by_measuring(
    table: LocalizationTable,
    rig: Rig,
    settings: CheckSettings,
    *,
    progress: Progress,
) -> MeasuredVerification:
    """Measure promises by the sound card's check."""
    check: TableCheck = resolve_name(_CHECK)
    return check(table, rig, settings, progress=progress)


def plain_rig(table: LocalizationTable, *, level: float) -> Rig:
    """The rig of a table without wiring of its own: its ERAs on channels 0, 1, ... in order.

    level: its limit, which a table does not know; frequencies are those of the table.
    """
    low, high = (float(table.frequencies[end]) for end in (0, -1))
    return Rig(
        table.plate,
        table.mesh,
        table.eras,
        {era.name: Channel("main", number) for number, era in enumerate(table.eras)},
        {"main": "sim://"},
        GuardLimits(low, high, level),
        masses=table.masses,
        uncertainty=table.uncertainty,
        fingertip=table.fingertip,
        threshold=table.threshold,
    )
