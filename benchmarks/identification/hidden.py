"""Hidden plates: what each set of them may differ in, and what can be measured on them."""

from dataclasses import dataclass

import numpy as np

from benchmarks.identification.thin_plate import Complexes, Mounted, Reals, ThinPlate

LENGTH, WIDTH, THICKNESS = 0.3048, 0.2286, 0.0015
MODULUS, DENSITY, RATIO = 70e9, 2700.0, 0.33
STIFFNESS, DAMPING_RATIO, LOSS = 17_000.0, 0.05, 0.01
CORNERS = np.array([(0, 0), (LENGTH, 0), (LENGTH, WIDTH), (0, WIDTH)])
SETS = ("plain", "form", "hard", "uneven")
TAPER = 0.015  # of the thickness, from the middle to the ends
NOISE, FLOOR = 0.01, 0.001
PULP, PULP_DAMPING, CONTACT, PHALANX, JOINT, JOINT_DAMPING = 1000.0, 2.0, 2e-4, 5e-3, 500.0, 2.0
LOAD_STD = 0.5


@dataclass(frozen=True, eq=False)
class Hidden:
    """A plate as it is: mounted, with the gains of sensors at its ERAs (n,)."""

    mounted: Mounted
    sensor_gain: Complexes
    truth: dict[str, float]

    def measured(self, frequencies: Reals, rng: np.random.Generator) -> Complexes:
        """Responses at the ERAs (f, s, n) [1/s²], with noise."""
        at = self.mounted.at
        clean = np.array([self.mounted.accelerations(f, at) for f in frequencies])
        clean *= self.sensor_gain[:, None]
        rms = np.sqrt((np.abs(clean) ** 2).mean(axis=(0, 2)))[:, None]
        noise = rng.standard_normal((2, 2, *clean.shape))
        parts = noise[:, 0] + 1j * noise[:, 1]
        return np.asarray(clean + NOISE * np.abs(clean) * parts[0] + FLOOR * rms * parts[1])


def draw(kind: str, seed: int) -> Hidden:
    """Draw a plate of a set.

    Plain, form (places and a hidden mass), hard (all else, too) or uneven (form, and tapered).
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
    inwards = np.abs(1.5e-3 * normal((n, 2))) * (kind != "plain")
    mass = np.array([[*(rng.uniform(0.03, 0.97, 2) * (LENGTH, WIDTH)), 3e-3]])
    sides = np.array([LENGTH, WIDTH]) + hard * 0.5e-3 * normal(2)
    ratio, modulus = RATIO + hard * 0.015 * normal(), MODULUS * (1 + hard * 0.02 * normal())
    bolt, exponent = hard * np.abs(0.5e-3 * normal(n)), hard * 0.3 * normal()
    thickest = rng.uniform(0, 2 * np.pi)
    taper = TAPER * (kind == "uneven") * np.array([np.cos(thickest), np.sin(thickest)])
    plate = ThinPlate(
        *(sides[0], sides[1], THICKNESS * thick, modulus, DENSITY, ratio),
        taper=(float(taper[0]), float(taper[1])),
    )
    corners = np.where(CORNERS > 0, sides, 0.0)
    at = corners + np.where(CORNERS > 0, -inwards, inwards)
    damping = 2 * DAMPING_RATIO * np.sqrt(STIFFNESS * LENGTH * WIDTH * THICKNESS * DENSITY / n)
    truth = {"thickness": np.log(thick), "loss factor": np.log(lossy)}
    truth |= {f"stiffness {i}": np.log(stiff[i]) for i in range(n)}
    truth |= {f"damping {i}": np.log(damped * each[i]) for i in range(n)}
    truth |= {f"gain {i}": np.log(abs(gain[i])) for i in range(n)}
    truth |= {f"phase {i}": np.angle(gain[i]) for i in range(n)}
    truth |= {f"sensor gain {i}": np.log(abs(sensor[i])) for i in range(n)}
    truth |= {f"sensor phase {i}": np.angle(sensor[i]) for i in range(n)}
    mounted = Mounted(
        plate,
        at,
        STIFFNESS * stiff,
        damping * damped * each,
        bolt,
        gain,
        mass if kind != "plain" else mass[:0],
        LOSS * lossy,
        exponent,
    )
    return Hidden(mounted, sensor, {key: float(value) for key, value in truth.items()})


def finger_stiffness(frequency: float, factors: Reals) -> complex:
    """Force per displacement of a finger, a contact mass on a pulp before a phalanx on its joint.

    factors (4,): on contact mass, pulp, phalanx, joint.
    """
    w, (mass, soft, bone, held) = 2 * np.pi * frequency, factors
    pulp = soft * (PULP + 1j * w * PULP_DAMPING)
    joint = held * (JOINT + 1j * w * JOINT_DAMPING)
    moved = pulp / (pulp + joint - w**2 * PHALANX * bone)
    return complex(-(w**2) * CONTACT * mass + pulp * (1 - moved))
