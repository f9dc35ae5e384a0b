"""Fingers that rest on the plate, by id."""

from model.structure.attachments import Fingertip, FingertipLoad

FINGERTIP = Fingertip(
    stiffness=1000.0,
    damping=2.0,
    contact_mass=0.0002,
    phalanx_mass=0.005,
    joint_stiffness=500.0,
    joint_damping=2.0,
)


def resting(
    *places: tuple[float, float], fingertip: Fingertip = FINGERTIP
) -> dict[str, FingertipLoad]:
    """Fingers at places [m], with ids a, b, ..."""
    return {
        chr(ord("a") + number): FingertipLoad(x, y, fingertip)
        for number, (x, y) in enumerate(places)
    }
