"""How well a rig knows its plate, its ERAs, its amplifiers and the fingers on it."""

import math
from dataclasses import dataclass

from model.errors import expect_between

BOUNDS = {
    "gain": (0.0, 0.5),
    "phase_deg": (0.0, 60.0),
    "thickness": (0.0, 0.03),
    "stiffness": (0.0, 0.5),
    "damping": (1.0, 4.0),
    "fingertip": (0.0, 1.0),
    "common_gain": (0.0, 0.5),
    "field": (0.0, 0.5),
    "modulus": (0.0, 0.1),
    "place": (0.0, 0.01),
    "harmonic": (0.0, 0.2),
    "supports": (0.0, 0.5),
}
"""What a rig may state of each parameter: exactly known, and the most."""

_RELATIVE = (
    "gain",
    "thickness",
    "modulus",
    "stiffness",
    "supports",
    "common_gain",
    "field",
    "harmonic",
)

MAX_UNCERTAINTY = 1000.0
"""Of any of them, also in a study of plates beyond BOUNDS."""


@dataclass(frozen=True)
class Uncertainty:
    """One standard deviation of each parameter; independent of each other.

    gain: of each channel, relative; phase_deg: of each channel [degrees]; thickness: of the plate,
    relative; stiffness: of each ERA, relative; damping: a factor, of the ERAs' damping and of the
    plate's loss factor, 1 for none; fingertip: of the logarithm of each finger's load; common_gain:
    of all channels together, relative; field: of what an ERA alone does at a finger, relative to
    its root mean square over the plate, beside all others; modulus: of the plate's modulus of
    elasticity, relative, and known where the thickness is; place: of each ERA along x and along y
    [m]; harmonic: second harmonic of each ERA's motion, root mean square as a share of its own
    amplitude, of any phase; supports: of the logarithm of the stiffness of each foot, 0.3 of a rig
    file with feet by default. The defaults are those of a plate as built from its drawing and not
    measured.
    """

    gain: float = 0.05
    phase_deg: float = 5.0
    thickness: float = 0.02
    stiffness: float = 0.1
    damping: float = 1.5
    fingertip: float = 0.5
    common_gain: float = 0.0
    field: float = 0.0
    modulus: float = 0.02
    place: float = 0.001
    harmonic: float = 0.01
    supports: float = 0.0

    def __post_init__(self) -> None:
        """Refuse values that are not finite, negative ones, and a factor below 1."""
        for key, (exact, _) in BOUNDS.items():
            expect_between(getattr(self, key), exact, MAX_UNCERTAINTY, what=f"uncertainty: {key}")

    @classmethod
    def none(cls) -> "Uncertainty":
        """A rig whose every parameter is known exactly."""
        return cls(**{key: exact for key, (exact, _) in BOUNDS.items()})

    @classmethod
    def clipped(cls, **estimates: float) -> "Uncertainty":
        """An uncertainty by estimates, each brought within BOUNDS."""
        return cls(
            **{
                key: min(max(value, BOUNDS[key][0]), BOUNDS[key][1])
                for key, value in estimates.items()
            }
        )

    def __str__(self) -> str:
        """Its terms that are not none, as 'gain 5 %, phase 5°, damping x 1.5'."""
        percents = [
            f"{key.replace('_', ' ')} {100 * getattr(self, key):.3g} %"
            for key in _RELATIVE
            if getattr(self, key)
        ]
        others = [
            f"phase {self.phase_deg:.3g}°" if self.phase_deg else "",
            f"damping x {self.damping:.4g}" if self.damping > 1 else "",
            f"fingertip x {math.exp(self.fingertip):.2g}" if self.fingertip else "",
            f"place {1e3 * self.place:.3g} mm" if self.place else "",
        ]
        return ", ".join([*percents, *filter(None, others)]) or "none"

    @property
    def gain_variance(self) -> float:
        """Mean square of a channel's relative error, phase included: (1 + g²) exp(p²) - 1.

        Relative to the mean of all, whose amplitude is smaller by exp(-p² / 2); p in radians.
        """
        return (1 + self.gain**2) * math.exp(math.radians(self.phase_deg) ** 2) - 1

    @property
    def elasticity(self) -> float:
        """Of the modulus, relative: it is known where the thickness is, as a plate that stays."""
        return self.modulus if self.thickness > 0 else 0.0

    @property
    def frequency(self) -> float:
        """Of the plate's natural frequencies, relative: as the thickness and the modulus' root."""
        return math.hypot(self.thickness, self.elasticity / 2)

    @staticmethod
    def of_frequency(std: float) -> dict[str, float]:
        """Thickness and modulus, as uncertain as each other, of that of natural frequencies."""
        each = std / math.hypot(1.0, 0.5)
        return {"thickness": each, "modulus": each}
