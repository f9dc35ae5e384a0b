"""The mechanical load of a resting fingertip on the plate.

Pressed on the plate, a fingertip is a contact mass that moves with it, and a spring and a damper
(the pulp) to the phalanx, which a joint holds. The phalanx is not at rest: at 60, 100 and 250 Hz
the real part of the dynamic stiffness is 69, -87 and -358 N/m where a phalanx at rest gives 972,
921 and 507. How well the values are known: docs/concepts/people.md.
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace

import numpy as np

from model.arguments import expect_at_least
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError

MIN_LOAD, MAX_LOAD = 0.1, 10.0
"""Of a contact relative to the rig's fingertip; beyond, no finger is meant."""


@dataclass(frozen=True)
class Fingertip:
    """Load of one fingertip.

    stiffness [N/m], damping [N s/m]: of the pulp; contact_mass [kg]: moves with the plate;
    phalanx_mass [kg], joint_stiffness [N/m], joint_damping [N s/m]: of the bone behind the pulp and
    of the joint that holds it to the rest plane. The defaults are those of a finger that presses
    lightly.
    """

    stiffness: float = 1000.0
    damping: float = 2.0
    contact_mass: float = 0.0002
    phalanx_mass: float = 0.005
    joint_stiffness: float = 500.0
    joint_damping: float = 2.0

    def __post_init__(self) -> None:
        """Refuse values not finite or negative, no damping of the pulp, and no phalanx."""
        for key in (field.name for field in fields(self)):
            expect_at_least(getattr(self, key), 0.0, what=f"fingertip: {key}")
        for key, unit in (("damping", "N s/m"), ("phalanx_mass", "kg")):
            if getattr(self, key) == 0:
                raise InputError(f"fingertip: {key} must be above 0 {unit}, got 0")

    def dynamic_stiffness(self, omega: FloatArray | ComplexArray) -> ComplexArray:
        """Force on the plate per displacement of the contact at omega [rad/s], of its shape [N/m].

        A complex omega is that of exp(i omega t).
        D = -omega² m_c + Z_p Z_b / (Z_p + Z_b), with Z_p = k + i omega c of the pulp and
        Z_b = k_j + i omega c_j - omega² m_p of the phalanx on its joint.
        """
        w = np.asarray(omega)
        pulp = self.stiffness + 1j * w * self.damping
        phalanx = self.joint_stiffness + 1j * w * self.joint_damping - w**2 * self.phalanx_mass
        return np.asarray(pulp * phalanx / (pulp + phalanx) - w**2 * self.contact_mass)

    def scaled(self, factor: float) -> "Fingertip":
        """The fingertip with a contact larger by a factor: its pulp and contact mass scale.

        Phalanx and joint stay, and so does the ratio of damping to stiffness of the pulp.
        """
        return replace(
            self,
            stiffness=factor * self.stiffness,
            damping=factor * self.damping,
            contact_mass=factor * self.contact_mass,
        )

    def multiplied(self, factor: float) -> "Fingertip":
        """The fingertip with a dynamic stiffness larger by a factor at every frequency."""
        return Fingertip(**{key: factor * value for key, value in asdict(self).items()})


@dataclass(frozen=True)
class FingertipLoad:
    """A fingertip that rests on the plate at x, y [m]; it acts at a point."""

    x: float
    y: float
    fingertip: Fingertip

    @property
    def foot(self) -> float:
        """Radius of the disc on which it acts [m]: 0, a point."""
        return 0.0

    def dynamic_stiffness(self, omega: FloatArray) -> ComplexArray:
        """Dynamic stiffness [N/m] at omega [rad/s], of the same shape."""
        return self.fingertip.dynamic_stiffness(omega)


def check_loads(loads: Iterable[float]) -> None:
    """Raise InputError for a load, relative to a fingertip, that no finger has."""
    for load in loads:
        if not MIN_LOAD <= load <= MAX_LOAD:  # False for NaN
            raise InputError(
                f"load must be between {MIN_LOAD:g} and {MAX_LOAD:g} times the rig's fingertip, "
                f"got {load}"
            )


def fingertip_loads(
    fingertip: Fingertip | None,
    contacts: Sequence[tuple[float, float]],
    loads: Sequence[float] = (),
) -> list[FingertipLoad]:
    """Fingertips that rest at contacts [m]; none where they are weightless.

    loads: of each relative to the fingertip, empty for 1.
    """
    if fingertip is None:
        return []
    tips = [fingertip.scaled(load) for load in loads] or [fingertip] * len(contacts)
    return [FingertipLoad(*at, tip) for at, tip in zip(contacts, tips, strict=True)]
