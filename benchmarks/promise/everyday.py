"""Whether promises are kept beside hands and objects, under fingers that press, and by a person.

    python -m benchmarks.promise.everyday [--sets 20] [--plates 60] [--only WORD ...] [--rigs N ...]

Two contents of 14 dB SL at fingers at least 5 cm apart, on plates solved exactly and drawn within
the uncertainty of a rig. The heel of a hand is four patches 25 mm apart, whose loads together are
so many fingertips'; those of a hand of another size are farther apart, and the hand that is far is
one. An object lies anywhere, 3 cm from fingers or more: its mass on a contact spring of 100 kN/m;
expected, `uncertainty.foreign_mass` says so. Surplus fingers are as far from others. Each row: the
promise at the worst finger (median, worst tenth) [dB], share of the promises that is kept, and what
nine of ten plates lack to it [dB].
"""

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.promise.cases import Case
from benchmarks.setting import random_contacts
from controller.sources.touch import HAND_MAJOR, IN_MM, LIGHT_FORCE
from model.answer.answer import Answer
from model.answer.plan import answer
from model.answer.stimulus import Finger, Stimulus
from model.arrays import FloatArray, Point
from model.finger import FINGERTIP_RADIUS, decibels
from model.structure.attachments import Fingertip, FingertipLoad, object_load
from model.study.verification import Plates, accelerations_on, draw_plates
from model.table.table import LocalizationTable, read_fingertips
from model.vibration import base_amplitudes

RIGS = (("paper_plate", False), ("paper_plate", True), ("car_display", True))
OBJECT_AWAY = 0.03  # m
PATCH = 0.0125  # m; of a patch of the heel from its middle, along x and along y
OH_AND_CHOI = ((40.0, 3.5), (250.0, -7.0))
"""Thresholds of pressing fingers above those of the probe, by frequency [Hz] in dB."""
STUDIED = (40.0, 100.0, 250.0, 500.0)
"""Frequencies [Hz] at which a person deviates from the mean on their own, by 4 dB."""


@dataclass(frozen=True)
class Situation:
    """What differs from what the answer counts.

    hand: how many fingertips' load it has, 0 for none; distance [m]: of its middle from the nearer
    finger, 0 for the corner farthest from both; is_counted: whether the answer counts a hand there,
    and surplus fingers; force [N]: of all fingers; person: how their thresholds differ; fingertip:
    of the uncertainty that the answer counts, None for that of the rig; mass [kg]: of an object
    that lies anywhere, 0 for none, which the answer counts as a hand; size, reported [mm]: of the
    hand's longer axis, and what its source reports; surplus: number of fingers that feel nothing.
    """

    name: str
    hand: float = 0.0
    distance: float = 0.0
    force: float = LIGHT_FORCE
    person: str = ""
    is_counted: bool = True
    fingertip: float | None = None
    mass: float = 0.0
    size: float = HAND_MAJOR
    reported: float = HAND_MAJOR
    surplus: int = 0


def situations() -> Iterator[Situation]:
    """The rows of a rig."""
    palm = Situation("hand of 40 fingertips and 75 mm, of unknown size", 40, 0.09, size=75.0)
    yield from (
        Situation("as asked"),
        replace(palm, name="hand of 40 fingertips and 75 mm, unseen", is_counted=False),
        palm,
        replace(palm, name="hand of 40 fingertips and 75 mm, with its size", reported=75.0),
        Situation("ten surplus fingers, not counted", surplus=10, is_counted=False),
        Situation("ten surplus fingers, counted", surplus=10),
    )
    for load, distance, where in (
        (20, 0.09, "9 cm away"),
        (5, 0.09, "9 cm away"),
        (10, 0.0, "far"),
    ):
        for is_counted in (False, True):
            known = "seen" if is_counted else "unseen"
            yield Situation(
                f"hand of {load} fingertips, {where}, {known}",
                load,
                distance,
                is_counted=is_counted,
            )
    for newtons in (0.3, 1.0, 2.0, 3.0):
        yield Situation(f"force of {newtons:g} N", force=newtons)
        yield Situation(f"force of {newtons:g} N, fingertip: 0.9", force=newtons, fingertip=0.9)
    for name, mass in (("pen", 0.005), ("phone", 0.05), ("cup", 0.2)):
        for is_counted in (False, True):
            known = "expected" if is_counted else "not expected"
            grams = f"{1000 * mass:g} g"
            yield Situation(f"{name} of {grams}, {known}", mass=mass, is_counted=is_counted)
    yield Situation("person, as Oh and Choi 2019", person="tilted")
    yield Situation("person, 4 dB at four frequencies", person="drawn")


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.promise.everyday",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--sets", type=int, default=20)
    parser.add_argument("--plates", type=int, default=60)
    parser.add_argument("--only", nargs="+", default=[""], help="words in the names of rows")
    parser.add_argument("--rigs", nargs="+", type=int, default=[*range(len(RIGS))])
    options = parser.parse_args()

    print("| rig | | promised (10 %) | kept | nine of ten lack |\n|---|---|---|---|---|")
    for name, known in [RIGS[number] for number in options.rigs]:
        case = Case("", None, name, is_identified=known)
        title = f"{len(case.rig.eras)} {'identified' if known else 'default'}"
        for each in situations():
            if not any(word in each.name for word in options.only):
                continue
            promised, above = [], []
            for seed in range(options.sets):
                found, plates = _row(
                    case.table, each, np.random.default_rng([seed, 14]), options.plates
                )
                promised.append(min(x.promised_contrast_db or np.nan for x in found.fingers[:2]))
                above.append(plates)
            print(
                f"| {title} | {each.name} | {np.median(promised):.1f} "
                f"({np.percentile(promised, 10):.1f}) | "
                f"{100 * np.mean(np.array(above) >= 0):.0f} % | "
                f"{-np.percentile(np.concatenate(above, axis=1), 10):+.1f} |",
                flush=True,
            )


def _row(
    table: LocalizationTable, of: Situation, rng: np.random.Generator, count: int
) -> tuple[Answer, FloatArray]:
    """An answer, and by how much plates are above its promises (2, d) [dB]."""
    size = table.plate.length, table.plate.width
    margin = FINGERTIP_RADIUS + 0.001
    hand: Point | None = None
    while True:
        places = [(float(x), float(y)) for x, y in random_contacts(rng, 2, size, margin=margin)]
        if not of.hand:
            break
        if (hand := _hand_at(rng, places, size, of.distance)) is not None:
            break
    changed = {} if of.fingertip is None else {"fingertip": of.fingertip}
    if of.mass and of.is_counted:
        changed["foreign_mass"] = of.mass
    if changed:
        table = replace(table, uncertainty=replace(table.uncertainty, **changed))
    fingers = [Finger(at, Stimulus(14.0)) for at in places]
    patches = _patches(table, places, hand, of, rng)
    quiet = [Finger((each.x, each.y), is_protected=False) for each in patches[: of.surplus]]
    if hand is not None:
        quiet = [Finger(hand, load=IN_MM.load(touch_major=of.reported) or 0.0)]
    found = answer(
        table,
        [*fingers, *(quiet if of.is_counted else [])],
        drive_mode="phased",
        min_contrast_db=-np.inf,
    )
    plates = draw_plates(
        rng,
        replace(
            table.uncertainty, fingertip=0.0 if of.force != 0.5 else table.uncertainty.fingertip
        ),
        of=table,
        count=count,
        contact_count=2 + len(patches),
    )
    if of.mass:
        plates.load[:, 2:] = 1.0
    promised = [[x.promised_contrast_db or np.nan] for x in found.fingers[:2]]
    return found, contrasts_on(table, found, plates, of, patches, rng) - np.array(promised)


def _hand_at(
    rng: np.random.Generator,
    places: Sequence[Point],
    size: tuple[float, float],
    distance: float,
) -> Point | None:
    """Where a hand rests: so far from the nearer finger, or in the corner farthest from both."""
    margin = 2 * PATCH
    if not distance:
        corners = [(x, y) for x in (margin, size[0] - margin) for y in (margin, size[1] - margin)]
        return max(corners, key=lambda at: min(np.hypot(*np.subtract(at, p)) for p in places))
    for angle in (rng.uniform(0, 2 * np.pi) for _ in range(100)):
        x, y = np.array(places[0]) + distance * np.array([np.cos(angle), np.sin(angle)])
        is_on = margin <= x <= size[0] - margin and margin <= y <= size[1] - margin
        if is_on and np.hypot(x - places[1][0], y - places[1][1]) >= distance:
            return float(x), float(y)
    return None


def _patches(
    table: LocalizationTable,
    places: Sequence[Point],
    hand: Point | None,
    of: Situation,
    rng: np.random.Generator,
) -> list[FingertipLoad]:
    """Loads of a hand's patches, or of objects or fingers at least 3 cm from others."""
    tip, sides = table.fingertip or Fingertip(), (table.plate.length, table.plate.width)
    if hand is None:
        load, spots = object_load(of.mass) if of.mass else tip, list[Point]()
        while len(spots) < of.surplus + (of.mass > 0):
            at = float(rng.uniform(0, sides[0])), float(rng.uniform(0, sides[1]))
            if min(math.dist(at, each) for each in (*places, *spots)) >= OBJECT_AWAY:
                spots.append(at)
        return [FingertipLoad(*at, load) for at in spots]
    x, y = hand
    if not of.distance:
        return [FingertipLoad(x, y, tip.multiplied(of.hand))]
    quarter = tip.multiplied(of.hand / 4)
    ways = [each * PATCH * of.size / HAND_MAJOR for each in (-1, 1)]
    return [FingertipLoad(x + a, y + b, quarter) for a in ways for b in ways]


def contrasts_on(
    table: LocalizationTable,
    found: Answer,
    plates: Plates,
    of: Situation,
    patches: list[FingertipLoad],
    rng: np.random.Generator,
) -> FloatArray:
    """Contrast [dB] of both fingers to the other's content on plates solved exactly, (2, d).

    The least over all sets of thresholds; by those of a person if there is one.
    """
    tip, places = table.fingertip or Fingertip(), [each.at for each in found.asked[:2]]
    pressed = tip.scaled((of.force / LIGHT_FORCE) ** (2 / 3))
    loads = [*(FingertipLoad(*at, pressed) for at in places), *patches]
    tips = read_fingertips(table, [(each.x, each.y) for each in loads])
    shares, discs = tips.fine_weights[:2], tips.fine.astype(float)
    count = len(plates.thickness)
    sets = [*range(len(table.threshold_sets))]
    power = np.zeros((len(sets), 2, 2, discs.shape[1], count))  # set, layer, finger, point, plate
    offsets = rng.normal(scale=4.0, size=(count, len(STUDIED)))
    for number, layer in enumerate(found.layers):
        hertz, bases = base_amplitudes(layer.excitation, table.eras)
        rows = table.rows_of(hertz)
        at = discs, loads
        one = accelerations_on(table, *at, table.attached, rows, bases[:, None], plates)
        distorted = replace(plates, gain=plates.gain * plates.harmonic)
        twice = table.at_harmonics.plate
        two = accelerations_on(table, *at, twice, rows, bases[:, None], distorted)
        errors = np.abs(bases) / table.highest_drives[rows]
        error = np.sqrt((table.field_error_power[rows] * errors**2).sum(axis=1))
        one = one[:, :, 0].reshape(count, len(rows), len(loads), -1)
        one = one + plates.deviation[:, None, :, None] * error[None, :, None, None]
        two = two[:, :, 0].reshape(count, len(rows), len(loads), -1)
        person = np.zeros(count)
        if of.person == "tilted":
            f, db = np.log(np.array(OH_AND_CHOI).T[0]), np.array(OH_AND_CHOI).T[1]
            person += np.interp(np.log(hertz[0]), f, db)
        elif of.person == "drawn":
            at_f = np.log(hertz[0])
            person += [np.interp(at_f, np.log(STUDIED), each) for each in offsets]
        for s in sets:
            by = (table.thresholds / table.sensitivities[s])[rows]
            by_two = (table.compared_harmonic_thresholds / table.harmonic_sensitivities[s])[rows]
            total = (np.abs(one) ** 2 / by[None, :, None, None] ** 2).sum(axis=1)
            total += (np.abs(two) ** 2 / by_two[None, :, None, None] ** 2).sum(axis=1)
            power[s, number] = (total / 10 ** (person / 10)[:, None, None]).transpose(1, 2, 0)[:2]
    contrast = []
    for s in sets if not of.person else [0]:
        own = [shares[k] @ np.sqrt(power[s, k, k]) for k in range(2)]
        other = [np.sqrt(power[s, 1 - k, k].max(axis=0)) for k in range(2)]
        contrast.append(decibels(np.array(own) / np.array(other)))
    return np.asarray(np.min(contrast, axis=0))


if __name__ == "__main__":
    main()
