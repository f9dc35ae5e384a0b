"""Whether what an amplifier says that a set plays is the set."""

import math

from sim.witness.decoded import Reply, ReportViolation, Request
from sim.witness.quantities import LEVEL

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
    """What it says that a set plays is the set: whole, and no channel more than another."""
    if reply.token != request.token and reply.token:
        what = f"{name} answered set {request.token} with set {reply.token}"
        report("credit", time, what)
    if reply.achieved is None:
        return
    if reply.achieved.keys() != request.commands.keys():
        report(
            "commit",
            time,
            f"{name} plays channels {sorted(reply.achieved)} of a set that names "
            f"{sorted(request.commands)}",
        )
        return
    shares = []
    for channel, command in request.commands.items():
        played = reply.achieved[channel]
        turn = math.remainder(played.phase - command.phase, 360.0)
        if command.level > 0:
            shares.append(played.level / command.level)
        is_other = (command.level == 0) != (played.level == 0)
        if command.level > 0 and (
            abs(played.frequency - command.frequency) > _FINE or abs(turn) > _FINE
        ):
            is_other = True
        if is_other:
            report(
                "plays",
                time,
                f"{name} makes {played.frequency:g} Hz, level {played.level:g}, "
                f"{played.phase:g} degrees of {command.frequency:g} Hz, {command.level:g}, "
                f"{command.phase:g} on channel {channel}",
            )
    rounded = 0.0
    if shares and min(shares) < 0.99:  # what is derated is rounded to the wire's steps again
        rounded = LEVEL.step / min(
            command.level for command in request.commands.values() if command.level
        )
    if shares and max(shares) - min(shares) > 0.01 + rounded:
        what = f"{name} plays the channels of a set at different shares of their levels"
        report("commit", time, what)
    elif shares and not is_warm and abs(shares[0] - 1) > 0.01:
        report("plays", time, f"{name} plays {shares[0]:.3g} of the levels it was told")
