"""What requests of an amplifier fail with, in words: the cause, and what to do."""

from drivers.errors import CommandRefused, WrongAmplifier
from drivers.protocol.definition import FAULTS, STATES, name_of
from drivers.protocol.records import Values
from drivers.wires.wire import Nak

_NOT_ARMED = ("WRONG_STATE", "WRONG_SESSION")
_REMEDIES = {
    "WRONG_SESSION": "; another host has armed it, or did last: disarm, then arm anew",
    "WRONG_STATE": "; see what ails it by `era amp status`, then clear and arm again",
}


def refused_by_amplifier(where: str, refusal: Nak, *, may_play: bool) -> CommandRefused:
    """Return the error of a request that was refused on a line; may_play: see `CommandRefused`."""
    channel = "" if refusal.channel is None else f", channel {refusal.channel}"
    return CommandRefused(
        f"{where}: the amplifier refused the request: {refusal.code}{channel}"
        + _REMEDIES.get(refusal.code, ""),
        channel=refusal.channel,
        may_play=may_play,
        is_disarmed=refusal.code in _NOT_ARMED,
    )


def no_reply(
    where: str, name: str, timeout: float, remark: str, *, before: float, boot_time: float
) -> str:
    """Return why a request of a name on a line had no reply within a time [s].

    remark: what came instead; before [s]: for how long the reply before was awaited; boot_time [s]:
    of a board behind a port that was opened just now, else 0.
    """
    if not remark and before > timeout:
        remark = f"the reply before took {1e3 * before:.0f} ms: check what delays frames on the way"
    hint = "check that the amplifier is switched on"
    if name == "GetCaps":  # which comes behind an answered Hello
        hint = "it answered Hello, but not GetCaps"
    came = f", but {remark}" if remark else f"; {hint}"
    cause = f"{where}: no reply within {1e3 * timeout:g} ms{came}"
    if boot_time:
        cause += (
            f". A board that restarts when its port is opened must reply within {boot_time:g} s; "
            "set one that takes longer not to restart"
        )
    return cause


def contradicted(name: str, problem: str) -> CommandRefused:
    """Return the error of an amplifier that contradicts its requests again and again."""
    return CommandRefused(
        f"amplifier {name} contradicts its requests: {problem}; look for a derated or broken "
        "channel, an exchanged cable or firmware, then clear and arm again"
    )


def disarmed(name: str, status: Values) -> CommandRefused:
    """Return the error of what plays or feeds, once a status shows that it is not armed."""
    return CommandRefused(
        f"amplifier {name} is not armed but in {name_of(STATES, status['state'])}, fault "
        f"{name_of(FAULTS, status['fault'])}; once the cause is gone, clear and arm again",
        is_disarmed=True,
    )


def driven_by_another(name: str) -> WrongAmplifier:
    """Return the error of an amplifier that another host drives."""
    return WrongAmplifier(f"amplifier {name} is driven by another host; end that one first")
