"""A plate that stays known while it plays: every settled pattern updates it.

The parameters of an identification drift; an update moves them together with the fingers of its
pattern, which are dropped afterwards. Where innovations are unlikely the state goes back to where
they began, since an update smears a jump over all parameters, and is held until the patterns since
then are explained together by one change (`model.identification.changes`). Such a change is
followed; after one that nothing explains, as by a crack or a hand that rests on it, the plate
counts as changed, until patterns are those of the plate as it was.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Self

import numpy as np

from model.arrays import FloatArray
from model.identification.changes import PLACES, Alarm, Observation, PlateChange, explain
from model.identification.forward import ForwardModel, Sensor
from model.identification.identify import solved_for
from model.identification.parameters import KINDS, MODE_SHIFTS, space_of
from model.identification.settled import NoiseLevel, PatternModel, SettledPattern, State, update
from model.identification.values import Values, rig_with
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
class PatternReport:
    """What one pattern has shown.

    nis: squared innovation in its covariance, of `count` numbers; alarm: whether it began one, none
    while the plate counts as changed; is_held: whether the state waits for an explanation;
    explanation: where one was found now.
    """

    nis: float
    count: int
    alarm: bool
    is_held: bool
    explanation: PlateChange | None


@dataclass(frozen=True, eq=False)
class PlateEstimate:
    """What is known of a plate in service.

    before: the rig that parameters count from; uncertainty: of the rig as known; model: with a
    spare mass; is_explained: whether an identification explains it, so that it may be updated, or
    there are only alarms; time [s]: of the state, from which it has drifted since, None before the
    first pattern; change: how it has changed in a way that its parameters do not follow, "" where
    it has not.
    """

    before: Rig
    uncertainty: Uncertainty
    model: ForwardModel
    state: State
    is_explained: bool = True
    time: float | None = None
    change: str = ""

    @property
    def rig(self) -> Rig:
        """The rig as it is known now."""
        values = Values.of(self.before, self.model.space, self.state.x)
        return rig_with(self.before, values, self.uncertainty)

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
    """An identified plate in service; known: what is known of it now."""

    def __init__(self, known: PlateEstimate) -> None:
        self.known = known
        self._alarm = Alarm()
        self._places = PLACES.centres(known.before.plate)
        self._noise = NoiseLevel()
        self._held: list[PatternModel] = []
        self._suspects = 0

    def take(self, pattern: SettledPattern) -> PatternReport:
        """Take a settled pattern: update the state, or hold it and explain what happened."""
        model = PatternModel.of(self.known.model, pattern, _FINGER, noise=self._noise.relative)
        if self.known.time is None:
            self.known = replace(self.known, time=pattern.time)
        known, drifted = self.known, self._drifted(pattern.time)
        if self._held:
            self._held.append(model)
            return self._explained(pattern.time)
        after = update(drifted, [model], evaluations=_EVALUATIONS, theory=self._theory)
        observation = Observation.of(model, known.state, known.time, after, self._places)
        suspect = self._alarm.take(observation)
        if suspect is not None:
            explanation, is_new = None, not self.known.change
            if known.is_explained and is_new:
                self._go_back(suspect)
                explanation = self._explained(pattern.time).explanation
            self._alarm.clear()
            return PatternReport(after.nis, after.count, is_new, bool(self._held), explanation)
        if self.known.change and self._alarm.is_full:
            self.known = replace(self.known, change="")
        if known.is_explained and not self.known.change and not self._alarm.is_odd:
            self.known = replace(self.known, state=after.state, time=pattern.time)
            self._noise.take(after)
        return PatternReport(after.nis, after.count, False, False, None)

    def _go_back(self, suspect: list[Observation]) -> None:
        """Return to the state before the first suspect pattern, and hold them."""
        self.known = replace(self.known, state=suspect[0].before, time=suspect[0].time)
        self._held, self._suspects = [each.model for each in suspect], len(suspect)

    def _explained(self, time: float) -> PatternReport:
        """Explain what was held, early if it is certain."""
        count, drifted = len(self._held), self._drifted(time)
        is_full = count >= max(_HELD, self._suspects + _AFTER_ALARM)
        found = explain(drifted, self._held) if count >= _EARLY else None
        if is_full and found and not found.name:
            # The first of them may be from before the change.
            later = explain(drifted, self._held[-_EARLY:])
            found = later if later.name else found
        if found is None or not (is_full or (found.name and found.lead > _CERTAIN)):
            return PatternReport(np.nan, 0, False, True, None)
        self._held = []
        if found.name:
            self.known = replace(self.known, state=found.state, time=time)
        else:
            self.known = replace(self.known, change=str(found))
        return PatternReport(np.nan, 0, False, False, found)

    @cached_property
    def _theory(self) -> FloatArray:
        """Variances (p,) of what the theory gets wrong, which patterns at other tones show anew."""
        space = self.known.model.space
        return (space.of_kinds(lambda kind: kind.theory) / space.scale) ** 2

    def _drifted(self, time: float) -> State:
        """The state at a time [s], less certain by what drifted since it was updated."""
        state, since, space = self.known.state, self.known.time, self.known.model.space
        hours = 0.0 if since is None else max(time - since, 0.0) / 3600
        drift, widest = (
            (space.of_kinds(of) / space.scale) ** 2
            for of in (lambda kind: kind.drift, lambda kind: kind.widest)
        )
        room = np.maximum(widest - np.diag(state.covariance), 0.0)
        return State(state.x, state.covariance + np.diag(np.minimum(drift * hours, room)))


def widest(uncertainty: Uncertainty) -> Uncertainty:
    """Of each standard deviation the larger one of these and a plate's that was not measured."""
    built = Uncertainty()
    return Uncertainty(
        **{
            each.name: max(getattr(uncertainty, each.name), getattr(built, each.name))
            for each in fields(Uncertainty)
        }
    )
