"""What a rig check says of plates with a fault, which another solver computes.

    python -m benchmarks.identification.causes [--plates 5] [--sound 20] [--first 1] [--report]

Hidden plates are those of `benchmarks.identification.plates`, read by eight accelerometers at 16
tones with 1 % of noise, scales off by 1 % and places by 0.5 mm. It counts the plates of which the
check says what is wrong, and of which it says that anything is; --sound: of those without a fault.
With --report, the page docs/measured/identification.md is written as well.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.identification.__main__ import PAGE
from benchmarks.identification.plates import LENGTH, NOISE, WIDTH, Complexes, draw, finger_stiffness
from benchmarks.setting import RIG, write_parts
from model.estimate.findings import Verdict
from model.estimate.measurement import Measurement, sensors_at
from model.estimate.rig_check import diagnose, judged_by_promises
from model.rig.rig import Rig
from model.rig.rig_file import load_rig

FREQUENCIES = np.linspace(45.0, 495.0, 16)
SENSORS = np.array(
    [
        *([0.07, 0.15], [0.37, 0.08], [0.94, 0.12], [0.14, 0.44]),
        *([0.62, 0.41], [0.91, 0.57], [0.31, 0.80], [0.96, 0.93]),
    ]
) * (LENGTH, WIDTH)
_SCALE, _OFF = 0.01, 0.5e-3
_SHIFTED = 30e-3  # m


@dataclass(frozen=True)
class Fault:
    """A fault: of which kind of hidden plate, what it does, and whether a verdict says so."""

    kind: str
    is_named: Callable[[Verdict], bool]
    taper: float = 0.0
    mass: float = 0.0
    has_finger: bool = False
    change: Callable[[Complexes], Complexes] = lambda values: values
    shift: float = 0.0


def _finds(kind: str) -> Callable[[Verdict], bool]:
    return lambda verdict: bool(verdict.of_kinds(kind))


def _is_loose(verdict: Verdict) -> bool:
    """Whether a spring alone explains the plate."""
    best = verdict.hypotheses[0] if verdict.hypotheses else None
    return best is not None and bool(best.era)


def _states(state: str) -> Callable[[Verdict], bool]:
    return lambda verdict: state in verdict.channels[1].states


def _at(factor: float) -> Callable[[Complexes], Complexes]:
    """The second channel at a share of its amplitude."""
    return lambda values: values * np.array([1.0, factor, 1.0, 1.0])[:, None]


FAULTS = {
    "none": Fault("plain", lambda verdict: verdict.is_well),
    "none, with form errors and 3 g": Fault("form", lambda verdict: verdict.is_well),
    "bonded frame": Fault("frame", _finds("unnamed")),
    "thickness ± 3 % from end to end": Fault("plain", _finds("thickness"), taper=0.03),
    "the same with form errors and 3 g": Fault("wedge", _finds("thickness")),
    "thickness ± 1.5 %, form errors and 3 g": Fault("uneven", _finds("thickness")),
    "10 g": Fault("plain", _finds("mass"), mass=10e-3),
    "30 g": Fault("plain", _finds("mass"), mass=30e-3),
    "twice 5 g, with form errors": Fault("two", _finds("mass")),
    "a resting finger": Fault("plain", _finds("finger"), has_finger=True),
    "one ERA at 0.35 of its spring, form errors and 3 g": Fault("loose", _is_loose),
    "ERA at 70 %": Fault("plain", _states("weak"), change=_at(0.7)),
    "ERA at 35 %": Fault("plain", _states("weak"), change=_at(0.35)),
    "inverted": Fault("plain", _states("inverted"), change=_at(-1.0)),
    "dead": Fault("plain", _states("dead"), change=_at(1e-4)),
    "swapped": Fault("plain", _states("other ERA"), change=lambda values: values[:, [0, 2, 1, 3]]),
    "a sensor 30 mm from its place": Fault(
        *("plain", lambda verdict: bool(verdict.findings)), shift=_SHIFTED
    ),
}
"""Faults by name."""


def measured(fault: Fault, seed: int) -> Measurement:
    """Responses of a hidden plate with a fault."""
    rng = np.random.default_rng([seed, 93])
    mounted, size = draw(fault.kind, seed).mounted, np.array([LENGTH, WIDTH])
    at, angle = rng.uniform(0.1, 0.9, 2) * size, rng.uniform(0, 2 * np.pi)
    if fault.taper:
        taper = fault.taper * np.cos(angle), fault.taper * np.sin(angle)
        mounted = replace(mounted, plate=replace(mounted.plate, taper=taper))
    if fault.mass:
        mounted = replace(mounted, masses=np.array([[*at, fault.mass]]))
    true = SENSORS + _OFF * rng.standard_normal(SENSORS.shape)
    true[3] += fault.shift * np.array([np.cos(angle), np.sin(angle)])
    fingers = at[None] if fault.has_finger else None
    clean = [
        mounted.accelerations(
            *(f, true), fingers=fingers, loads=np.array([finger_stiffness(f, np.ones(4))])
        ).T
        for f in FREQUENCIES.tolist()
    ]
    heard = clean * (1 + _SCALE * rng.standard_normal(len(SENSORS)))
    values = fault.change(np.asarray(heard, dtype=complex))
    rms = np.sqrt((np.abs(values) ** 2).mean(axis=2, keepdims=True))
    white = rng.standard_normal((2, *values.shape))
    values = values + NOISE * rms * (white[0] + 1j * white[1]) / np.sqrt(2)
    names = tuple(f"P{number}" for number in range(1, 1 + len(SENSORS)))
    return Measurement(sensors_at(SENSORS, names), FREQUENCIES, values.swapaxes(1, 2))


def verdict_on(rig: Rig, name: str, seed: int) -> Verdict:
    """The check's verdict on a hidden plate with a fault by name."""
    return judged_by_promises(diagnose(rig, measured(FAULTS[name], seed), has_form=True), rig)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.identification.causes")
    parser.add_argument("--plates", type=int, default=5)
    parser.add_argument("--sound", type=int, default=20)
    parser.add_argument("--first", type=int, default=1, help="seed of the first plate")
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    rig = load_rig(RIG)
    lines = ["| fault | named | exit status 1 |", "|---|---|---|"]
    for name, fault in FAULTS.items():
        count = options.sound if name.startswith("none") else options.plates
        of = [verdict_on(rig, name, options.first + number) for number in range(count)]
        named, failed = sum(map(fault.is_named, of)), sum(not each.is_well for each in of)
        lines.append(f"| {name} | {named} of {count} | {failed} of {count} |")
        print(lines[-1], flush=True)
    if options.report:
        printed = (
            f"Printed by `python -m benchmarks.identification.causes --plates {options.plates} "
            f"--sound {options.sound} --first {options.first} --report`."
        )
        write_parts(PAGE, {"causes": "\n".join([printed, "", *lines])})


if __name__ == "__main__":
    main()
