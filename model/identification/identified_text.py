"""The text of a rig's file with identified values, once it was read back."""

from dataclasses import asdict

import numpy as np

from model.config.document import Document
from model.errors import InputError
from model.rig.file import parse_rig
from model.rig.rewritten import rewritten_text
from model.rig.rig import Rig


def identified_text(document: Document, before: Rig, after: Rig, *, comment: str) -> str:
    """A rig's file with the values of another rig of the same ERAs, comments kept.

    Raises ConfigError for a comment that would be lost, InputError where the text, read as a rig,
    has other values.
    """
    text = rewritten_text(document, before, after, comment=comment)
    read, wanted = (_numbers(one) for one in (parse_rig(document.source, text), after))
    # The absolute part is for numbers near zero: 1 mg, 1 µm, a ten-thousandth of a gain.
    if len(read) != len(wanted) or not np.allclose(read, wanted, rtol=1e-4, atol=1e-4):
        raise InputError(
            f"{document.source}: values read back must be the identified ones; write plate and "
            "ERAs as era config init does, and identify again"
        )
    return text


def _numbers(rig: Rig) -> list[float]:
    """Values of a rig: lengths in mm, masses in g."""
    plate = rig.plate
    found = [1e3 * plate.thickness, plate.material.E, plate.loss_factor, plate.loss_exponent]
    found += [part for pair in plate.mode_deviations for part in pair]
    found += asdict(rig.uncertainty).values()
    for era in rig.eras:
        found += [1e3 * era.x, 1e3 * era.y, era.stiffness, era.damping, 1e3 * era.bolt_mass]
        found += [part for _, size, phase in era.gains for part in (size, np.cos(phase))]
    for mass in rig.masses:
        found += [1e3 * mass.x, 1e3 * mass.y, 1e3 * mass.mass]
    return found
