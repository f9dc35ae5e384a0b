"""The paper's rig behind an amplifier of voltage, with resonant actuators."""

import asyncio
from dataclasses import replace

import numpy as np

from drivers import clock
from drivers.amplifier import Amplifier
from drivers.backend import Backend
from drivers.guard import require_safe
from drivers.protocol.messages import Reply, Request
from drivers.voltage import VoltageBackend
from model.arrays import ComplexArray, FloatArray
from model.rig.rig import Rig
from registry.voltage import Law, VoltageDrive
from sim.bench.bench import Bench

RESONANCES = {"SW": 140.0, "SE": 150.0, "NE": 165.0, "NW": 155.0}  # Hz
DAMPING_RATIO = 0.1
BAND = (60.0, 240.0)  # Hz
LAWS = {
    "linear": (Law.LINEAR, 0.0, 3.0),
    "quadratic": (Law.QUADRATIC, 0.0, 8.0),
    "quadratic with bias": (Law.QUADRATIC, 0.25, 5.0),
}
"""Law, bias, and full strokes by a slow drive term of 1."""


def resonator(frequencies: FloatArray, resonance: float, gain: float) -> ComplexArray:
    """Response of a resonator by its formula, at frequencies [Hz]."""
    x = frequencies / resonance
    return np.asarray(gain / (1 - x**2 + 2j * DAMPING_RATIO * x))


def moved(drive: FloatArray, times: FloatArray, resonance: float, gain: float) -> FloatArray:
    """Motion of the same resonator from rest, by its differential equation."""
    from scipy import signal  # takes half a second to load

    omega = 2 * np.pi * resonance
    system = signal.lti([gain * omega**2], [1.0, 2 * DAMPING_RATIO * omega, omega**2])
    _, y, _ = signal.lsim(system, drive, times)
    return np.asarray(y)


def voltage_rig(rig: Rig, law: str) -> Rig:
    """A rig with resonant actuators of a law, in a band in which they reach the full stroke."""
    kind, bias, gain = LAWS[law]
    frequencies = np.arange(20.0, 1001.0, 1.0)
    drives = {}
    for name, resonance in RESONANCES.items():
        found = resonator(frequencies, resonance, gain)
        rows = zip(frequencies, np.abs(found), np.angle(found), strict=True)
        response = tuple((float(f), float(size), float(phase)) for f, size, phase in rows)
        drives[name] = VoltageDrive(
            response, law=kind, bias=bias, minimum=-1.0 if bias else 0.0, frequencies=BAND
        )
    limits = replace(rig.limits, frequency_min=BAND[0], frequency_max=BAND[1])
    return replace(rig, voltage=drives, limits=limits)


class BenchBackend(Backend):
    """A simulated amplifier of a bench, without a wire."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self._last_sent_at = 0.0

    async def open(self) -> None:
        """Always succeeds."""

    async def close(self) -> None:
        """As asked."""

    @property
    def last_sent_at(self) -> float:
        """On the loop's clock [s]."""
        return self._last_sent_at

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Ask the bench, at the present time."""
        require_safe(request)
        self._last_sent_at = clock.now()
        await asyncio.sleep(0.001)
        return self.bench.exchange("main", request, now=clock.now())


def voltage_amplifier(bench: Bench) -> Amplifier:
    """The bench's amplifier, converted by the rig."""
    return Amplifier(VoltageBackend(BenchBackend(bench), bench.rig.voltage_of("main")))
