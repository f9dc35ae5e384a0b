"""The plate in time, from one change of the drive or of the contacts to the next.

The equations of motion and their exact solutions are the model's (`model.transients.time_response`,
which says what is not modelled); here is what a running plant adds: its clock, what the bases do
now, and the free vibration that every change leaves behind.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from model.arrays import FloatArray
from model.reduction.reduced_plate import ReducedPlate
from model.structure.actuator import Era
from model.structure.point_load import PointLoad
from model.transients.base_motion import Term
from model.transients.time_response import Answer
from sim.plant.contacts import BLOCK, Carried, ContactPlates

SAMPLE_RATE = 10_000.0
"""Of what is measured on it [Hz], unless somebody says: the peak of 500 Hz is seen to 1.3 %."""

_NEGLIGIBLE = 1e-60  # modal amplitude far below anything measurable, above slow subnormal numbers


class Plant:
    """A reduced plate on its ERAs, with what it carries, vibrating in time.

    time [s] starts at rest where it is told to. Raises InputError for ERAs that do not hold the
    plate (fewer than three, or all in one line).
    """

    def __init__(
        self,
        reduced: ReducedPlate,
        eras: Sequence[Era],
        *,
        loads: Sequence[PointLoad] = (),
        time: float = 0.0,
    ) -> None:
        self.time = time
        self._plates = ContactPlates(reduced, eras, loads)
        self._now: Carried = self._plates.carrying((), time=time)
        self._free = np.zeros(len(self._now.plate.decay), dtype=complex)
        self._answers: list[list[Answer]] = [[] for _ in eras]

    @property
    def reduced(self) -> ReducedPlate:
        """The plate in the coordinates that it vibrates in now; other contacts, other ones."""
        return self._now.reduced

    @property
    def contacts(self) -> tuple[PointLoad, ...]:
        """The fingers that load it now."""
        return self._now.contacts

    @property
    def state(self) -> tuple[FloatArray, FloatArray]:
        """Displacement and velocity (r,) each, now, in the coordinates of `reduced`."""
        x = (self._now.plate.free_state @ self._free).real
        for answer in self._active():
            x = x + answer.state(self.time)
        r = len(x) // 2
        return x[:r], x[r:]

    def set_input(self, era: int, terms: Sequence[Term]) -> None:
        """From now on the base of this ERA moves as these terms say; terms may start later."""
        # A term that goes on as it is leaves nothing behind: only the others are exchanged.
        known = {answer.term: answer for answer in self._answers[era]}
        wanted = _united([term for term in terms if term.end > self.time])
        new = self._now.plate.answers(era, [term for term in wanted if term not in known])
        gone = [answer for term, answer in known.items() if term not in wanted]
        self._answers[era] = [
            *(answer for term, answer in known.items() if term in wanted),
            *new,
        ]
        self._exchange(self._active_of(gone), self._active_of(new))

    def set_contacts(self, contacts: Sequence[PointLoad]) -> None:
        """From now on these fingers load the plate and no others, each from its rest plane.

        Displacement and velocity of the plate stay what they are at this moment, and with them its
        energy: what a finger's own spring and mass hold comes and goes with the finger.
        """
        if tuple(contacts) == self.contacts:
            return
        q, v = self.state
        before = self._now.reduced
        self._now = self._plates.carrying(contacts, time=self.time)
        if self._now.reduced is not before:
            carried = self._now.reduced.carried_over_from(before)
            q, v = carried @ q, carried @ v
        self._answers = [
            self._now.plate.answers(era, [answer.term for answer in answers])
            for era, answers in enumerate(self._answers)
        ]
        left = np.concatenate([q, v])
        for answer in self._active():
            left = left - answer.state(self.time)
        self._free = self._now.plate.to_free @ left

    def advance(
        self, to_time: float, *, sample_rate: float, shapes: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Let the plate vibrate until to_time [s]; times (n,) [s], accelerations (n, p) [m/s²].

        shapes (p, r): those of `reduced` at the points to measure at. Samples lie on the fixed grid
        k / sample_rate [Hz], those after the present time up to and including to_time.
        """
        first = np.floor(self.time * sample_rate) + 1
        last = np.floor(to_time * sample_rate)
        times = np.arange(first, last + 1) / sample_rate
        # Few points are sampled as they are, many by way of the coordinates.
        seen = shapes if len(shapes) < 2 * shapes.shape[1] else np.eye(shapes.shape[1])
        samples = np.empty((len(times), len(seen)))
        done = 0
        for boundary in self._boundaries(to_time):
            upto = int(np.searchsorted(times, boundary))
            self._sample(times[done:upto], samples[done:upto], sample_rate, seen)
            done = upto
            self._pass(boundary)
        self._sample(times[done:], samples[done:], sample_rate, seen)
        self._coast(to_time)
        return times, samples if seen is shapes else samples @ shapes.T

    def skip(self, to_time: float) -> None:
        """Let the plate vibrate until to_time [s] without looking at it."""
        if to_time <= self.time:
            return
        for boundary in self._boundaries(to_time):
            self._pass(boundary)
        self._coast(to_time)

    def _active(self) -> list[Answer]:
        return [answer for answers in self._answers for answer in self._active_of(answers)]

    def _active_of(self, answers: Sequence[Answer]) -> list[Answer]:
        return [answer for answer in answers if answer.term.start <= self.time < answer.term.end]

    def _boundaries(self, to_time: float) -> list[float]:
        moments = {
            moment
            for answers in self._answers
            for answer in answers
            for moment in (answer.term.start, answer.term.end)
        }
        return sorted(moment for moment in moments if self.time < moment <= to_time)

    def _exchange(self, before: Sequence[Answer], after: Sequence[Answer]) -> None:
        """Replace particular solutions, and keep displacement and velocity as they are."""
        if before or after:
            jump = np.zeros(self._now.plate.free_state.shape[0])
            for answer in before:
                jump += answer.state(self.time)
            for answer in after:
                jump -= answer.state(self.time)
            self._free = self._free + self._now.plate.to_free @ jump

    def _coast(self, to_time: float) -> None:
        self._free = self._free * np.exp(self._now.plate.decay * (to_time - self.time))
        self._free[np.abs(self._free) < _NEGLIGIBLE] = 0
        self.time = to_time

    def _pass(self, boundary: float) -> None:
        """Go to a moment at which terms start or end."""
        before = self._active()
        self._coast(boundary)
        after = self._active()
        self._exchange(
            [answer for answer in before if answer not in after],
            [answer for answer in after if answer not in before],
        )
        self._answers = [
            [answer for answer in answers if answer.term.end > boundary]
            for answers in self._answers
        ]

    def _sample(
        self, times: FloatArray, out: FloatArray, sample_rate: float, seen: FloatArray
    ) -> None:
        """Write what is seen of the accelerations at times on the grid, the drive being as now.

        seen: (q, r); out: (n, q).
        """
        if not len(times):
            return
        decay = self._now.plate.decay
        free = self._free * np.exp(decay * (times[0] - self.time))
        shown = ((seen @ self._now.plate.free_acceleration) * free).T
        table = self._now.exponentials(sample_rate)
        forced = _Forced(self._active(), seen)
        for start in range(0, len(times), BLOCK):
            block = times[start : start + BLOCK]
            into = out[start : start + BLOCK]
            if start:
                shown = shown * np.exp(decay * (BLOCK / sample_rate))[:, None]
            if shown.any():
                np.matmul(table[: len(block)], np.vstack([shown.real, shown.imag]), out=into)
            else:
                into[:] = 0
            forced.add(block, into)


def _united(terms: Sequence[Term]) -> list[Term]:
    """The same motion in terms that differ in when they hold, or in frequency."""
    united: dict[tuple[float, float, float], Term] = {}
    for term in terms:
        key = (term.start, term.end, term.omega)
        same = united.get(key)
        if same is not None:
            united[key] = replace(term, c0=same.c0 + term.c0, c1=same.c1 + term.c1)
        else:
            united[key] = term
    return list(united.values())


class _Forced:
    """What is seen of the accelerations that the bases' terms force, (q, r) telling what is."""

    def __init__(self, active: Sequence[Answer], seen: FloatArray) -> None:
        self._starts = np.array([answer.term.start for answer in active])
        self._omegas = np.array([answer.term.omega for answer in active])
        r = seen.shape[1]
        b0 = np.array([answer.b0 for answer in active]).reshape(-1, r)
        b1 = np.array([answer.b1 for answer in active]).reshape(-1, r)
        s = 1j * self._omegas[:, None]
        constant = (s**2 * b0 + 2 * s * b1) @ seen.T
        self._constant = np.vstack([constant.imag, constant.real])
        growth = (s**2 * b1) @ seen.T
        self._growth = np.vstack([growth.imag, growth.real]) if b1.any() else None

    def add(self, times: FloatArray, out: FloatArray) -> None:
        """Add it at times (n,) [s] to out (n, q)."""
        if not len(self._omegas):
            return
        tau = times[:, None] - self._starts
        angle = self._omegas * tau
        turn = np.hstack([np.cos(angle), np.sin(angle)])
        out += turn @ self._constant
        if self._growth is not None:
            out += (turn * np.hstack([tau, tau])) @ self._growth
