"""Bases that move in a way known twice: as a function of time, and as terms for the plant."""

import cmath
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from model.arrays import FloatArray
from model.structure.attachments import Fingertip, FingertipLoad
from model.transients.base_motion import Motion, Term, along_lines, raised_cosine


@dataclass(frozen=True)
class Base:
    """motion: displacement [m] and velocity [m/s] at a time [s]; terms: the same motion."""

    motion: Callable[[float], tuple[float, float]]
    terms: tuple[Term, ...]


def motion_of(motion: Motion, times: FloatArray) -> FloatArray:
    """Displacement [m] at times (n,) [s] by the definition of a term."""
    y = np.zeros(len(times))
    for term in motion:
        tau = times - term.start
        value = (term.c0 + term.c1 * tau) * np.exp(1j * term.omega * tau)
        y += np.where((times >= term.start) & (times < term.end), value.imag, 0.0)
    return y


STILL = Base(lambda time: (0.0, 0.0), ())


def faded_base(
    amplitude: float,
    frequency: float,
    phase: float,
    *,
    rise: tuple[float, float],
    fall: tuple[float, float],
) -> Base:
    """amplitude g(t) sin(2 pi frequency t + phase); g rises and falls along raised cosines.

    amplitude [m], frequency [Hz], phase [rad]; rise and fall: when each begins and ends [s].
    """
    omega = 2 * math.pi * frequency

    def motion(time: float) -> tuple[float, float]:
        (on, full), (off, silent) = rise, fall
        if not on <= time < silent:
            return 0.0, 0.0
        if time < full:
            turn = math.pi / (full - on)
            gain = (1 - math.cos(turn * (time - on))) / 2
            growth = turn * math.sin(turn * (time - on)) / 2
        elif time < off:
            gain, growth = 1.0, 0.0
        else:
            turn = math.pi / (silent - off)
            gain = (1 + math.cos(turn * (time - off))) / 2
            growth = -turn * math.sin(turn * (time - off)) / 2
        angle = omega * time + phase
        return (
            amplitude * gain * math.sin(angle),
            amplitude * (growth * math.sin(angle) + gain * omega * math.cos(angle)),
        )

    def at(time: float) -> complex:
        return cmath.rect(amplitude, omega * time + phase)

    up = raised_cosine(rise[0], rise[1] - rise[0], omega, 0j, at(rise[0]))
    up = (*up[:-1], up[-1]._replace(end=fall[0]))
    down = raised_cosine(fall[0], fall[1] - fall[0], omega, at(fall[0]), 0j)
    return Base(motion, (*up, *down))


def shaped_base(
    amplitude: float, frequency: float, *, start: float, step: float, knots: tuple[complex, ...]
) -> Base:
    """amplitude Im[a(t) exp(2 pi i frequency t)], a along straight lines through the knots.

    The first knot is at start [s], then one every step [s], then rest; amplitude [m].
    """
    omega = 2 * math.pi * frequency

    def motion(time: float) -> tuple[float, float]:
        steps = (time - start) / step
        before = math.floor(steps)
        if not 0 <= before < len(knots) - 1:
            return 0.0, 0.0
        slope = (knots[before + 1] - knots[before]) / step
        value = knots[before] + slope * (steps - before) * step
        turn = amplitude * cmath.exp(1j * omega * time)
        return (value * turn).imag, ((slope + 1j * omega * value) * turn).imag

    factor = amplitude * cmath.exp(1j * omega * start)
    return Base(motion, along_lines(start, step, omega, [factor * knot for knot in knots]))


STROKE = 1e-4  # m
BASES = (
    faded_base(STROKE, 110.0, 0.3, rise=(0.0, 0.02), fall=(0.07, 0.08)),
    STILL,
    faded_base(0.6 * STROKE, 250.0, -1.0, rise=(0.005, 0.015), fall=(0.08, 0.1)),
    shaped_base(STROKE, 110.0, start=0.0, step=0.005, knots=(0, 0.3, 0.5j, -0.8, 0.4 - 0.2j, 0)),
)
"""Ramps on two bases, an envelope on another, and one at rest."""


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
