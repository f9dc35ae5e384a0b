"""Short effects at random touches: what is felt over their duration, against what was predicted.

    python -m benchmarks.raised [--touches 25]

The paper's plate with its default table, plain ramps, fingers at least 5 cm apart, each of them on
the plate. Felt, in time and sample by sample, less predicted: mean and the worst in dB, with and
without the fingers in the prediction; and the shortest time to answer in ms.
"""

import argparse
import math
import time
from dataclasses import replace

import numpy as np

from benchmarks.setting import APART, RIG, random_contacts, use_one_thread
from controller.loop.capabilities import PlaybackCapabilities
from controller.loop.envelopes import RAMPS_ONLY
from controller.loop.intent import Pulse, Target
from controller.loop.table_query import TableAnswer, query_table
from controller.sources.contacts import Contact, ContactKey
from model.finger.fingertip import fingertip_points, fingertip_weights
from model.finger.perception import decibels, detection_threshold
from model.rig.file import load_rig
from model.table.build import build_table
from model.table.effect_level import EffectLevels
from model.table.table import LocalizationTable
from model.transients.base_motion import ramped_pulse
from model.transients.measures import Transients

EFFECTS = ((0.020, 20.0), (0.040, 20.0), (0.120, 14.0))
"""Durations [s] and levels [dB SL]."""


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.raised")
    parser.add_argument("--touches", type=int, default=25)
    touches = parser.parse_args().touches
    use_one_thread()
    table = build_table(load_rig(RIG))
    ways = {
        "with fingers": EffectLevels(table),
        "without": EffectLevels(replace(table, fingertip=None)),
    }
    for duration, level in EFFECTS:
        for resting in range(4):
            parts = []
            for name, levels in ways.items():
                rng = np.random.default_rng([resting, 1])
                rows = [
                    _touch(table, levels, rng, resting, duration, level) for _ in range(touches)
                ]
                errors, times = np.array(rows).T
                worst = errors[np.abs(errors).argmax()]
                parts.append(
                    f"{name} {errors.mean():+.2f} ({worst:+.2f}) dB, {1e3 * times.min():.1f} ms"
                )
            print(f"{1e3 * duration:.0f} ms, {resting} resting: {'; '.join(parts)}")


def _touch(
    table: LocalizationTable,
    levels: EffectLevels,
    rng: np.random.Generator,
    resting: int,
    duration: float,
    level: float,
) -> tuple[float, float]:
    """Felt less predicted [dB], and the time to answer [s]."""
    size = (table.plate.length, table.plate.width)
    places = random_contacts(rng, 1 + resting, size, apart=APART)
    contacts = [
        Contact(ContactKey("bench", number), float(x), float(y), since=0.0)
        for number, (x, y) in enumerate(places)
    ]
    target = Target(contacts[0].key, level, pulse=Pulse(duration, requested_at=0.0))
    capabilities = PlaybackCapabilities(
        drive_mode="phased",
        playable=("phased",),
        frequencies=(float(table.frequencies[0]), float(table.frequencies[-1])),
        max_amplitudes={era.name: era.stroke for era in table.eras},
        envelope_support=RAMPS_ONLY,
    )
    started = time.perf_counter()
    answer = query_table(table, contacts[0], target, contacts[1:], capabilities, levels)
    elapsed = time.perf_counter() - started
    return _felt_db_sl(table, answer, duration) - answer.felt_db_sl, elapsed


def _felt_db_sl(table: LocalizationTable, answer: TableAnswer, duration: float) -> float:
    pattern, (target,) = answer.pattern, answer.question.targets
    (frequency,) = {tone.frequency for tone in pattern.excitation.values()}
    acceleration = Transients(table.in_time_under(answer.question.contacts)).acceleration(
        ramped_pulse(pattern.excitation, table.eras, ramp=pattern.ramp, duration=duration),
        fingertip_points(*target, table.plate),
        duration=duration,
    )
    rms = np.sqrt((acceleration**2).mean(axis=0)) @ fingertip_weights(*target, table.plate)
    threshold = detection_threshold(np.array(frequency), table.threshold)
    return float(decibels(math.sqrt(2) * rms / threshold))


if __name__ == "__main__":
    main()
