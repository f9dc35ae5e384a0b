"""What every program solves: the founding paper's plate on four ERAs, 27 frequencies, four drives.

Plain numbers, so that a peer needs nothing of ours.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]

LENGTH, WIDTH, THICKNESS = 0.3048, 0.2286, 0.0015  # m
E, NU, RHO = 70e9, 0.33, 2700.0  # Pa, -, kg/m³
LOSS_FACTOR = 0.01
STIFFNESS, DAMPING, STROKE = 17000.0, 3.4631, 1e-4  # of each ERA: N/m, N s/m, m
FREQUENCIES = np.arange(60.0, 321.0, 10.0)  # Hz
OMEGA = 2 * np.pi * FREQUENCIES

# Corners of the plate, and another layout whose places are nodes of every mesh used here.
CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * [LENGTH, WIDTH]
INSET = np.array([[1, 1], [3, 1], [2, 2], [0, 3]]) / 4 * [LENGTH, WIDTH]

# Where answers are compared: vertices of all the meshes as well.
RASTER = np.stack(
    np.meshgrid(np.linspace(0, LENGTH, 17), np.linspace(0, WIDTH, 13)), axis=-1
).reshape(-1, 2)


def hold(omega: float) -> complex:
    """Dynamic stiffness [N/m] of an ERA at omega [rad/s]."""
    return STIFFNESS + 1j * omega * DAMPING
