"""Second harmonics of ERAs at fingers, by the direct solver at twice the frequency."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.direct_plate import direct_acceleration
from model.answer.fingers_on_plate import FingersOnPlate
from model.arrays import FloatArray
from model.ensemble.draws import PROMISED_DRAWS, percentile
from model.fem.mesh import ELEMENTS, Mesh
from model.fem.plate import assemble
from model.finger.fingertip import FINGERTIP_RADIUS, FIVE_POINTS
from model.finger.perception import detection_threshold
from model.rig.rig import Rig
from model.rig.uncertainty import Uncertainty
from model.structure.attachments import FingertipLoad
from model.table.build import build_table
from model.table.table import LocalizationTable
from paper_table import smooth_rig

PLACES = ((0.09, 0.07), (0.25, 0.18))
LOADS = (1.0, 2.5)
FREQUENCIES = np.array([60.0, 145.0, 260.0, 430.0, 520.0])
SHARE = 0.02
WEIGHTS = np.array(
    [[1, 0.3j, -0.5, 0.2], [0.1, 1, 0.4j, 0], [-1, 0.2, 0.6, 1j], [1, 1, 0, 0], [1, 0, 0, 0]],
    dtype=np.complex64,
)


@cache
def rig() -> Rig:
    """The paper's on a mesh that carries 1 kHz, whose drives move by half at twice a frequency."""
    plain = smooth_rig()
    gains = tuple((f, 1.0 if f < 60.5 or number else 0.5, 0.1) for f in (60.0, 61.0))
    eras = tuple(replace(era, gains=gains if not n else ()) for n, era in enumerate(plain.eras))
    mesh = Mesh(8, 6, plain.plate.length, plain.plate.width, ELEMENTS["Q5"])
    limits = replace(plain.limits, frequency_max=520.0)
    known = replace(Uncertainty.none(), harmonic=SHARE)
    return replace(plain, eras=eras, mesh=mesh, limits=limits, uncertainty=known)
