"""What a table promises at accelerometers, and what they measure of it.

Accelerometers stand for fingertips: patterns are for contacts at their places, of weightless
fingers, since nothing touches the plate. The promise is what nine of ten plates within the rig's
uncertainty give at these points, solved exactly; fingers would feel other numbers over their whole
tips. The lab measures (`era_haptics.lab.measuring`), since it knows sound cards.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from model.answer.answer import Layer
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.arrays import FloatArray, Point
from model.ensemble.draws import percentile
from model.errors import InputError
from model.finger import decibels, sensation_level
from model.rig.rig import Channel, Rig
from model.study.contrast_maps import are_apart
from model.study.verification import MIN_KEPT_SHARE, PLATES, amplitudes_on, draw_plates
from model.table.table import LocalizationTable
from registry.limits import GuardLimits

_TRIES = 1000
_MAX_OTHERS = 3


@dataclass(frozen=True)
class Promise:
    """A layer for a target and quiet places among sensors, and what it promises there."""

    sensors: tuple[str, ...]
    """Names of the sensors, the target's first."""
    layer: Layer
    contrast_db: float
    """Felt contrast that nine of ten plates give."""
    median_db: float
    """Felt contrast that half of the plates give."""
    level_db_sl: float
    """Level at the target that nine of ten plates give."""
    measured_contrast_db: float = math.nan
    """Felt contrast that accelerometers measured; NaN before."""
    measured_level_db_sl: float = math.nan
    """Level at the target that accelerometers measured; NaN before."""

    @property
    def is_kept(self) -> bool:
        """Whether at least the promised contrast was measured."""
        return self.measured_contrast_db >= self.contrast_db


@dataclass(frozen=True)
class MeasuredVerification:
    """The outcome of all promises that were played."""

    measured: tuple[Promise, ...]

    @property
    def kept_share(self) -> float:
        """Share of the promises that were kept; nine of ten are expected."""
        return float(np.mean([each.is_kept for each in self.measured]))

    @property
    def is_passed(self) -> bool:
        """Whether enough were kept."""
        return self.kept_share >= MIN_KEPT_SHARE

    def as_json(self) -> dict[str, Any]:
        """Return the outcome for programs."""
        return {
            "promises": [
                {
                    "target": each.sensors[0],
                    "quiet": list(each.sensors[1:]),
                    "drive_frequencies_hz": sorted(
                        {tone.frequency for tone in each.layer.excitation.values()}
                    ),
                    "promised_contrast_db": each.contrast_db,
                    "median_contrast_db": each.median_db,
                    "measured_contrast_db": each.measured_contrast_db,
                    "promised_level_db_sl": each.level_db_sl,
                    "measured_level_db_sl": each.measured_level_db_sl,
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
    """Yield promises for random sets of sensors, with 1, 2 and 3 quiet ones in turn.

    sensors: places [m] by name; level: of the loudest ERA in each promise, 0..1 of its stroke.
    Raises InputError for fewer than two sensors 5 cm apart, and for sensors off the plate.
    """
    if len(sensors) < 2:
        raise InputError(f"sensors must be at two places or more, got {len(sensors)}")
    weightless = replace(table, fingertip=None)
    rng = np.random.default_rng(seed)
    for number in range(count):
        names = _drawn(rng, sensors, others=1 + number % _MAX_OTHERS)
        target, *quiet = (sensors[name] for name in names)
        placed = Placement((target,), tuple(quiet))
        layer = query(weightless, placed).layers[0]
        loudest = max(each["level"] for each in table.drive_of(layer.excitation).values())
        layer = layer.scaled(float(decibels(np.array(level / loudest))))  # contrasts stay
        yield _promise(weightless, names, placed, layer, rng)


def measured_promise(
    table: LocalizationTable, promise: Promise, frequencies: FloatArray, amplitudes: FloatArray
) -> Promise:
    """Note amplitudes (f, sensors) [m/s²] at the sensors of a promise, frequencies (f,) [Hz]."""
    target, *quiet = sensation_level(frequencies, amplitudes, table.threshold).tolist()
    contrast = target - max(quiet)
    return replace(promise, measured_contrast_db=contrast, measured_level_db_sl=target)


def _drawn(
    rng: np.random.Generator, sensors: Mapping[str, Point], *, others: int
) -> tuple[str, ...]:
    """Draw names of sensors 5 cm apart; fewer than wanted if they do not fit."""
    names = list(sensors)
    for tries in range(_TRIES):
        count = min(len(names), 1 + max(1, others - tries // (_TRIES // _MAX_OTHERS)))
        drawn = [names[number] for number in rng.choice(len(names), count, replace=False)]
        if are_apart(np.array([sensors[name] for name in drawn])):
            return tuple(drawn)
    raise InputError("sensors must be 5 cm apart, two of them at least, got none so; move them")


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
    """Settings of `era table verify --device`."""

    device: str
    """Sound device that records the accelerometers, and plays unless there is a url."""
    sensors_file: Path
    """File of the accelerometers."""
    url: str | None
    """Amplifier that plays."""
    samples: int
    """Number of promises to play."""
    seed: int
    level: float | None
    """Level of the loudest ERA, None for half of what the rig's limits allow."""


def plain_rig(table: LocalizationTable, *, level: float) -> Rig:
    """Make a rig from a table, with its ERAs on channels 0, 1, ... in order.

    level: its limit, which a table does not have; its frequencies are the table's.
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
