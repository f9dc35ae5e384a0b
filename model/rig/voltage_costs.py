"""What it costs that an amplifier plays voltage, for `era config check`."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from model.choice import best_of
from model.finger.perception import decibels, detection_threshold
from model.rig.rig import Rig
from registry.voltage import HIGHEST_FELT, Law, VoltageDrive

_STEP = 1.0  # Hz
_MAX_ANGLE = math.radians(20.5)  # between two rows
_MAX_FREQUENCY = HIGHEST_FELT / 2  # Hz; of tones whose harmonic is felt


@dataclass(frozen=True)
class Harmonic:
    """Second harmonic of a tone at full drive, about its fundamental, over the played frequencies.

    Of the sensation level at the ERA's base: median and worst [dB], and where that is [Hz].
    """

    median_db: float
    worst_db: float
    worst_at: float


def voltage_costs(rig: Rig) -> list[str]:
    """One warning for each amplifier of voltage, by its laws; one for each coarse response."""
    warnings = []
    for amplifier in rig.amplifiers:
        drives = {
            name: drive
            for name, drive in rig.voltage.items()
            if rig.wiring[name].amplifier == amplifier
        }
        if drives:
            parts = [
                _reach_text([*drives.values()], rig.limits.level),
                *_fades_text([*drives.values()]),
                *_deflection_text([*drives.values()], rig.limits.level),
                *_harmonic_text(drives, rig),
                "a base is taken as stiff: `response` must be measured under the mounted plate, "
                "with the other ERAs silent",
                "onsets and endings are those of the force: contrast over the first 100 ms is not "
                "predicted",
            ]
            warnings.append(f"{amplifier} plays voltage: {'; '.join(parts)}")
    return [*warnings, *(text for each in rig.voltage.items() for text in _coarse_text(*each))]


def highest_level(drives: Sequence[VoltageDrive], limit: float) -> float:
    """Highest level of every ERA at every played frequency; limit: of the rig."""
    return min(limit, *(drive.level_max() for drive in drives))


def second_harmonic(drive: VoltageDrive, *, level: float, threshold: str) -> Harmonic:
    """Second harmonic of an ERA with a bias, at a level; threshold: name of the set.

    Of frequencies up to 500 Hz, of which there must be one: above, it is not felt.
    """
    low, high = drive.frequencies
    frequencies = np.arange(max(low, 10.0), min(high, _MAX_FREQUENCY) + _STEP / 2, _STEP)
    frequencies = frequencies[frequencies <= _MAX_FREQUENCY]
    # Motion grows with the square of the level; acceleration is four times its share of motion.
    share = np.array([level * abs(drive.second_harmonic(1.0, f)) for f in frequencies])
    felt = detection_threshold(frequencies, threshold) / detection_threshold(
        2 * frequencies, threshold
    )
    relative = decibels(4 * share * felt)
    worst = best_of(relative)
    return Harmonic(float(np.median(relative)), float(relative[worst]), float(frequencies[worst]))


def _reach_text(drives: Sequence[VoltageDrive], limit: float) -> str:
    reaches = [drive.reach() for drive in drives]
    low, high = min(one for one, _ in reaches), max(other for _, other in reaches)
    first, last = drives[0].frequencies
    return (
        f"full voltage reaches {low:.3g} to {high:.3g} full strokes from {first:g} to {last:g} Hz, "
        f"levels up to {highest_level(drives, limit):.3g} are played"
    )


def _fades_text(drives: Sequence[VoltageDrive]) -> list[str]:
    if not any(drive.is_halved for drive in drives):
        return []
    return [
        "no cross-fades: without a bias one frequency fades out before the next fades in",
        "no envelopes: ramps in place of shaped onsets and endings",
    ]


def _deflection_text(drives: Sequence[VoltageDrive], limit: float) -> list[str]:
    level = highest_level(drives, limit)
    square = [drive for drive in drives if drive.law is Law.QUADRATIC and drive.level_max()]
    known = [drive.static * drive.constant_term(level) for drive in square if drive.static]
    unknown = [drive.constant_term(level) for drive in square if not drive.static]
    return [
        *([f"the mean force deflects a base by up to {max(known):.2g} strokes"] if known else []),
        *(
            [
                f"the mean of the squared voltage, up to {max(unknown):.2g}, deflects a base by an "
                "unknown distance, which nothing limits; give `static`"
            ]
            if unknown
            else []
        ),
    ]


def _coarse_text(name: str, drive: VoltageDrive) -> list[str]:
    """Text about the played rows between which a response turns most, if that is far."""
    low, high = drive.frequencies
    angle, first, last = max(
        (
            (abs(math.remainder(other[2] - one[2], math.tau)), one[0], other[0])
            for one, other in pairwise(drive.response)
            if one[0] < high and other[0] > low
        ),
        default=(0.0, 0.0, 0.0),
    )
    if angle <= _MAX_ANGLE:
        return []
    return [
        f"{name}: response turns by {math.degrees(angle):.0f} degrees from {first:g} to {last:g} "
        "Hz; measure rows between, at most 20 degrees apart"
    ]


def _harmonic_text(drives: dict[str, VoltageDrive], rig: Rig) -> list[str]:
    found = {
        name: second_harmonic(
            drive,
            level=highest_level(list(drives.values()), rig.limits.level),
            threshold=rig.threshold,
        )
        for name, drive in drives.items()
        if drive.bias and drive.frequencies[0] <= _MAX_FREQUENCY
    }
    if not found:
        return []
    name, worst = list(found.items())[best_of([each.worst_db for each in found.values()])]
    median = max(one.median_db for one in found.values())
    return [
        f"a second harmonic of {median:+.0f} dB (median) to {worst.worst_db:+.0f} dB ({name} at "
        f"{worst.worst_at:g} Hz) about the felt level of a tone at the highest level, which "
        "fingers promised silence feel too; 6 dB less for half the level"
    ]
