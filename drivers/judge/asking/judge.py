"""The judge of an amplifier under conformance: what it finds ends a check."""

from dataclasses import replace
from functools import partial

from drivers.judge.asking.client import Violation, require_in_time
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, achieved_layer, achieved_problem
from era_haptics.lab.expected_amplifier import ExpectedAmplifier
from era_haptics.lab.expected_output import Interval


class Judge(ExpectedAmplifier):
    """An amplifier with these capabilities since a status at rest. Raises Violation and Late."""

    def __init__(self, can: Values, rest: Values, when: Interval) -> None:
        unclear = partial(require_in_time, False)
        super().__init__(self._wrong, self._wrong, unclear=unclear, may_fail=False)
        self.identified(can)
        self.check(rest, when)

    def _wrong(self, rule: str, time: float, what: str, *, must: object, seen: object) -> None:
        raise Violation(what, expected=must, seen=seen)

    def achieved(self, one: LayerSet, shown: Values) -> LayerSet:
        """Return a layer as it plays by a GetAchieved; raises Violation beyond half a step."""
        driven = tuple(tone for tone in one.commands if tone.is_driven)
        one = replace(one, commands=driven)
        if problem := achieved_problem(one, shown, self.can, is_exact=False):
            rule, what, must, seen = problem
            self.report(rule, 0.0, f"{what} in layer {one.layer}", must=must, seen=seen)
        return achieved_layer(one, shown, self.can)
