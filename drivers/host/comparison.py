"""Whether an amplifier is the expected one, and whether its replies agree with what it was sent.

Levels of voices that change are bounded from above alone: their commit is known as an interval.
"""

from collections.abc import Mapping

from drivers.errors import LinkError
from drivers.host.feeding import Feeding
from drivers.host.ledger import Ledger
from drivers.protocol.records import Values, bits_of
from drivers.protocol.sets import LayerSet, is_newer_token
from drivers.protocol.table import LATCHED, QUANTITIES, STATUS_FLAGS, VERSION, has_feature

_POSITIVE = ("frequency_step", "level_step", "phase_step")
_FULL_LEVEL = ("motion of a stiff source", "output of a linear amplifier")


def check_identity(identity: Values, name: str, serial_number: str | None) -> None:
    """Raise LinkError unless an amplifier of a name speaks this version and is the expected one.

    serial_number: the expected one, None for any.
    """
    if not identity["versions"] >> VERSION & 1:  # bit n: version n
        spoken = map(str, bits_of(identity["versions"]))
        raise LinkError(
            f"amplifier {name} speaks protocol {', '.join(spoken) or 'none'}, needs {VERSION}; "
            "update it"
        )
    serial = identity["serial_number"]
    if serial_number not in (None, serial):
        raise LinkError(
            f"amplifier {name}: serial number must be {serial_number}, got {serial}; connect the "
            "expected amplifier, or restart with this one"
        )


def check_capabilities(can: Values, name: str, *, is_output: bool | None) -> None:
    """Raise LinkError for capabilities that no amplifier can have, or other than the rig's.

    is_output: what the rig says of full level: the output of a linear amplifier, else a motion;
    None where there is no rig.
    """
    for each in _POSITIVE:
        if not can[each] > 0:
            raise LinkError(f"amplifier {name}: {each} must be above 0, got {can[each]}")
    for each in ("watchdog", "envelope_step", "frequency"):
        low, high = can[f"{each}_min"], can[f"{each}_max"]
        if low > high:
            raise LinkError(
                f"amplifier {name}: {each}_min must be at most {each}_max, got {low} and {high}"
            )
    has_output = has_feature(can, "output")
    if is_output is not None and has_output is not is_output:
        raise LinkError(
            f"amplifier {name}: full level must be {_FULL_LEVEL[is_output]} as in the rig file, "
            f"got {_FULL_LEVEL[has_output]}; correct the rig file, or connect another amplifier"
        )


MAX_CONTRADICTIONS = 2
"""Contradictions in a row that are a fault; a single one may be a moment between two sets."""

_LEVEL, _LEFT = QUANTITIES["level"], QUANTITIES["watchdog_left"]
_STEPS = 2
_HALF_TURN = 180 * QUANTITIES["phase"].per_unit
_MEASURING_ERROR = 0.002  # of full level, where an amplifier measures its levels
_WEAK = 0.25  # largest measuring error, relative to a weak level


def problem_of(
    status: Values, ledger: Ledger, feeding: Feeding, *, sent_at: float, now: float, fed: bool
) -> str | None:
    """Describe what the status of an armed one contradicts; None if it agrees.

    sent_at, now [s]: of the request and its reply; fed: whether the request feeds the watchdog.
    """
    if not status["flags"] >> STATUS_FLAGS["high_voltage"] & 1:
        return "high voltage must be on, got off"
    if not fed:
        left = feeding.problem(_LEFT.from_wire(status["watchdog_left"]), sent_at, now)
        if left is not None:
            return left
    playback = ledger.playback
    playback.advance(now - ledger.lag)
    if len(status["levels"]) != playback.channels:
        return f"levels must be {playback.channels}, got {len(status['levels'])}"
    if len(status["tokens"]) != ledger.capabilities["layers"]:
        return f"layers must be {ledger.capabilities['layers']}, got {len(status['tokens'])}"
    is_steady = playback.next_due - 2 * ledger.lag > now
    if is_steady:  # else a layer may have ended, or not yet
        expected = playback.tokens
        for layer, token in enumerate(status["tokens"]):
            if token != expected.get(layer, 0):
                return f"token of layer {layer} must be {expected.get(layer, 0)}, got {token}"
    can, late = ledger.capabilities, sent_at - ledger.lag
    tolerance = _STEPS * max(can["level_step"], 1)
    is_measured = has_feature(can, "levels_measured")
    for channel, level in enumerate(status["levels"]):
        highest, is_settled = 0.0, is_steady
        for voice in playback.all_voices[channel]:
            transition = voice.transition
            if transition.end <= late:
                highest += abs(transition.last)
                continue
            is_settled = False
            if transition.knots:
                highest += transition.peak(late)
            else:
                highest += max(abs(transition.first), abs(transition.last))
        high = round(min(highest, 1.0) * _LEVEL.per_unit)
        low = round(min(playback.level(channel, now), 1.0) * _LEVEL.per_unit) if is_settled else 0
        if is_measured:
            error = round(_MEASURING_ERROR * _LEVEL.per_unit)
            low, high = low - min(error, round(_WEAK * low)), high + min(error, round(_WEAK * high))
        if not low - tolerance <= level <= high + tolerance:
            return f"level of channel {channel} must be {low} to {high} (1e-4), got {level}"
    return None


def achieved_problem(sent: LayerSet, achieved: LayerSet, can: Values) -> str | None:
    """Describe what a layer that plays contradicts; None if it is what was sent, to the steps.

    can: values of the capabilities. Envelopes are not compared: an amplifier does not report them.
    """
    commands = {command.channel: command for command in sent.commands if command.level}
    played = {command.channel: command for command in achieved.commands if command.level}
    if commands.keys() != played.keys():
        return f"channels of layer {sent.layer} must be {[*commands]}, got {[*played]}"
    for channel, command in commands.items():
        got = played[channel]
        phase = (got.phase - command.phase + _HALF_TURN) % (2 * _HALF_TURN) - _HALF_TURN
        for name, difference in (
            ("frequency", got.frequency - command.frequency),
            ("level", got.level - command.level),
            ("phase", phase),
        ):
            if abs(difference) > (can[f"{name}_step"] + 1) / 2:
                return (
                    f"{name} achieved on channel {channel} in layer {sent.layer} must be "
                    f"{getattr(command, name)}, got {getattr(got, name)} (steps of the wire)"
                )
    return None


def name_of(names: Mapping[str, int], number: int) -> str:
    """Return the name of a number of the table, or the number."""
    return next((name for name, each in names.items() if each == number), str(number))


def is_stopping(status: Values, before: int | None) -> bool:
    """Whether a status shows that a stop was carried out since a latch was the newest."""
    if before is None or status["state"] not in LATCHED:
        return False
    return status["latch"] > 0 and is_newer_token(status["latch"], before)
