"""Random contact sets on a rig, robust patterns for them, and envelopes as they are realised."""

import math
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.setting import random_contacts
from model.arrays import ComplexArray
from model.finger import (
    FINGERTIP_RADIUS,
    STRONG_DB_SL,
    contrast_db,
    detection_threshold,
    fingertip_points,
)
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig, Uncertainty
from model.transients.base_motion import Envelopes
from model.vibration import Excitation, Tone

FREQUENCIES = np.linspace(40, 500, 27)
WANTED = 1.0  # m/s²


@dataclass(frozen=True)
class Case:
    """One contact set with its pattern at full stroke; contacts[0] is the target."""

    contacts: list[tuple[float, float]]
    frequency: float
    weights: ComplexArray
    at_target: ComplexArray  # acceleration of each ERA at full stroke (eras, p)
    at_quiet: ComplexArray

    @property
    def targets(self) -> list[tuple[float, float]]:
        return self.contacts[:1]

    @property
    def quiet(self) -> list[tuple[float, float]]:
        return self.contacts[1:]

    @property
    def felt_level(self) -> float:
        """Level 0..1 at which the target feels 20 dB SL."""
        full = np.abs(self.weights @ self.at_target).mean()
        felt = detection_threshold(np.array([self.frequency]))[0] * 10 ** (STRONG_DB_SL / 20)
        return float(min(1.0, felt / full))

    def steady_db(self, weights: ComplexArray) -> float:
        target, quiet = np.abs(weights @ self.at_target), np.abs(weights @ self.at_quiet)
        return float(contrast_db([target], quiet, [np.full(len(target), 1 / len(target))]))

    def excitation(
        self, rig: Rig, level: float = 1.0, errors: ComplexArray | None = None
    ) -> Excitation:
        weights = level * self.weights * (1 if errors is None else errors)
        return {
            era.name: Tone.from_phasor(self.frequency, era.full_level * complex(w))
            for era, w in zip(rig.eras, weights, strict=True)
        }


def loaded_weights(target: ComplexArray, quiet: ComplexArray) -> tuple[float, ComplexArray]:
    """Score and weights (eras,) at one frequency from fields (eras, p): R w = conj(h).

    The loudest quiet points are given more weight in a few rounds.
    """
    sigma = math.sqrt(Uncertainty().gain_variance)
    shares = np.full(quiet.shape[1], 1 / quiet.shape[1])
    power = np.abs(quiet) ** 2
    best, kept = 0.0, np.zeros(len(target), dtype=complex)
    for _ in range(6):
        R = (quiet.conj() * shares) @ quiet.T + sigma**2 * np.diag(power @ shares)
        w = np.linalg.solve(R, target.mean(axis=1).conj())
        w /= np.abs(w).max()
        reached = np.abs(w @ target).mean()
        likely = np.abs(w @ quiet) ** 2 + sigma**2 * np.abs(w) ** 2 @ power
        score = reached / math.sqrt(likely.max())
        if score > best and reached >= WANTED:
            best, kept = float(score), w
        shares = shares * likely / (shares @ likely)
    return best, kept


def find_cases(rig: Rig, *, others: int, count: int, rng: np.random.Generator) -> list[list[Case]]:
    """For each contact set its patterns, the best first."""
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=float(FREQUENCIES[-1]))
    size = (rig.plate.length, rig.plate.width)
    cases: list[list[Case]] = []
    while len(cases) < count:
        places = random_contacts(rng, 1 + others, size, margin=FINGERTIP_RADIUS)
        contacts = [(float(x), float(y)) for x, y in places]
        fields = [
            free.acceleration(
                rig.eras, FREQUENCIES, fingertip_points(*each, rig.plate), loads=rig.masses
            )
            for each in contacts
        ]
        target, quiet = fields[0], np.concatenate(fields[1:], axis=-1)
        found = [loaded_weights(target[f], quiet[f]) for f in range(len(FREQUENCIES))]
        order = np.argsort([-score for score, _ in found])
        cases.append(
            [
                Case(contacts, float(FREQUENCIES[f]), found[f][1], target[f], quiet[f])
                for f in order
                if found[f][0] > 0
            ]
        )
    return cases


def case_of(excitation: Excitation, patterns: list[Case], rig: Rig) -> Case:
    """The case of another excitation of one frequency, for the same contacts."""
    weights = np.zeros(len(rig.eras), dtype=complex)
    for number, era in enumerate(rig.eras):
        tone = excitation.get(era.name)
        if tone is not None:
            weights[number] = tone.phasor / era.full_level
    (frequency,) = {tone.frequency for tone in excitation.values()}
    same = min(patterns, key=lambda each: abs(each.frequency - frequency))
    return replace(same, weights=weights)


def with_errors(envelopes: Envelopes, rig: Rig, errors: ComplexArray) -> Envelopes:
    return {
        era.name: replace(
            envelopes[era.name],
            start=complex(envelopes[era.name].start * error),
            knots=tuple(complex(knot * error) for knot in envelopes[era.name].knots),
        )
        for era, error in zip(rig.eras, errors, strict=True)
    }


def quantised(envelopes: Envelopes, rig: Rig) -> Envelopes:
    """As a wire carries them: level in 1e-4 of the stroke, phase in 0.01 degrees."""

    def rounded(value: complex, stroke: float) -> complex:
        level = round(abs(value) / stroke * 1e4) / 1e4
        angle = math.radians(round(math.degrees(np.angle(value)) * 100) / 100)
        return complex(level * stroke * np.exp(1j * angle))

    return {
        name: replace(
            each,
            start=rounded(each.start, rig.era(name).full_level),
            knots=tuple(rounded(knot, rig.era(name).full_level) for knot in each.knots),
        )
        for name, each in envelopes.items()
    }
