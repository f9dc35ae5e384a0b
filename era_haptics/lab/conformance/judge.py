"""Expected state of the amplifier under test, whose differences are violations of the contract."""

from dataclasses import replace
from functools import partial

from drivers.protocol.achieved import achieved_layer, achieved_problem
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet
from era_haptics.lab.conformance.outcomes import ContractViolation, require_in_time
from era_haptics.lab.expectations.expected_amplifier import ExpectedAmplifier
from era_haptics.lab.expectations.tolerances import Interval


class Judge(ExpectedAmplifier):
    """Expected state of an amplifier with these capabilities, starting from a status at rest.

    Raises ContractViolation and TooLate.
    """

    def __init__(self, capabilities: Values, rest: Values, when: Interval) -> None:
        unclear = partial(require_in_time, False)
        super().__init__(self._violated, unclear=unclear, may_fail=False)
        self.identified(capabilities)
        self.check(rest, when)

    def _violated(
        self, rule: str, time: float, quantity: str, *, expected: object, actual: object
    ) -> None:
        raise ContractViolation(quantity, expected=expected, actual=actual)

    def achieved(self, layer_set: LayerSet, reply: Values) -> LayerSet:
        """Return a layer as achieved according to the reply to GetAchieved.

        Raises ContractViolation if a value differs by more than half a step.
        """
        driven = tuple(tone for tone in layer_set.commands if tone.is_driven)
        layer_set = replace(layer_set, commands=driven)
        problem = achieved_problem(layer_set, reply, self.capabilities, is_exact=False)
        if problem:
            rule, quantity, expected, actual = problem
            quantity = f"{quantity} in layer {layer_set.layer}"
            self.report(rule, 0.0, quantity, expected=expected, actual=actual)
        return achieved_layer(layer_set, reply, self.capabilities)
