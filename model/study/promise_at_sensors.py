"""What a table promises to accelerometers, and what they measured of it.

Accelerometers stand for fingertips: patterns are asked for contacts at their places, of fingers
without weight, since nothing touches the plate. The promise is what nine of ten plates within the
rig's uncertainty give at these points, solved exactly; what fingers would feel over their whole
tips is another number.

The check of a table by what is measured, by the package that knows sound cards.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Protocol

import numpy as np

from model.answer.answer import Layer
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.arrays import FloatArray, Point
from model.ensemble.draws import percentile
from model.errors import InputError
from model.finger import decibels, sensation_level
from model.processes import Progress
from model.rig.rig import Channel, Rig
from model.study.contrast_maps import are_apart
from model.study.verification import MIN_KEPT_SHARE, PLATES, amplitudes_on, draw_plates
from model.table.table import LocalizationTable
from registry.limits import GuardLimits

_TRIES = 1000
_MAX_OTHERS = 3


@dataclass(frozen=True)
class Promise:
    """A layer for a target and quiet places among sensors, and what it promises there.

    sensors: names, the target's first; contrast_db: felt contrast that nine of ten plates give;
    median_db: that every other one gives; level_db_sl: at the target on nine of ten plates.
    """

    sensors: tuple[str, ...]
    layer: Layer
    contrast_db: float
    median_db: float
    level_db_sl: float


@dataclass(frozen=True)
class MeasuredPromise:
    """A promise and what accelerometers measured: felt contrast [dB], level [dB SL]."""

    promise: Promise
    contrast_db: float
    level_db_sl: float

    @property
    def is_kept(self) -> bool:
        """Whether at least the promised contrast was measured."""
        return self.contrast_db >= self.promise.contrast_db


@dataclass(frozen=True)
class MeasuredVerification:
    """All promises that were played."""

    measured: tuple[MeasuredPromise, ...]

    @property
    def kept_share(self) -> float:
        """Share of the promises that were kept; nine of ten are expected."""
        return float(np.mean([each.is_kept for each in self.measured]))

    @property
    def is_passed(self) -> bool:
        """Whether enough were kept."""
        return self.kept_share >= MIN_KEPT_SHARE

    def as_json(self) -> dict[str, Any]:
        """For programs."""
        return {
            "promises": [
                {
                    "target": each.promise.sensors[0],
                    "quiet": list(each.promise.sensors[1:]),
                    "drive_frequencies_hz": sorted(
                        {tone.frequency for tone in each.promise.layer.excitation.values()}
                    ),
                    "promised_contrast_db": each.promise.contrast_db,
                    "median_contrast_db": each.promise.median_db,
                    "measured_contrast_db": each.contrast_db,
                    "promised_level_db_sl": each.promise.level_db_sl,
                    "measured_level_db_sl": each.level_db_sl,
                    "kept": each.is_kept,
                }
                for each in self.measured
            ],
            "kept_share": self.kept_share,
            "passed": self.is_passed,
        }


def promises(
    table: LocalizationTable,
    sensors: Mapping[str, Point],
    *,
    count: int,
    level: float,
    seed: int,
) -> Iterator[Promise]:
    """Promises for random sets of sensors, by name, with 1, 2, 3 quiet ones in turn.

    level: of the loudest ERA in each, 0..1 of its stroke. Raises InputError for fewer than two
    sensors 5 cm apart, and for those off the plate.
    """
    if len(sensors) < 2:
        raise InputError(f"sensors must be at two places or more, got {len(sensors)}")
    weightless = replace(table, fingertip=None)
    rng = np.random.default_rng(seed)
    for number in range(count):
        names = _drawn(rng, sensors, others=1 + number % _MAX_OTHERS)
        target, *quiet = (sensors[name] for name in names)
        placed = Placement((target,), tuple(quiet))
        layer = _at_level(query(weightless, placed).layers[0], table, level)
        yield _promise(weightless, names, placed, layer, rng)


def measured_promise(
    table: LocalizationTable, promise: Promise, frequencies: FloatArray, amplitudes: FloatArray
) -> MeasuredPromise:
    """Compare amplitudes (f, sensors) [m/s²] at the sensors of a promise, frequencies (f,) [Hz]."""
    target, *quiet = sensation_level(frequencies, amplitudes, table.threshold).tolist()
    return MeasuredPromise(promise, target - max(quiet), target)


def _drawn(
    rng: np.random.Generator, sensors: Mapping[str, Point], *, others: int
) -> tuple[str, ...]:
    """Names of sensors 5 cm apart; fewer than wanted where they do not fit."""
    names = list(sensors)
    for tries in range(_TRIES):
        count = min(len(names), 1 + max(1, others - tries // (_TRIES // _MAX_OTHERS)))
        drawn = [names[number] for number in rng.choice(len(names), count, replace=False)]
        if are_apart(np.array([sensors[name] for name in drawn])):
            return tuple(drawn)
    raise InputError("sensors must be 5 cm apart, two of them at least, got none so; move them")


def _at_level(layer: Layer, table: LocalizationTable, level: float) -> Layer:
    """The layer with its loudest ERA at a level: contrasts stay."""
    loudest = max(each["level"] for each in table.drive_of(layer.excitation).values())
    return layer.scaled(float(decibels(np.array(level / loudest))))


def _promise(
    table: LocalizationTable,
    names: Sequence[str],
    placed: Placement,
    layer: Layer,
    rng: np.random.Generator,
) -> Promise:
    plates = draw_plates(
        rng,
        table.uncertainty,
        count=PLATES,
        of=table,
        contact_count=len(names),
    )
    tones = amplitudes_on(table, placed.contacts, layer.excitation, plates)
    level = sensation_level(*tones, table.threshold)
    contrast = level[0] - level[1:].max(axis=0)
    return Promise(
        tuple(names),
        layer,
        contrast_db=float(percentile(contrast)),
        median_db=float(percentile(contrast, 50)),
        level_db_sl=float(percentile(level[0])),
    )


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


_CHECK = "era_haptics.lab.measuring.table_measurement:check_table"
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
