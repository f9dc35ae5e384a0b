"""Hours of plates in service: each thins, a mount loosens and a sticker comes.

    python -m benchmarks.identification.hour [--hours 10] [--quiet] [--jobs 2] [--report]
    python -m benchmarks.identification.hour --objects [--hours 10]

Each hour is that of another hidden thin plate with form errors, identified at first; 300 patterns,
the table's own answers at random touches of two to four fingers of unknown loads. Thickness falls
by 1 % an hour, a mount loses 20 % after 20 minutes, a sticker of 3 g comes after 40. Printed are
alarms, explanations and the contrast [dB] for one quiet finger: as identified and never updated,
followed in service, and for the plate known. --quiet: without mount and sticker, for false alarms.
With --objects, on each plate a phone of 50 g and a cup of 200 g lie for a while, one after the
other, amid touches every two seconds; then comes a quiet hour of such touches, one every 12 s.
Tones are of one to three contents at once. Printed are the seconds until each was noticed and until
its going was, how far from its place and how many times as heavy it was said to be, and alarms.

With --report, docs/measured/identification.md is written as well.
"""

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import get_context

import numpy as np

from benchmarks.identification.__main__ import PAGE
from benchmarks.identification.plates import (
    FREQUENCIES,
    LENGTH,
    WIDTH,
    Mounted,
    answer,
    draw,
    known_table,
    pattern_of_touches,
    settled_pattern,
    table_of,
)
from benchmarks.setting import RIG, random_contacts, write_parts
from model.estimate.following import LivePlate, PatternReport, PlateEstimate
from model.estimate.forward import Sensor
from model.estimate.identify import identify
from model.estimate.measurement import Measurement
from model.finger import fingertip_points, fingertip_weights
from model.rig.rig_file import load_rig
from model.table.table import LocalizationTable
from model.table.table_file import table_following

MINUTES_BETWEEN = 0.2
MOUNT_AT, STICKER_AT = 20.0, 40.0
JUDGED_AT = (19.8, 23.0, 39.8, 43.0, 59.8)
SETS = 12
_FOLLOWED_EVERY = 5  # patterns
_UNNOTICED = 60.0  # s; after which an object is given up


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.identification.hour")
    parser.add_argument("--hours", type=int, default=10)
    parser.add_argument("--first", type=int, default=1, help="seed of the first plate")
    parser.add_argument("--quiet", action="store_true")
    parser.add_argument("--jobs", type=int, default=2, help="hours at the same time")
    parser.add_argument("--report", action="store_true")
    parser.add_argument("--objects", action="store_true", help="what lies there for a while")
    options = parser.parse_args()
    found = []
    if options.objects:
        for seed in range(options.first, options.first + options.hours):
            print(f"plate {seed}: {visits(seed)}", flush=True)
        return
    seeds = range(options.first, options.first + options.hours)
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        for one in pool.map(partial(hour, is_quiet=options.quiet), seeds):
            print("\n".join(one.said), flush=True)
            found.append(one)
    text = summary(found, is_quiet=options.quiet)
    print(text)
    if options.report:
        run = f"python -m benchmarks.identification.hour --hours {options.hours}"
        first = f" --first {options.first}" if options.first != 1 else ""
        printed = f"Printed by `{run}{first}{' --quiet' * options.quiet} --report`."
        part = "hours-quiet" if options.quiet else "hours"
        write_parts(PAGE, {part: f"{printed}\n\n{text}"})


@dataclass
class Hour:
    """What an hour gave: lines to print; alarms that no change was behind.

    named: by change minutes until it was named right, None if it was not; contrasts [dB] by minute
    and way.
    """

    said: list[str] = field(default_factory=list)
    named: dict[str, float | None] = field(default_factory=dict)
    false_alarms: int = 0
    contrasts: dict[tuple[float, str], list[float]] = field(default_factory=dict)

    def take(self, seed: int, minute: float, report: PatternReport) -> None:
        """Take what a pattern has shown."""
        awaited = [name for name, at in self.named.items() if at is None]
        if report.alarm:
            self.said.append(f"plate {seed}, minute {minute:.1f}: alarm")
            self.false_alarms += not awaited
        if report.explanation:
            self.said.append(f"plate {seed}, minute {minute:.1f}: {report.explanation}")
            for name in awaited:
                if report.explanation.name == name:
                    began = MOUNT_AT if name.startswith("stiffness") else STICKER_AT
                    self.named[name] = minute - began


def summary(hours: Sequence[Hour], *, is_quiet: bool) -> str:
    """Alarms and contrasts of some hours."""
    false = sum(each.false_alarms for each in hours)
    lines = [f"{len(hours)} hours, false alarms: {false}."]
    for what, begin in () if is_quiet else (("mount", "stiffness"), ("sticker", "a mass")):
        after = [at for each in hours for name, at in each.named.items() if name.startswith(begin)]
        times = ", ".join("never" if at is None else f"{at:.1f}" for at in after)
        lines += [f"Minutes until the {what} was named: {times}."]
    lines += ["", "| minute | never updated | in service | plate known |", "|---|---|---|---|"]
    for minute in JUDGED_AT:
        cells = [
            f"{np.median([c for each in hours for c in each.contrasts[minute, way]]):.1f}"
            for way in ("frozen", "live", "known")
        ]
        lines.append(f"| {minute:g} | {' | '.join(cells)} |")
    return "\n".join(lines)


def hour(seed: int, *, is_quiet: bool) -> Hour:
    """Play the hour of a plate."""
    rig, hidden = load_rig(RIG), draw("form", seed)
    sensors = [Sensor(era.name, era.name) for era in rig.eras]
    values = hidden.measured(FREQUENCIES, np.random.default_rng([seed, 1]))
    identified = identify(rig, Measurement(sensors, FREQUENCIES, values))
    live, mounted = LivePlate(PlateEstimate.of_rig(identified.rig, sensors)), hidden.mounted
    loaded = table_of(identified.rig, FREQUENCIES, loaded=True)
    weightless = table_of(identified.rig, FREQUENCIES, loaded=False)
    table, first, rng = loaded, mounted.plate, np.random.default_rng([seed, 2])
    found = Hour()
    judged = list(JUDGED_AT)
    for number in range(300):
        minute = number * MINUTES_BETWEEN
        mounted = replace(mounted, plate=first.thinned(1 - 0.01 * minute / 60))
        if not is_quiet and np.isclose(minute, MOUNT_AT):
            loose = np.where(np.arange(4) == seed % 4, 0.8, 1.0)
            mounted = replace(mounted, stiffness=loose * mounted.stiffness)
            found.named[f"stiffness {rig.eras[seed % 4].name}"] = None
        if not is_quiet and np.isclose(minute, STICKER_AT):
            sticker = [*(rng.uniform(0.1, 0.9, 2) * (LENGTH, WIDTH)), 3e-3]
            mounted = replace(mounted, masses=np.vstack([mounted.masses, sticker]))
            found.named["a mass"] = None
        places = random_contacts(rng, int(rng.integers(2, 5)), (LENGTH, WIDTH), margin=0.013)
        tone = answer(table, places)
        frequency, bases = tone.frequency, 0.2 * tone.bases
        factors = np.exp(0.5 * rng.standard_normal(len(places)))
        tones, at = (np.array([frequency]), bases[None]), 60 * minute
        pattern = settled_pattern(
            hidden, mounted, tones, places, factors, rng, time=at, has_phase=False
        )
        found.take(seed, minute, live.take(pattern))
        if number % _FOLLOWED_EVERY == 0:
            table = table_following(loaded, live.known.rig)
        if judged and minute >= judged[0] - 1e-6:
            at = judged.pop(0)
            tables = {
                "frozen": weightless,
                "live": table_following(weightless, replace(live.known.rig, fingertip=None)),
            }
            for way, contrasts in _judged(tables, mounted, seed).items():
                found.contrasts[at, way] = contrasts
    return found


def visits(seed: int) -> str:
    """What is noticed of a phone and a cup on a plate, and of nothing in a quiet hour."""
    rig, hidden, rng = load_rig(RIG), draw("form", seed), np.random.default_rng([seed, 4])
    sensors = [Sensor(era.name, era.name) for era in rig.eras]
    values = hidden.measured(FREQUENCIES, np.random.default_rng([seed, 1]))
    identified = identify(rig, Measurement(sensors, FREQUENCIES, values))
    live, time, said = LivePlate(PlateEstimate.of_rig(identified.rig, sensors)), 0.0, list[str]()

    def touched(lying: tuple[float, float, float] | None, *, pause: float = 2.0) -> bool:
        nonlocal time
        time += pause
        return live.take(pattern_of_touches(hidden, rng, time=time, lying=lying)).alarm

    for mass in (0.05, 0.2):
        false = sum(touched(None) for _ in range(10))
        x, y = (rng.uniform(0.1, 0.9, 2) * (LENGTH, WIDTH)).tolist()
        began, change = time, ""
        while not change and time - began < _UNNOTICED:
            touched((x, y, mass))
            change = live.known.change
        noticed, lying = time - began, live.known.lying
        while live.known.change and time - began < 2 * _UNNOTICED:
            touched(None)
        gone = time - began - noticed
        where = ""
        if lying is not None:
            off = np.hypot(lying[0] - x, lying[1] - y)
            where = f", {1000 * off:.0f} mm off, {lying[2] / mass:.1f} times as heavy"
        said.append(
            f"{1000 * mass:g} g: {false} alarms before; {noticed:g} s{where}, {gone:g} s until gone"
        )
    alarms = sum(touched(None, pause=12.0) for _ in range(300))
    return f"{'; '.join(said)}; {alarms} alarms in a quiet hour"


def _judged(
    tables: dict[str, LocalizationTable], mounted: Mounted, seed: int
) -> dict[str, list[float]]:
    """Contrast [dB] at the same sets of contacts by the tables and for the plate known."""
    live = tables["live"]
    shapes = mounted.plate.shapes(live.raster.points)
    tables = {**tables, "known": known_table(live, mounted, shapes, np.zeros((0, 4)))}
    rng, found = np.random.default_rng([seed, 3]), {way: list[float]() for way in tables}
    for _ in range(SETS):
        places = random_contacts(rng, 2, (LENGTH, WIDTH), margin=0.013)
        drives = 1 + 0.01 * rng.standard_normal(4)
        drives = drives * np.exp(1j * np.radians(1) * rng.standard_normal(4))
        discs = [fingertip_points(float(x), float(y), live.plate) for x, y in places]
        weights = fingertip_weights(float(places[0, 0]), float(places[0, 1]), live.plate)
        for way, table in tables.items():
            tone = answer(table, places)
            unit = mounted.accelerations(tone.frequency, np.concatenate(discs))
            felt = unit @ (tone.bases * drives)
            size, own = np.abs(felt), len(discs[0])
            found[way].append(float(20 * np.log10(weights @ size[:own] / size[own:].max())))
    return found


if __name__ == "__main__":
    main()
