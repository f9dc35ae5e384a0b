"""Sound cards without sound, exciters by another solution, and recordings as users read them.

A JACK server's output is captured, and a card in memory is in front of a plate on the desk, with
what can be wrong with its wires.

Of exciters the terms of every output are recorded as they reach the plate, sampled, and move the
matrices of plate and magnets, whose motion is integrated step by step. The exciter behind a
resistor is the far end of a sound card, in time; by the trapezoidal rule it is at a frequency f the
exact circuit at tan(pi f / rate) rate / pi, 0.14 % above at 1 kHz and 48 kHz, and less below.

Files of recordings are read by NumPy, SciPy and pyuff.
"""

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from scipy.signal import cont2discrete

from era_haptics.lab.measuring.sound_card import SoundCard
from kit.desk_plate import DeskPlate
from model.arrays import ComplexArray, Float32Array, FloatArray
from model.reduction.reduced_plate import reduce_plate
from model.reduction.supported_plate import modal_matrices
from model.rig.rig import Rig
from model.rig.rig_summary import exciters_of
from model.structure.attachments import footprints_of
from model.transients.base_motion import Motion
from processes.typed_page import ERA
from sim.plant.plant import Plant

RATE = 48_000
BLOCK = 256
START = 20.0  # s
HOST = str(Path(__file__).with_name("steady_host.py"))
JACK_PRIORITY = ("-R", "-P10") if os.geteuid() == 0 else ("-r",)
"""Options of jackd: real-time priority, which root may have, else the ordinary one."""


@dataclass(frozen=True)
class JackServer:
    """A running server; environment: of its clients."""

    process: "subprocess.Popen[bytes]"
    environment: dict[str, str]


@contextlib.contextmanager
def jack_server(
    name: str, *, rate: int = RATE, inputs: int = 2, outputs: int = 2, is_monitored: bool = False
) -> Iterator[JackServer]:
    """A server of its own, without a sound card.

    It is synchronous, so that a machine that stalls delays samples and loses none; one that is
    monitored is not, as servers of sound cards are not.
    """
    environment = os.environ | {"JACK_DEFAULT_SERVER": name, "JACK_NO_START_SERVER": "1"}
    dummy = ["-d", "dummy", "-p", str(BLOCK), "-r", str(rate)]
    dummy += ["-C", str(inputs), "-P", str(outputs)]
    waiting, monitors = ([], ["-m"]) if is_monitored else (["-S"], [])
    with subprocess.Popen(
        ["jackd", "-n", name, *waiting, *JACK_PRIORITY, *dummy, *monitors],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=environment,
    ) as process:
        try:
            yield JackServer(process, environment)
        finally:
            process.terminate()


UNWATCHED = """
import sys
from era_haptics.command import main
from sim.soft_amp.engine import library
library().sound_release()
sys.exit(main())
"""
"""`era` whose software amplifier survives stalls: the kernel's timer that would kill it is off."""


def soft_amp_program(*, is_watched: bool) -> list[str]:
    """Return the start of a command line of `era soft-amp`.

    is_watched: whether the kernel kills it when its sound stalls for 0.1 s, which a busy machine
    may cause.
    """
    program = [str(ERA)] if is_watched else [sys.executable, "-c", UNWATCHED]
    return [*program, "soft-amp"]


class SoftAmp:
    """A running `era soft-amp`; url: of its first amplifier.

    is_watched: whether a stall of its sound for 0.1 s ends it.
    """

    def __init__(
        self, *options: str, environment: dict[str, str], log: Path, is_watched: bool = True
    ) -> None:
        self._log = log
        with log.open("wb") as errors:
            self.process = subprocess.Popen(
                [*soft_amp_program(is_watched=is_watched), *options, "--until-eof"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env=environment,
            )
        self.url = self.process.stdout.readline().strip()

    @property
    def log(self) -> str:
        """What it has reported."""
        return self._log.read_text()

    def end(self) -> None:
        """End it as the end of its input does."""
        self.process.stdin.close()
        self.process.wait(START)
        self.process.stdout.close()


@contextlib.contextmanager
def host(url: str, channels: int) -> Iterator["subprocess.Popen[str]"]:
    """A program that plays 1 kHz at level 0.5 on every channel, each 30 degrees ahead."""
    with subprocess.Popen(
        [sys.executable, HOST, url, str(channels)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])},
    ) as process:
        assert process.stdout.readline() == "armed\n"
        yield process
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGKILL)


MEMORY_BLOCK = 4800


class DeskCard(SoundCard):
    """Samples of a plate, without time.

    lost: runs in which a block is lost; late: runs in which samples come as late as if a block had
    been lost before; reported: losses that the driver reports in each run; on_outputs,
    on_inputs: order of the cables, by default as they should be; gain: of all inputs;
    drifts: of the clocks of some inputs, relative; factors: of some inputs; loudest: largest sample
    of each output so far; amplified: what amplifiers make of samples (n, eras) in a run.
    """

    def __init__(
        self,
        plate: DeskPlate,
        *,
        rate: float,
        lost: Sequence[int] = (),
        late: Sequence[int] = (),
        reported: int = 0,
        on_outputs: Sequence[int] | None = None,
        on_inputs: Sequence[int] | None = None,
        gain: float = 1.0,
        drifts: Mapping[int, float] = MappingProxyType({}),
        factors: Mapping[int, float] = MappingProxyType({}),
        amplified: Callable[[FloatArray, int], FloatArray] = lambda played, run: played,
    ) -> None:
        self._plate, self.rate, self.name, self.gaps = plate, rate, "memory", reported
        self._lost, self._late, self._gain, self.runs = lost, late, gain, 0
        self._drifts, self._factors, self._amplified = drifts, factors, amplified
        self.loudest = np.zeros(1)
        self._on_outputs = range(plate.outputs) if on_outputs is None else on_outputs
        self._on_inputs = range(plate.inputs) if on_inputs is None else on_inputs

    def run(self, played: FloatArray) -> Float32Array:
        """Advance the plate by so many samples."""
        self.loudest = np.maximum(self.loudest, np.abs(played).max(axis=0))
        amplified = np.column_stack([self._amplified(played[:, :-1], self.runs), played[:, -1]])
        blocks = np.split(
            amplified[:, self._on_outputs], range(MEMORY_BLOCK, len(played), MEMORY_BLOCK)
        )
        heard = np.concatenate([self._plate.advance(block) for block in blocks])
        if self.runs in self._lost:
            middle = round(2 * self.rate)  # a block in the middle is missing, and nothing says so
            heard = np.concatenate([heard[:middle], heard[middle + 128 :], heard[-128:]])
        if self.runs in self._late:
            heard = np.concatenate([np.zeros((128, heard.shape[1])), heard[:-128]])
        self.runs += 1
        samples = np.arange(len(heard), dtype=float)
        for number, drift in self._drifts.items():
            column = heard[:, number - 1]
            heard[:, number - 1] = np.interp(samples * (1 + drift), samples, column)
        for number, factor in self._factors.items():
            heard[:, number - 1] *= factor
        return np.clip(self._gain * heard[:, self._on_inputs], -1, 1).astype(np.float32)

    def close(self) -> None:
        """Nothing is open."""


STEP = 1e-4
"""Time [s] between samples."""


@dataclass
class Outputs:
    """Terms that exciters are driven by: exciter, terms and since when [s], in order."""

    changes: list[tuple[int, Motion, float]] = field(default_factory=list)

    @classmethod
    @contextmanager
    def recorded(cls) -> Iterator["Outputs"]:
        """All that simulated plates are driven by."""
        found, obey = cls(), Plant.set_input

        def note(plant: Plant, era: int, motion: Motion, **given: Any) -> None:
            found.changes.append((era, tuple(motion), given.get("since", plant.time)))
            obey(plant, era, motion, **given)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Plant, "set_input", note)
            yield found

    def volts(self, exciters: int, *, after: float = 0.1) -> ComplexArray:
        """Voltages (n, exciters) as phasors, of which the imaginary part is played.

        From the first change to some time [s] after the last.
        """
        begin, end = self.changes[0][2], self.changes[-1][2] + after
        times = begin + STEP * np.arange(round((end - begin) / STEP))
        found: ComplexArray = np.zeros((len(times), exciters), dtype=complex)
        for number in range(exciters):
            own = [(since, motion) for era, motion, since in self.changes if era == number]
            for (since, motion), (until, _) in pairwise([*own, (end, ())]):
                first, last = np.searchsorted(times, [since, until])
                for term in motion:
                    each = times[first:last]
                    tau = each - term.start
                    wave = (term.c0 + term.c1 * tau) * np.exp(1j * term.omega * tau)
                    found[first:last, number] += np.where(
                        (each >= term.start) & (each < term.end), wave, 0
                    )
        return found


class Magnets:
    """Plate and magnets of a rig, from rest."""

    def __init__(self, rig: Rig) -> None:
        eras, places = rig.eras, footprints_of(rig.eras, rig.masses)
        reduced = reduce_plate(rig.plate, rig.mesh, places, frequency_max=rig.limits.frequency_max)
        shapes = reduced.at(places)
        M, C, K = modal_matrices(reduced, eras, loads=rig.masses, attachment_shapes=shapes)
        r, count, inverse = len(K), len(eras), np.linalg.inv(M)
        apart = np.hstack([shapes[:count], -np.eye(count)])
        A = np.block([[np.zeros((r, r)), np.eye(r)], [-inverse @ K, -inverse @ C]])
        B = np.vstack([np.zeros((r, count)), inverse @ apart.T])
        self._out = np.hstack([apart, np.zeros((count, r))])
        self._a, self._b, *_ = cont2discrete((A, B, self._out, np.zeros((count, count))), STEP)
        self._exciters = exciters_of(rig)
        parts = [era.in_time for era in eras]
        self._by_drive, self._by_rate = (
            np.array([getattr(each, key) for each in parts]) for key in ("by_drive", "by_rate")
        )

    def moved(self, volts: ComplexArray) -> ComplexArray:
        """Motion of each coil in its magnet (n, exciters) [m] by voltages, phasors as these.

        By Bl (u - L u' / R) / R. Their magnitude is what it is at the worst phase of all tones
        together.
        """
        forces = volts * self._by_drive + np.gradient(volts, STEP, axis=0) * self._by_rate
        state, found = np.zeros(len(self._a), dtype=complex), np.empty_like(forces)
        for number, force in enumerate(forces):
            found[number] = self._out @ state
            state = self._a @ state + self._b @ force
        return found

    def heat(self, volts: ComplexArray, moved: ComplexArray) -> FloatArray:
        """Power in each coil (n, exciters) [W], a mean over a cycle, back EMF included."""
        rates = np.gradient(moved, STEP, axis=0)
        found = []
        for number, one in enumerate(self._exciters):
            current = volts[:, number] - one.force_factor * rates[:, number]
            found.append(np.abs(current / one.loop_resistance) ** 2 * one.resistance / 2)
        return np.stack(found, axis=1)
