"""Hidden plates: what each set of them may differ in, and what can be measured on them."""

from dataclasses import dataclass

import numpy as np

from benchmarks.identification.thin_plate import Complexes, Mounted, Reals, ThinPlate

LENGTH, WIDTH, THICKNESS = 0.3048, 0.2286, 0.0015
MODULUS, DENSITY, RATIO = 70e9, 2700.0, 0.33
STIFFNESS, DAMPING_RATIO, LOSS = 17_000.0, 0.05, 0.01
CORNERS = np.array([(0, 0), (LENGTH, 0), (LENGTH, WIDTH), (0, WIDTH)])
FAMILY = ("plain", "form", "hard", "uneven")
SETS = (*FAMILY, "wedge", "bumps", "frame", "loose", "heavy", "two")
PLAIN = ("plain", "frame")  # no form errors
TAPER = {"uneven": 0.015, "wedge": 0.03}  # of the thickness, from the middle to the ends
BUMPS, BUMP = (5, 4), 0.03  # of the thickness, standard deviation of each of so many fields
FRAME, FRAME_STIFFER, FRAME_HEAVIER = 12e-3, 0.8, 0.35
LOOSE = 0.35  # of its spring and damper
HEAVY = {"heavy": [10e-3], "two": [5e-3, 5e-3]}
INSIDE = np.array([(0.31, 0.37), (0.68, 0.59)]) * (LENGTH, WIDTH)
"""Places of sensors that are not at ERAs."""
NOISE, FLOOR = 0.01, 0.001
PULP, PULP_DAMPING, CONTACT, PHALANX, JOINT, JOINT_DAMPING = 1000.0, 2.0, 2e-4, 5e-3, 500.0, 2.0
LOAD_STD = 0.5


@dataclass(frozen=True, eq=False)
class Hidden:
    """A plate as it is: mounted, with the gains of sensors at its ERAs (n,) and of those INSIDE."""

    mounted: Mounted
    sensor_gain: Complexes
    inside_gain: Complexes

    def measured(
        self, frequencies: Reals, rng: np.random.Generator, sensors: int = len(CORNERS)
    ) -> Complexes:
        """Responses at ERAs, and INSIDE at more sensors than these (f, s, n) [1/s²], with noise."""
        at = np.vstack([self.mounted.at, INSIDE])[:sensors]
        clean = np.array([self.mounted.accelerations(f, at) for f in frequencies])
        clean *= np.append(self.sensor_gain, self.inside_gain)[:sensors, None]
        rms = np.sqrt((np.abs(clean) ** 2).mean(axis=(0, 2)))[:, None]
        noise = rng.standard_normal((2, 2, *clean.shape))
        parts = noise[:, 0] + 1j * noise[:, 1]
        return np.asarray(clean + NOISE * np.abs(clean) * parts[0] + FLOOR * rms * parts[1])

    def felt(self, frequency: float, points: Reals, fingers: Reals, factors: Reals) -> Complexes:
        """Acceleration at points (p, 2) per base displacement (p, n) [1/s²].

        fingers (k, 2) [m], factors (k, 4) of their loads, (0, 4) for weightless ones.
        """
        loads = np.array([finger_stiffness(frequency, each) for each in factors], dtype=complex)
        return self.mounted.accelerations(
            frequency, points, fingers=fingers if len(loads) else None, loads=loads
        )


def draw(kind: str, seed: int) -> Hidden:
    """Draw a plate of a set.

    Plain, form (places and a hidden mass), hard (all else, too), or form with what the model has
    not: uneven and wedge (tapered), bumps (of thickness), loose (one ERA) or with other masses:
    heavy (10 g) and two (of 5 g); or frame (plain but for one bonded along the edges).
    """
    rng = np.random.default_rng([seed, SETS.index(kind)])
    normal = rng.standard_normal
    n, hard = len(CORNERS), kind == "hard"
    thick = 1 + 0.02 * normal()
    stiff = np.maximum(1 + 0.1 * normal(n), 0.3)
    damped, lossy = 1.5 ** normal(), 1.5 ** normal()
    each = np.exp(0.2 * normal(n))
    gain = (1 + 0.05 * normal(n)) * np.exp(1j * np.radians(5) * normal(n))
    sensor = (1 + 0.05 * normal(n)) * np.exp(1j * np.radians(5) * normal(n))
    inwards = np.abs(1.5e-3 * normal((n, 2))) * (kind not in PLAIN)
    mass = np.array([[*(rng.uniform(0.03, 0.97, 2) * (LENGTH, WIDTH)), 3e-3]])
    sides = np.array([LENGTH, WIDTH]) + hard * 0.5e-3 * normal(2)
    ratio, modulus = RATIO + hard * 0.015 * normal(), MODULUS * (1 + hard * 0.02 * normal())
    bolt, exponent = hard * np.abs(0.5e-3 * normal(n)), hard * 0.3 * normal()
    thickest = rng.uniform(0, 2 * np.pi)
    taper = TAPER.get(kind, 0.0) * np.array([np.cos(thickest), np.sin(thickest)])
    inside = (1 + 0.05 * normal(len(INSIDE))) * np.exp(1j * np.radians(5) * normal(len(INSIDE)))
    if kind in HEAVY:
        weights = HEAVY[kind]
        at_random = rng.uniform(0.03, 0.97, (len(weights), 2)) * (LENGTH, WIDTH)
        mass = np.column_stack([at_random, weights])
    if kind == "loose":
        loose = rng.integers(n)
        stiff[loose] *= LOOSE
        each[loose] *= LOOSE
    plate = ThinPlate(
        *(sides[0], sides[1], THICKNESS * thick, modulus, DENSITY, ratio),
        parts=_parts(kind, (float(sides[0]), float(sides[1])), rng),
        taper=(float(taper[0]), float(taper[1])),
    )
    corners = np.where(CORNERS > 0, sides, 0.0)
    at = corners + np.where(CORNERS > 0, -inwards, inwards)
    damping = 2 * DAMPING_RATIO * np.sqrt(STIFFNESS * LENGTH * WIDTH * THICKNESS * DENSITY / n)
    mounted = Mounted(
        plate,
        at,
        STIFFNESS * stiff,
        damping * damped * each,
        bolt,
        gain,
        mass if kind not in PLAIN else mass[:0],
        LOSS * lossy,
        exponent,
    )
    return Hidden(mounted, sensor, inside)


def _parts(
    kind: str, sides: tuple[float, float], rng: np.random.Generator
) -> tuple[tuple[float, ...], ...]:
    """Parts of a plate with a bonded frame, or of one with bumps."""
    length, width = sides
    if kind == "frame":
        inner = (FRAME, length - FRAME, FRAME, width - FRAME)
        return (
            (0.0, length, 0.0, width, FRAME_STIFFER, FRAME_HEAVIER),
            (*inner, -FRAME_STIFFER, -FRAME_HEAVIER),
        )
    if kind != "bumps":
        return ()
    x, y = (np.linspace(0, side, count + 1) for side, count in zip(sides, BUMPS, strict=True))
    thicker = BUMP * rng.standard_normal(BUMPS)
    return tuple(
        (*x[i : i + 2].tolist(), *y[j : j + 2].tolist(), (1 + t) ** 3 - 1, t)
        for (i, j), t in np.ndenumerate(thicker)
    )


def finger_stiffness(frequency: float, factors: Reals) -> complex:
    """Force per displacement of a finger, a contact mass on a pulp before a phalanx on its joint.

    factors (4,): on contact mass, pulp, phalanx, joint.
    """
    w, (mass, soft, bone, held) = 2 * np.pi * frequency, factors
    pulp = soft * (PULP + 1j * w * PULP_DAMPING)
    joint = held * (JOINT + 1j * w * JOINT_DAMPING)
    moved = pulp / (pulp + joint - w**2 * PHALANX * bone)
    return complex(-(w**2) * CONTACT * mass + pulp * (1 - moved))
