"""Promises next to hands and objects, under force, and for other people.

    python -m benchmarks.promise everyday [--only WORD ...]

Two contents of 14 dB SL at fingers at least 5 cm apart, on plates that are solved exactly and drawn
within the uncertainty of a rig. The heel of a hand is four patches 25 mm apart, which together have
the load of so many fingertips. The patches of a larger hand are farther apart; a hand in a corner
is a single patch. An object is a mass on a contact spring of 100 kN/m, and surplus fingers feel
nothing; both are anywhere, at least 3 cm from other fingers. Each cell has the promise to the worst
finger, median (worst 10 %), and the share of promises that is kept.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.promise.cases import LEVEL_DB_SL, RIGS, Case, Point
from benchmarks.setting import random_contacts
from controller.sources.contact_load import HAND_MAJOR, IN_MM, LIGHT_FORCE
from model.answer.answer import Answer
from model.answer.plan import answer
from model.answer.stimulus import Finger, Stimulus
from model.arrays import FloatArray
from model.finger import FINGERTIP_RADIUS, decibels
from model.structure.fingertips import Fingertip, FingertipLoad, object_load
from model.study.exact_plates import Plates, accelerations_on, discs_on, draw_plates
from model.table.fingertip_shapes import read_fingertips
from model.table.table import LocalizationTable
from model.vibration import Excitation, base_amplitudes

OBJECT_AWAY = 0.03  # m
PATCH = 0.0125  # m; of a patch of the heel from its middle, along x and along y
OH_AND_CHOI = ((40.0, 3.5), (250.0, -7.0))
"""Thresholds of pressing fingers relative to the probe's, by frequency [Hz] in dB."""
STUDIED = (40.0, 100.0, 250.0, 500.0)
"""Frequencies [Hz] at which a person differs from the mean independently, by 4 dB."""
PEOPLE = 0.5
"""Standard deviation of the logarithm of a finger's load between people who press equally hard."""
COVERED = "rig for 0.3 to 2 N"
"""A rig with 1.8 times the contact, and `fingertip: 0.8` (docs/concepts/people.md)."""
OH_CHOI, DRAWN = "Oh and Choi", "drawn"


@dataclass(frozen=True)
class Situation:
    """Difference from the situation that the answer is computed for.

    hand: its load in fingertips, 0 for none; distance [m]: of its middle from the nearer finger, 0
    for the corner farthest from both; size, reported [mm]: longer axis of the hand, and the value
    that the touch source reports. surplus: number of fingers that feel nothing. mass [kg]: of an
    object. is_counted: whether the answer counts the hand, the surplus fingers or the object. force
    [N]: of all fingers, whose loads vary between people by PEOPLE; load: of both fingers that the
    answer counts, in the rig's fingertips; fingertip: uncertainty of loads that it counts. off [m]:
    distance of both fingers from their reported positions, in any direction, None for a distance
    drawn within the rig's uncertainty; touch_position: as fingertip. person: the difference of the
    thresholds.
    """

    name: str
    hand: float = 0.0
    distance: float = 0.09
    size: float = HAND_MAJOR
    reported: float = HAND_MAJOR
    surplus: int = 0
    mass: float = 0.0
    is_counted: bool = True
    force: float = LIGHT_FORCE
    load: float = 1.0
    fingertip: float = PEOPLE
    off: float | None = None
    touch_position: float | None = None
    person: str = ""


def situations() -> Iterator[Situation]:
    """Yield the rows of the table."""
    yield Situation("none of these")
    palm = Situation("hand of 40 fingertips", 40, size=75.0)
    yield replace(palm, name=f"{palm.name}, not counted", is_counted=False)
    yield replace(palm, name=f"{palm.name}, counted with unknown size")
    yield replace(palm, name=f"{palm.name}, counted with its size", reported=75.0)
    for counted in (
        Situation("hand of 20 fingertips", 20),
        Situation("hand of 10 fingertips, far", 10, distance=0.0),
        Situation("ten surplus fingers", surplus=10),
        Situation("pen of 5 g", mass=0.005),
        Situation("phone of 50 g", mass=0.05),
        Situation("cup of 200 g", mass=0.2),
    ):
        yield replace(counted, name=f"{counted.name}, not counted", is_counted=False)
        yield replace(counted, name=f"{counted.name}, counted")
    yield Situation("touches exactly as reported", off=0.0)
    for off in (0.002, 0.004):
        stated = f"touches {1e3 * off:g} mm off"
        yield Situation(f"{stated}, taken for exact", off=off, touch_position=0.0)
        yield Situation(
            f"{stated}, `touch_position: {1e3 * off:g} mm`", off=off, touch_position=off
        )
    for force in (0.3, 1.0, 2.0, 3.0):
        pressing = Situation(f"force of {force:g} N", force=force)
        yield pressing
        yield replace(pressing, name=f"{pressing.name}, {COVERED}", load=1.8, fingertip=0.8)
    yield Situation("person according to Oh and Choi", person=OH_CHOI)
    yield Situation("person, 4 dB at four frequencies", person=DRAWN)


def run(sets: int, plates: int, words: Sequence[str]) -> None:
    """Print the rows whose names contain any of the words."""
    cases = [Case("", rig, is_identified=is_identified) for rig, is_identified in RIGS]
    print(f"| {' | '.join(['', *(case.title.lstrip(', ') for case in cases)])} |")
    print("|---" * (1 + len(cases)) + "|")
    for situation in situations():
        if any(word in situation.name for word in words):
            cells = [_promised_and_kept(case.table, situation, sets, plates) for case in cases]
            print(f"| {situation.name} | {' | '.join(cells)} |", flush=True)


def _promised_and_kept(
    table: LocalizationTable, situation: Situation, sets: int, plates: int
) -> str:
    promises, kept = [], []
    for seed in range(sets):
        scene = _Scene(table, situation, np.random.default_rng([seed, 14]))
        best = scene.answer()
        promised = np.array([each.promised_contrast_db for each in best.fingers[:2]], dtype=float)
        promises.append(promised.min())
        kept.append(scene.felt(best, plates) >= promised[:, None])
    median, worst = np.median(promises), np.percentile(promises, 10)
    return f"{median:.1f} ({worst:.1f}), {100 * np.mean(kept):.0f} %"


class _Scene:
    """Two fingers, and the loads of a situation, on plates of a table."""

    def __init__(
        self, table: LocalizationTable, situation: Situation, rng: np.random.Generator
    ) -> None:
        self._situation = situation
        self._rng = rng
        self._hand: Point | None = None
        self._size = (table.plate.length, table.plate.width)
        self._fingers = self._draw_fingers()
        self._table = replace(table, uncertainty=replace(table.uncertainty, **self._known()))
        self._loads = self._draw_loads(table.fingertip or Fingertip())

    def _known(self) -> dict[str, float]:
        """Return the uncertainty that the answer counts in place of the rig's."""
        known = {"fingertip": self._situation.fingertip}
        if self._situation.touch_position is not None:
            known["touch_position"] = self._situation.touch_position
        if self._situation.mass and self._situation.is_counted:
            known["foreign_mass"] = self._situation.mass
        return known

    def _draw_fingers(self) -> list[Point]:
        """Draw fingers that leave room for the hand."""
        margin = FINGERTIP_RADIUS + 0.001
        while True:
            drawn = random_contacts(self._rng, 2, self._size, margin=margin)
            fingers = [(float(x), float(y)) for x, y in drawn]
            if not self._situation.hand:
                return fingers
            self._hand = self._draw_hand(fingers)
            if self._hand is not None:
                return fingers

    def _draw_hand(self, fingers: Sequence[Point]) -> Point | None:
        """Draw the middle of a hand near the first finger; None if there is no room."""
        margin, distance = 2 * PATCH, self._situation.distance
        low = np.full(2, margin)
        high = np.array(self._size) - margin
        if not distance:
            corners = [(x, y) for x in (low[0], high[0]) for y in (low[1], high[1])]
            return max(corners, key=lambda at: min(math.dist(at, finger) for finger in fingers))
        for _ in range(100):
            angle = self._rng.uniform(0, 2 * np.pi)
            at = np.array(fingers[0]) + distance * np.array([np.cos(angle), np.sin(angle)])
            is_on = bool(((low <= at) & (at <= high)).all())
            if is_on and math.dist(at, fingers[1]) >= distance:
                return float(at[0]), float(at[1])
        return None

    def _draw_loads(self, tip: Fingertip) -> list[FingertipLoad]:
        """Return the loads of the hand, or of an object or surplus fingers."""
        situation = self._situation
        if self._hand is None:
            load = object_load(situation.mass) if situation.mass else tip
            positions: list[Point] = []
            while len(positions) < situation.surplus + (situation.mass > 0):
                x, y = self._rng.uniform(0, self._size[0]), self._rng.uniform(0, self._size[1])
                others = [*self._fingers, *positions]
                if min(math.dist((x, y), other) for other in others) >= OBJECT_AWAY:
                    positions.append((float(x), float(y)))
            return [FingertipLoad(x, y, load) for x, y in positions]
        x, y = self._hand
        if not situation.distance:
            return [FingertipLoad(x, y, tip.multiplied(situation.hand))]
        quarter = tip.multiplied(situation.hand / 4)
        offset = PATCH * situation.size / HAND_MAJOR
        offsets = (-offset, offset)
        return [FingertipLoad(x + dx, y + dy, quarter) for dx in offsets for dy in offsets]

    def answer(self) -> Answer:
        """Return the answer to the situation as far as it is counted."""
        stimulus = Stimulus(LEVEL_DB_SL)
        fingers = [Finger(at, stimulus, load=self._situation.load) for at in self._fingers]
        quiet = []
        if self._situation.is_counted and self._hand is not None:
            load = IN_MM.load(touch_major=self._situation.reported) or 0.0
            quiet = [Finger(self._hand, load=load)]
        elif self._situation.is_counted:
            surplus = self._loads[: self._situation.surplus]
            quiet = [Finger((each.x, each.y), is_protected=False) for each in surplus]
        return answer(self._table, [*fingers, *quiet], drive_mode="phased", min_contrast_db=-np.inf)

    def felt(self, best: Answer, count: int) -> FloatArray:
        """Return contrasts [dB] of both fingers on plates, the least over the sets, (2, count)."""
        plates = self._draw_plates(count)
        offset = self._thresholds_of_persons(best, count)
        powers = np.array(
            [
                self._powers(layer.excitation, plates) / 10 ** (offset[number] / 10)
                for number, layer in enumerate(best.layers)
            ]
        )  # layer, set, finger, point, plate
        weights = read_fingertips(self._table, self._fingers).fine_weights
        contrasts = []
        # A person has thresholds of their own, in place of all sets.
        for of_set in range(1 if self._situation.person else powers.shape[1]):
            for finger in range(2):
                own = weights[finger] @ np.sqrt(powers[finger, of_set, finger])
                foreign = np.sqrt(powers[1 - finger, of_set, finger].max(axis=0))
                contrasts.append(decibels(own / foreign))
        return np.asarray(np.array(contrasts).reshape(-1, 2, count).min(axis=0))

    def _draw_plates(self, count: int) -> Plates:
        """Draw plates; the loads of people vary by PEOPLE, whatever the answer counts."""
        uncertainty = replace(self._table.uncertainty, fingertip=PEOPLE)
        contacts = 2 + len(self._loads)
        plates = draw_plates(
            self._rng, uncertainty, of=self._table, count=count, contact_count=contacts
        )
        if self._situation.mass:
            plates.load[:, 2:] = 1.0
        if self._situation.off is not None:
            angles = self._rng.uniform(0, 2 * np.pi, (count, 2))
            directions = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
            plates.touches[:, :2] = self._situation.off * directions
        return plates

    def _thresholds_of_persons(self, best: Answer, count: int) -> FloatArray:
        """Thresholds of a person for each plate above the default ones, (layers, count) [dB]."""
        offsets = self._rng.normal(scale=4.0, size=(count, len(STUDIED)))
        tones = [layer.frequency or np.nan for layer in best.layers]
        logarithms = np.log(tones)
        if self._situation.person == OH_CHOI:
            frequencies, levels = np.transpose(OH_AND_CHOI)
            offset = np.interp(logarithms, np.log(frequencies), levels)
            return np.asarray(offset[:, None] * np.ones(count), dtype=float)
        if self._situation.person == DRAWN:
            persons = [np.interp(logarithms, np.log(STUDIED), each) for each in offsets]
            return np.asarray(np.transpose(persons), dtype=float)
        return np.zeros((len(best.layers), count))

    def _powers(self, excitation: Excitation, plates: Plates) -> FloatArray:
        """Powers relative to the threshold under both fingers, (sets, 2, points, plates)."""
        table = self._table
        tip = (table.fingertip or Fingertip()).scaled(
            (self._situation.force / LIGHT_FORCE) ** (2 / 3)
        )
        loads = [*(FingertipLoad(*at, tip) for at in self._fingers), *self._loads]
        discs = discs_on(table, [(each.x, each.y) for each in loads], plates)
        hertz, bases = base_amplitudes(excitation, table.eras)
        rows = table.rows_of(hertz)
        drives = bases[:, None]
        count = len(plates.thickness)
        shape = (count, len(rows), len(loads), -1)

        field = accelerations_on(table, discs, loads, table.attached, rows, drives, plates)
        field = field[:, :, 0].reshape(shape)
        relative = np.abs(bases) / table.highest_drives[rows]
        error = np.sqrt((table.field_error_power[rows] * relative**2).sum(axis=1))
        field = field + plates.deviation[:, None, :, None] * error[None, :, None, None]

        distorted = replace(plates, gain=plates.gain * plates.harmonic)
        twice = table.at_harmonics.plate
        harmonic = accelerations_on(table, discs, loads, twice, rows, drives, distorted)
        harmonic = harmonic[:, :, 0].reshape(shape)

        powers = []
        for of_set in range(len(table.threshold_sets)):
            at_tone = (table.thresholds / table.sensitivities[of_set])[rows]
            sensitivity = table.harmonic_sensitivities[of_set]
            at_harmonic = (table.compared_harmonic_thresholds / sensitivity)[rows]
            power = (np.abs(field) ** 2 / at_tone[None, :, None, None] ** 2).sum(axis=1)
            power += (np.abs(harmonic) ** 2 / at_harmonic[None, :, None, None] ** 2).sum(axis=1)
            powers.append(power[:, :2].transpose(1, 2, 0))
        return np.array(powers)
