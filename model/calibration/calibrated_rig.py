"""Text of a rig file with calibrated values and unchanged comments and layout."""

from dataclasses import asdict
from pathlib import Path

import numpy as np

from model.calibration.calibration_result import Calibration
from model.config.document import Document
from model.errors import InputError
from model.rig.rewritten import rewritten_text
from model.rig.rig import Rig
from model.structure.actuator import Era


def calibrated_text(
    document: Document, before: Rig, calibration: Calibration, *, comment: str
) -> str:
    """Return a rig file's text with calibrated values, headed by a comment.

    Raises ConfigError if a comment of the file would be lost.
    """
    return rewritten_text(document, before, calibration.rig, comment=comment)


def check_reads_back(rig: Rig, expected: Calibration, path: Path) -> None:
    """Raise InputError unless a rig read from its new file has the calibrated values."""

    def numbers(one: Rig) -> list[float]:
        layers = one.laminate.layers if one.laminate else ()
        materials = [layer.material for layer in layers] or [one.plate.material]
        plate = [one.plate.loss_factor, *(material.E for material in materials)]
        plate += asdict(one.uncertainty).values()
        return plate + [v for era in one.eras for v in _numbers_of(era)]

    # The absolute part is for numbers near zero: 1 mg, 1 µN s/m, a millionth of a gain.
    read, fitted = numbers(rig), numbers(expected.rig)
    if len(read) != len(fitted) or not np.allclose(read, fitted, rtol=1e-4, atol=1e-6):
        raise InputError(
            f"{path}: values read back must be the calibrated ones; write plate and ERAs as "
            "`era config init` does and calibrate again"
        )


def _numbers_of(era: Era) -> list[float]:
    gains = [part for _, size, phase in era.gains for part in (size, np.cos(phase), np.sin(phase))]
    return [era.x, era.y, era.stiffness, era.damping, era.bolt_mass, *gains]
