"""One plate from the first measurement to touches: what a user types, and what came of it."""

import math
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.desk.errors import Error
from benchmarks.desk.identified import Identified, identify
from benchmarks.desk.session import Desk, desk
from benchmarks.desk.touches import Touch, touches


@dataclass(frozen=True)
class Outcome:
    """Of one plate: times [s], coherence, errors of values, promises and touches.

    errors: of what was calibrated; identified: by `era rig identify`.
    """

    seed: int
    measure_s: float
    latency_samples: float
    repeated: int
    coherence_min: float
    held_out_error: float
    errors: tuple[Error, ...]
    promises: tuple[dict[str, Any], ...]
    touches: tuple[Touch, ...]
    identified: Identified

    def as_json(self) -> dict[str, Any]:
        """For a file of results."""
        return asdict(self)


def chain(
    *, seed: int, promises: int, touched: int, frequencies: str | None = None, mode: str = "phased"
) -> Outcome:
    """Measure, calibrate, build a table, verify promises, identify, touch; raises RuntimeError."""
    with tempfile.TemporaryDirectory(prefix="desk") as name, desk(Path(name), seed=seed) as plate:
        more = [] if frequencies is None else ["--frequencies", frequencies]
        measured = plate.run(
            "measure", "rig.yaml", "--device", "jack:desk", "--sensors", "sensors.csv",
            "-o", "measured.uff", *more,
        )  # fmt: skip
        fitted = plate.run("calibrate", "rig.yaml", "measured.uff", "-o", "calibrated.yaml")
        lines = measured["frequencies_hz"]
        band = [] if frequencies is None else ["--frequencies", f"{lines[0]:g}:{lines[-1]:g}:10"]
        plate.run("table", "build", "calibrated.yaml", "-o", "table.npz", "--mode", mode, *band)
        verified = plate.run(
            "table", "verify", "table.npz", "calibrated.yaml", "--device", "jack:desk",
            "--sensors", "sensors.csv", "--samples", promises, "--seed", seed, status=None,
        )  # fmt: skip
        found = identify(plate, seed=seed)  # before fingers weigh on the plate
        felt = touches(plate, _sets(touched, seed)) if touched else []
        sensors = measured["sensors"].values()
        return Outcome(
            seed=seed,
            measure_s=measured["measure_time_s"],
            latency_samples=48_000 * measured["latency_s"],
            repeated=measured["repeated_runs"],
            coherence_min=min(each["coherence_min"] for each in sensors),
            held_out_error=fitted["held_out"]["error_after"],
            errors=tuple(_errors(plate, fitted)),
            promises=tuple(verified["promises"]),
            touches=tuple(felt),
            identified=found,
        )


def _errors(plate: Desk, fitted: dict[str, Any]) -> list[Error]:
    """All fitted values against the truth, both per mass of the plate."""
    truth = plate.truth
    mass = truth["thickness_m"] / 1.5e-3  # of the true plate relative to the rig's
    share = 0.3048 * 0.2286 * 1.5e-3 * 2700 / 4  # kg of the plate on each ERA
    found = []
    for row in fitted["parameters"]:
        if row["standard_error"] is None:
            continue
        kind, size = row["kind"], math.nan
        if kind == "modulus":
            exact, kind = truth["flexural_rigidity_n_m"] / mass, "rigidity"
            rigidity = 1.5e-3**3 / (12 * (1 - 0.33**2))
            after, error = row["after"] * rigidity, row["standard_error"] * rigidity
        elif kind == "loss_factor":
            exact, after, error = truth[kind], row["after"], row["standard_error"]
        else:
            exact = truth["eras"][row["era"]][kind] / mass
            after, error = row["after"], row["standard_error"]
            size = share if kind == "bolt_mass" else math.nan
        scale = exact if math.isnan(size) else size
        found.append(Error(kind, (after - exact) / scale, (after - exact) / error))
    return found


def _sets(count: int, seed: int) -> list[list[str]]:
    """Sets of two and three sensors, the target first."""
    rng = np.random.default_rng([seed, 2])
    names = [f"P{number}" for number in range(1, 13)]
    return [list(map(str, rng.choice(names, 2 + k % 2, replace=False))) for k in range(count)]
