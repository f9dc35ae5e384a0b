"""Rules for the set that an amplifier reports to play."""

import math

from sim.witness.decoded import Reply, Request
from sim.witness.quantities import LEVEL
from sim.witness.violation import ReportViolation

_FINE = 0.011  # Hz and degrees; one step of the wire


def check_achieved(
    name: str,
    request: Request,
    reply: Reply,
    time: float,
    *,
    is_warm: bool,
    report: ReportViolation,
) -> None:
    """The reported set must be the commanded one: complete, all channels at the same share."""
    if reply.token != request.token and reply.token:
        what = f"{name}: reply to set {request.token} reports set {reply.token}"
        report("credit", time, what)
    if reply.achieved is None:
        return
    if reply.achieved.keys() != request.commands.keys():
        report(
            "commit",
            time,
            f"{name} plays channels {sorted(reply.achieved)} of a set for "
            f"{sorted(request.commands)}",
        )
        return
    shares = []
    for channel, command in request.commands.items():
        played = reply.achieved[channel]
        phase_error = math.remainder(played.phase - command.phase, 360.0)
        if command.level > 0:
            shares.append(played.level / command.level)
        is_other = (command.level == 0) != (played.level == 0)
        if command.level > 0 and (
            abs(played.frequency - command.frequency) > _FINE or abs(phase_error) > _FINE
        ):
            is_other = True
        if is_other:
            report(
                "plays",
                time,
                f"{name} plays {played.frequency:g} Hz, level {played.level:g}, "
                f"{played.phase:g} degrees instead of {command.frequency:g} Hz, {command.level:g}, "
                f"{command.phase:g} on channel {channel}",
            )
    rounded = 0.0
    if shares and min(shares) < 0.99:  # derated levels are rounded again
        rounded = LEVEL.step / min(
            command.level for command in request.commands.values() if command.level
        )
    if shares and max(shares) - min(shares) > 0.01 + rounded:
        what = f"{name} scales the channels of a set differently"
        report("commit", time, what)
    elif shares and not is_warm and abs(shares[0] - 1) > 0.01:
        report("plays", time, f"{name} plays {shares[0]:.3g} of the commanded levels")
