"""Expected reply to GetAchieved: token, values, flags and duration of a layer."""

from drivers.protocol.achieved import FLAGS, AchievedProblem, achieved_problem
from drivers.protocol.records import Values
from era_haptics.lab.expectations.expected_outputs import ExpectedOutputs
from era_haptics.lab.expectations.mismatches import ReportMismatch, alternatives
from era_haptics.lab.expectations.tolerances import Interval


def check_achieved(
    layer: int,
    reply: Values,
    when: Interval,
    *,
    outputs: ExpectedOutputs,
    capabilities: Values,
    report: ReportMismatch,
) -> None:
    """Compare the achieved values of a layer with its commands, if its output is known."""
    known_layers = outputs.sure(when)
    if not known_layers:
        return
    problem = _token_problem(layer, reply, outputs, known_layers)
    if problem is None and layer in known_layers:
        problem = _values_problem(layer, reply, outputs, capabilities)
    if problem is not None:
        report(
            problem.rule,
            when.latest,
            f"{problem.quantity} of achieved layer {layer}",
            expected=problem.required,
            actual=problem.received,
        )


def _token_problem(
    layer: int, reply: Values, outputs: ExpectedOutputs, known_layers: set[int]
) -> AchievedProblem | None:
    """Return the problem of a reply's token, if any."""
    tokens = outputs.tokens_of(layer, known_layers)
    if reply["token"] in tokens:
        return None
    return AchievedProblem("token", "token", alternatives(tokens), reply["token"])


def _values_problem(
    layer: int, reply: Values, outputs: ExpectedOutputs, capabilities: Values
) -> AchievedProblem | None:
    """Return the first difference between a reply and the commands of a layer, if any."""
    commands = reply["commands"]
    problem = achieved_problem(
        outputs.playback.playing(layer),
        reply,
        capabilities,
        is_exact=outputs.is_exact,
        can_scale=outputs.may_derate or not outputs.is_exact,
    )
    if problem is not None:
        return problem
    flags = [name for row in (reply, *commands) for name in FLAGS if row.get(name)]
    if flags:
        return AchievedProblem("plays", "flags", [], flags)
    durations = outputs.lasting.get(layer, {0}) if commands else {0}
    if reply["valid_for"] not in durations:
        return AchievedProblem("plays", "valid_for", sorted(durations), reply["valid_for"])
    if reply["ramp"] and not commands:
        return AchievedProblem("plays", "ramp of a silent layer", 0, reply["ramp"])
    return None
