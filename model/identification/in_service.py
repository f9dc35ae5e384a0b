"""A plate that stays known while it plays: every settled pattern updates it.

The parameters of an identification drift; an update moves them together with the fingers of its
pattern, which are dropped afterwards. Where innovations are unlikely (`model.identification.alarm`)
the state goes back to where they began, since an update smears a jump over all parameters, and is
held until the patterns since then are explained together by one change
(`model.identification.hypotheses`). A change of its parameters is followed; with a hand on it, a
crack or a change that nothing explains the plate counts as changed, until patterns are those of the
plate as it was.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Self

import numpy as np

from model.arrays import FloatArray
from model.identification.alarm import Alarm, Taken, places_on
from model.identification.forward import ForwardModel, Sensor
from model.identification.hypotheses import Explanation, explain
from model.identification.identified_rig import rig_with
from model.identification.identify import Identification, solved_for
from model.identification.noise import NoiseLevel
from model.identification.parameters import FINGER_PARTS, KINDS, MODE_SHIFTS, Space, space_of
from model.identification.posterior import THEORY
from model.identification.settled import SettledPattern, Touched
from model.identification.settled_update import State, update
from model.identification.stages import Setting
from model.identification.values import Values
from model.rig.rig import Rig
from model.rig.uncertainty import Uncertainty
from model.structure.modal_elasticity import lowest_elastic

_EARLY, _HELD = 4, 6  # patterns that are explained together, at first and at last
_AFTER_ALARM = 2  # patterns before a change counts as unexplained
_CERTAIN = 12.0  # of the cost: by how much an early explanation is better than any other
_EVALUATIONS = 20
_FINGER = KINDS["fingers"].std

_NOT_STATED = (
    *("modulus", "damping_each", "loss_exponent", "bolt_mass"),
    *("place", "mode_shifts", "mode_losses"),
)


@dataclass(frozen=True, eq=False)
class Report:
    """What one pattern has shown.

    nis: squared innovation in its covariance, of `count` numbers; alarm: whether it began one, none
    while the plate counts as changed; is_held: whether the state waits for an explanation;
    explanation: where one was found now; fingers (k, 4): factors of FINGER_PARTS of each finger of
    the pattern, none while held.
    """

    nis: float
    count: int
    alarm: bool
    is_held: bool
    explanation: Explanation | None
    fingers: FloatArray


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of a plate when its service begins.

    before: the rig that parameters count from; uncertainty: of the rig as known; model: with a
    spare mass; is_explained: whether it may be updated.
    """

    before: Rig
    uncertainty: Uncertainty
    model: ForwardModel
    state: State
    is_explained: bool = True

    @classmethod
    def of(cls, found: Identification) -> Self:
        """What an identification has shown."""
        problem = found.fitted.problem
        setting = Setting(found.before, problem.model.free, problem.measurement)
        # A spare mass weighs nothing so far.
        model = setting.model(problem.model.mass_count + 1)
        known = found.posterior.within(model.space)
        state = State(known.x, known.covariance)
        return cls(found.before, found.rig.uncertainty, model, state, found.is_explained)

    @classmethod
    def of_rig(cls, rig: Rig, sensors: Sequence[Sensor]) -> Self:
        """What a rig says of itself by its `uncertainty`; gains of the sensors are not known.

        What it does not state is known the better, the better its thickness is: by identification.
        """
        free = solved_for(rig, rig.limits.frequency_max)
        # Counted in the deviations of a plate that was not measured, which steps are limited by.
        count = len(lowest_elastic(free.modes.eigenvalues, MODE_SHIFTS))
        space, stated = (
            space_of(rig, [each.name for each in sensors], known, masses=1, mode_count=count)
            for known in (widest(rig.uncertainty), rig.uncertainty)
        )
        model = ForwardModel(rig, sensors, np.array([rig.limits.frequency_max]), space, free)
        std = np.divide(stated.std, space.std, out=np.zeros(space.size), where=space.uncertain)
        std[space.of(*_NOT_STATED)] = std[space.index("thickness")]
        std[space.groups["masses"]] = 0.0
        state = State(np.zeros(space.size), np.diag(std**2))
        return cls(rig, rig.uncertainty, model, state)


class LivePlate:
    """The state of an identified plate in service."""

    def __init__(self, known: Known | Identification) -> None:
        if isinstance(known, Identification):
            known = Known.of(known)
        self._before, self._uncertainty = known.before, known.uncertainty
        self.can_update = known.is_explained
        """Whether its identification explains the plate; otherwise there are only alarms."""
        self._model = known.model
        self._state = known.state
        self._time: float | None = None
        self._alarm = Alarm()
        self._places = places_on(known.before.plate.length, known.before.plate.width)
        self._noise = NoiseLevel()
        self._held: list[Touched] = []
        self._since_alarm = 0
        self.has_changed = False
        """Whether the plate has changed in a way that its parameters do not follow."""

    @property
    def state(self) -> State:
        """Parameters and covariance now."""
        return self._state

    @property
    def space(self) -> Space:
        """The parameters, a spare mass among them."""
        return self._model.space

    @property
    def rig(self) -> Rig:
        """The rig as it is known now."""
        values = Values.of(self._before, self.space, self._state.x)
        return rig_with(self._before, values, self._uncertainty)

    @property
    def before(self) -> Rig:
        """The rig that parameters count from."""
        return self._before

    @property
    def known_at(self) -> float | None:
        """Time [s] of the state; None before the first pattern."""
        return self._time

    def known_since(self, time: float | None) -> None:
        """Note that the state is that of a time [s], from which it has drifted since."""
        self._time = time

    def take(self, pattern: SettledPattern) -> Report:
        """Take a settled pattern: update the state, or hold it and explain what happened."""
        touched = Touched.of(self._model, pattern, _FINGER, noise=self._noise.relative)
        drifted = self._drifted(pattern.time)
        if self._held:
            self._held.append(touched)
            self._since_alarm += 1
            return self._explained(pattern.time)
        after = update(drifted, [touched], evaluations=_EVALUATIONS, theory=self._theory)
        taken = Taken.of(touched, self._state, self._time, after, self._places)
        suspect = self._alarm.take(taken)
        if suspect is not None:
            explanation, is_new = None, not self.has_changed
            if self.can_update and is_new:
                self._go_back(suspect)
                explanation = self._explained(pattern.time).explanation
            self._alarm.clear()
            return Report(
                after.nis, after.count, is_new, bool(self._held), explanation, np.zeros((0, 4))
            )
        if self.has_changed and self._alarm.is_full:
            self.has_changed = False
        if self.can_update and not self.has_changed and not self._alarm.is_odd:
            self._state, self._time = after.state, pattern.time
            self._noise.take(after)
        fingers = np.exp(_FINGER * after.fingers.reshape(-1, len(FINGER_PARTS)))
        return Report(after.nis, after.count, False, False, None, fingers)

    def _go_back(self, suspect: list[Taken]) -> None:
        """Return to the state before the first suspect pattern, and hold them."""
        self._state, self._time = suspect[0].before, suspect[0].time
        self._held, self._since_alarm = [each.touched for each in suspect], 0

    def _explained(self, time: float) -> Report:
        """Explain what was held, early if it is certain."""
        count, drifted = len(self._held), self._drifted(time)
        is_full = count >= _HELD and self._since_alarm >= _AFTER_ALARM
        found = explain(drifted, self._held) if count >= _EARLY else None
        if is_full and found and not found.name:
            # The first of them may be from before the change.
            later = explain(drifted, self._held[-_EARLY:])
            found = later if later.name else found
        if found is None or not (is_full or (found.name and found.lead > _CERTAIN)):
            return Report(np.nan, 0, False, True, None, np.zeros((0, 4)))
        self._held = []
        if found.can_be_followed:
            self._state, self._time = found.state, time
        else:
            self.has_changed = True
        return Report(np.nan, 0, False, False, found, np.zeros((0, 4)))

    @cached_property
    def _theory(self) -> FloatArray:
        """Variances (p,) of what the theory gets wrong, which patterns at other tones show anew."""
        space, variance = self.space, np.zeros(self.space.size)
        for kind, std in (
            ("stiffness", THEORY["stiffness"]),
            ("damping_each", THEORY["damping"]),
            ("mode_shifts", 2 * THEORY["frequency"]),
            ("place", THEORY["place"]),
        ):
            known = space.std[space.groups[kind]]
            variance[space.groups[kind]] = (
                np.divide(std, known, out=np.zeros_like(known), where=known > 0) ** 2
            )
        return variance

    def _drifted(self, time: float) -> State:
        """The state at a time [s], less certain by what drifted since it was updated."""
        hours = 0.0 if self._time is None else max(time - self._time, 0.0) / 3600
        if self._time is None:
            self._time = time
        space, variance = self.space, np.zeros(self.space.size)
        before = np.diag(self._state.covariance)
        for name, kind in KINDS.items():
            group = space.groups[name]
            known = space.std[group]
            scale = np.divide(1.0, known, out=np.zeros_like(known), where=known > 0)
            room = np.maximum((kind.widest * scale) ** 2 - before[group], 0.0)
            variance[group] = np.minimum((kind.drift * scale) ** 2 * hours, room)
        return State(self._state.x, self._state.covariance + np.diag(variance))


def widest(uncertainty: Uncertainty) -> Uncertainty:
    """Of each standard deviation the larger one of these and a plate's that was not measured."""
    built = Uncertainty()
    return Uncertainty(
        **{
            each.name: max(getattr(uncertainty, each.name), getattr(built, each.name))
            for each in fields(Uncertainty)
        }
    )
