"""What it costs that an amplifier plays voltage, for `era config check`."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.finger.perception import decibels, detection_threshold
from model.rig.rig import Rig
from registry.voltage import VoltageDrive

_STEP = 1.0  # Hz
_HIGHEST = 500.0  # Hz; half of the range in which thresholds are known


@dataclass(frozen=True)
class Harmonic:
    """Second harmonic of a tone at full drive, about its fundamental, over the played frequencies.

    Of the sensation level at the ERA's base: median and worst [dB], and where that is [Hz].
    """

    median_db: float
    worst_db: float
    worst_at: float


def voltage_costs(rig: Rig) -> list[str]:
    """One warning for each amplifier of voltage, by its laws."""
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
                *_harmonic_text(drives, rig),
            ]
            warnings.append(f"{amplifier} plays voltage: {'; '.join(parts)}")
    return warnings


def highest_level(drives: Sequence[VoltageDrive], limit: float) -> float:
    """Highest level that every ERA reaches at every played frequency; limit: of the rig."""
    return min(limit, *(drive.reach()[0] for drive in drives))


def second_harmonic(drive: VoltageDrive, *, level: float, threshold: str) -> Harmonic:
    """Second harmonic of an ERA with a bias, at a level; threshold: name of the set.

    Of frequencies up to 500 Hz, of which there must be one: above, it is not felt.
    Its force is U / 4 b of the fundamental's, and its acceleration four times its share of motion.
    """
    low, high = drive.frequencies
    frequencies = np.arange(max(low, 10.0), min(high, _HIGHEST) + _STEP / 2, _STEP)
    frequencies = frequencies[frequencies <= _HIGHEST]
    response, doubled = (
        np.array([abs(drive.at(factor * f)) for f in frequencies]) for factor in (1, 2)
    )
    voltage = level / (2 * drive.bias * response)
    acceleration = 4 * voltage / (4 * drive.bias) * doubled / response
    felt = detection_threshold(frequencies, threshold) / detection_threshold(
        2 * frequencies, threshold
    )
    relative = decibels(acceleration * felt)
    worst = int(np.argmax(relative))
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


def _harmonic_text(drives: dict[str, VoltageDrive], rig: Rig) -> list[str]:
    found = {
        name: second_harmonic(
            drive,
            level=highest_level(list(drives.values()), rig.limits.level),
            threshold=rig.threshold,
        )
        for name, drive in drives.items()
        if drive.bias and drive.frequencies[0] <= _HIGHEST
    }
    if not found:
        return []
    name, worst = max(found.items(), key=lambda each: each[1].worst_db)
    median = max(one.median_db for one in found.values())
    return [
        f"a second harmonic of {median:+.0f} dB (median) to {worst.worst_db:+.0f} dB ({name} at "
        f"{worst.worst_at:g} Hz) about the felt level of a tone at the highest level, which "
        "fingers promised silence feel too; 6 dB less for half the level"
    ]
