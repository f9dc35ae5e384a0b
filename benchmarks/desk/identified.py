"""A rig that `era rig identify` wrote, against the truth of the plate on the desk."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.desk.errors import Error
from benchmarks.desk.session import Desk
from benchmarks.desk_plate.truth import Actuator
from model.rig.rig import Rig
from model.rig.rig_file import load_rig

_AT_BOLT = 5e-3  # m; an additional mass nearer than that is told from the bolt by nothing


@dataclass(frozen=True)
class Identified:
    """What came of an identification; contrasts: one for each number of quiet fingers."""

    seed: int
    measure_s: float
    solve_s: float
    chi2: float
    held_out_error: float
    contrasts: tuple[dict[str, Any], ...]
    errors: tuple[Error, ...]


def identify(plate: Desk, *, seed: int) -> Identified:
    """Identify the plate on a desk through its sound card; raises RuntimeError."""
    told = plate.run(
        "rig", "identify", "rig.yaml", "--device", "jack:desk", "--sensors", "sensors.csv",
        "-o", "identified.yaml", "--yes",
    )  # fmt: skip
    return Identified(
        seed=seed,
        measure_s=told["measure_time_s"],
        solve_s=told["solve_time_s"],
        chi2=told["chi2"],
        held_out_error=told["held_out_error"],
        contrasts=tuple(told["expected_contrast"]),
        errors=tuple(identified_errors(load_rig(plate.folder / "identified.yaml"), plate.truth)),
    )


def identified_errors(rig: Rig, truth: dict[str, Any]) -> list[Error]:
    """Errors of all values, relative, of places [m] and of phases [rad].

    Per mass of the plate, as those of `era calibrate`; rigidity and loss with what was found of
    single modes, in their geometric mean; gains relative to the mean of all drives, at the worst
    frequency. Standard errors are those of the rig's `uncertainty`, where that states one.
    """
    plate, std = rig.plate, rig.uncertainty
    mass = truth["thickness_m"] / plate.thickness  # of the true plate relative to the identified
    eigenvalues, losses = np.exp(np.mean(np.log(np.reshape(_modes(rig), (-1, 2))), axis=0))
    scatter = math.log(std.damping)
    rigidity = mass * plate.flexural_rigidity * eigenvalues / truth["flexural_rigidity_n_m"]
    loss = plate.loss_factor * losses / truth["loss_factor"]
    found = [
        _error("rigidity", rigidity - 1, 2 * std.thickness),
        _error("loss_factor", loss - 1, scatter),
    ]
    share = plate.mass / 4
    drives = _drives(rig, truth)
    for era, drive in zip(rig.eras, drives, strict=True):
        own = truth["eras"][era.name]
        bolt = era.in_time.mass + sum(
            each.mass
            for each in rig.masses
            if math.hypot(each.x - era.x, each.y - era.y) < _AT_BOLT
        )
        worst = int(np.abs(np.log(np.abs(drive))).argmax())
        found += [
            _error("stiffness", mass * era.stiffness / own["stiffness"] - 1, std.stiffness),
            _error("damping", mass * era.damping / own["damping"] - 1, scatter),
            _error("bolt_mass", (mass * bolt - own["bolt_mass"]) / (mass * share)),
            _error("place", math.dist((era.x, era.y), own["at_m"])),
            _error("gain", float(np.abs(drive)[worst] - 1), std.gain),
            _error("phase", float(np.abs(np.angle(drive)).max()), math.radians(std.phase_deg)),
        ]
    return found


def _modes(rig: Rig) -> list[tuple[float, float]]:
    """Factors of eigenvalues and loss factors of the lowest modes."""
    return [(math.exp(a), math.exp(b)) for a, b in rig.plate.mode_deviations]


def _drives(rig: Rig, truth: dict[str, Any]) -> list[np.ndarray]:
    """Identified over true gain of each drive at frequencies, relative to the mean of all."""
    frequencies = np.arange(rig.limits.frequency_min, rig.limits.frequency_max + 1, 10.0)
    ratios = []
    for era in rig.eras:
        own = truth["eras"][era.name]
        actuator = Actuator(own["resonance_hz"], own["damping_ratio"], own["gain"])
        ratios.append(era.gain(frequencies) / actuator.response(frequencies))
    logarithms = np.log(ratios)
    return list(np.exp(logarithms - logarithms.mean()))


def _error(kind: str, size: float, std: float | None = None) -> Error:
    return Error(kind, size, None if std is None else size / std)
