"""Checks of states: arming, sessions, Stop, Disarm, Silence and Clear."""

from functools import partial

from drivers.protocol.definition import QUANTITIES
from drivers.protocol.sets import token_after
from era_haptics.lab.conformance.check import driving
from era_haptics.lab.conformance.request_rows import (
    DISARM_NOW,
    SILENCE_NOW,
    STOP_NOW,
    RequestRows,
    Row,
    Wait,
    commit,
    layer,
    play_now,
    send,
    stage,
)
from era_haptics.lab.conformance.subject import Subject

_WATCHDOG, _MAX_RAMP = QUANTITIES["watchdog"], QUANTITIES["ramp"].maximum
_SESSION = 0x1234  # held while requests with other sessions are sent
_NEXT_SESSION = 0x1235
_OTHER_SESSIONS = (
    _NEXT_SESSION,
    0x5634,  # another high byte
    0x1256,  # another low byte
    0xEDCB,  # all bits inverted
    1,
)
_NEW_SESSION = _SESSION ^ 0x100  # another high byte
_OLDER_SESSION = _SESSION - 7


@driving("protocol.md#states")
def plays_nothing_disarmed(subject: Subject) -> RequestRows:
    """Set, Commit or Silence while disarmed: WRONG_STATE.

    Check the state before the session, the capabilities and the stream. Accept Ping and Disarm in
    this state.
    """
    return _rows_while_disarmed(subject)


def _rows_while_disarmed(subject: Subject, ramp: int = 0) -> list[Row]:
    """Return requests that an unarmed amplifier rejects or ignores; ramp of the Disarm [ms]."""
    loud = subject.layer_0(level=0.75)
    # The state is checked before the capabilities and before repeated layers.
    rows: list[Row] = [
        play_now(loud, token=9, code="WRONG_STATE"),
        stage(loud, loud, token=9, code="WRONG_STATE"),
        commit(1, "WRONG_STATE"),
        send("Silence", ramp=_MAX_RAMP, code="WRONG_STATE"),
    ]
    return [*rows, send("Ping", session=77), send("Disarm", ramp=ramp)]


def rows_while_latched(subject: Subject) -> list[Row]:
    """Return requests that an amplifier rejects or ignores after a stop or in a fault."""
    rows: list[Row] = [
        send("Arm", watchdog=_WATCHDOG.maximum, session=77, code="WRONG_STATE"),
    ]
    if subject.has("address"):
        serial_number = subject.identity["serial_number"]
        rows.append(send("SetAddress", address=9, serial_number=serial_number, code="WRONG_STATE"))
    return rows + _rows_while_disarmed(subject)


@driving("protocol.md#states")
def arming(subject: Subject) -> RequestRows:
    """Arm after Disarm: silent, high voltage on, earlier sets and tokens forgotten.

    In Arm, drop collected and staged sets and reset the committed token to 0.
    """
    playing = subject.layer_0()
    rows: list[Row] = [subject.arm, play_now(playing, token=40_000), stage(playing, token=40_001)]
    rows += [DISARM_NOW, subject.settle, subject.arm, commit(40_001, "BAD_TOKEN")]
    # Older than 40 000, but the first of this session.
    rows.append(play_now(playing, token=39_999))
    return rows


@driving("protocol.md#states")
def arms_again(subject: Subject) -> RequestRows:
    """Arm with the session held: the watchdog restarts with the new time, playback continues.

    If the session is the one held, only store the new watchdog time and restart the count; keep
    voices, staged sets and the token.
    """
    watchdog_max = subject.can["watchdog_max"]
    return [
        partial(subject.arm, watchdog_max / 1000),
        subject.layer_0(),
        stage(subject.layer_0(level=0.5)),
        send("Arm", watchdog=subject.shortest_watchdog),
        send("Arm", watchdog=watchdog_max),
        commit(2),
    ]


@driving("protocol.md#sessions-and-the-watchdog")
def sessions(subject: Subject) -> RequestRows:
    """Request with another session, or Arm with an ended session: WRONG_SESSION.

    Compare all 16 bits of the session, right after the state. Remember the last session after
    Disarm, Stop and faults, and reject an Arm that repeats it.
    """
    watchdog_max = subject.can["watchdog_max"]
    playing = subject.layer_0()
    quiet = subject.layer_0(level=0.25)
    arm_again = send("Arm", watchdog=watchdog_max, session=_SESSION, code="WRONG_SESSION")
    arm_after_stop = send("Arm", watchdog=watchdog_max, code="WRONG_SESSION")
    rows: list[Row] = [partial(subject.arm, session=_SESSION), playing, stage(playing)]
    for other_session in _OTHER_SESSIONS:
        rows.append(partial(_expect_wrong_session, subject, other_session))
    rows += [send("Ping", session=0, code="BAD_VALUE"), DISARM_NOW, subject.settle]
    rows += [play_now(quiet, session=_NEXT_SESSION, code="WRONG_STATE"), arm_again]
    rows += [partial(subject.arm, session=_NEW_SESSION), subject.status]
    rows.append(play_now(quiet, session=_SESSION, code="WRONG_SESSION"))
    rows += [STOP_NOW, subject.settle, subject.clear, arm_after_stop]
    rows.append(partial(subject.arm, session=_OLDER_SESSION))
    return rows


async def _expect_wrong_session(subject: Subject, session: int) -> None:
    """Send requests with another session, in one go."""
    wrong = partial(send, session=session, code="WRONG_SESSION")
    quiet = subject.layer_0(level=0.25)
    rows = [
        play_now(quiet, token=3, session=session, code="WRONG_SESSION"),
        wrong("Commit", token=2),
        # The session is checked before the capabilities.
        wrong("Silence", ramp=_MAX_RAMP),
        wrong("Ping"),
        wrong("Arm", watchdog=_WATCHDOG.minimum),
        wrong("Arm", watchdog=_WATCHDOG.maximum),
    ]
    await subject.send_all(rows)


@driving("protocol.md#states")
def arming_ends_fades(subject: Subject) -> RequestRows:
    """Arm during the fade of a Disarm: silent within 5 ms.

    In Arm, shorten every running fade to 5 ms, and keep rejecting the session that Disarm ended.
    """
    ended_session = send("Arm", watchdog=subject.can["watchdog_max"], code="WRONG_SESSION")
    return [
        subject.arm,
        subject.layer_0(),
        send("Disarm", ramp=subject.ramp_max),
        ended_session,
        subject.arm,
        partial(subject.follow, 0.02),
        subject.layer_0(),
    ]


@driving("protocol.md#states")
def stop(subject: Subject) -> RequestRows:
    """Stop with ramp 0: every channel silent, latched; nothing plays or arms before Clear.

    Remove every voice, drop collected, staged and waiting sets, enter QUICK_STOP_ACTIVE with a new
    latch, and answer WRONG_STATE to Arm, Set, Commit and Silence.
    """
    staged = stage(subject.layer_0(level=0.5))
    before_stop: list[Row] = [subject.arm, subject.all_channels(), staged]
    while_latched = rows_while_latched(subject)
    commit_staged = commit(2, "WRONG_STATE")
    return [*before_stop, STOP_NOW, Wait(0.02), *while_latched, commit_staged, Wait(0.1)]


@driving("protocol.md#states")
def stop_ramps(subject: Subject) -> RequestRows:
    """Stop or Disarm with a ramp: raised cosine to zero; a second one only shortens it.

    Lead every voice from its present amplitude along the raised cosine. Treat a ramp above ramp_max
    as ramp_max, and keep the earlier of two ends.
    """
    playing = subject.all_channels()
    during_fade = partial(subject.follow, 0.2 * subject.timing.slowness)
    part, *_ = subject.sets.parts(subject.layer_0(), token=2, now=0, count=3)
    slow_stop = send("Stop", ramp=subject.ramp)
    slowest_stop = send("Stop", ramp=0xFFFF)
    disarm = send("Disarm", ramp=subject.ramp)
    slowest_disarm = send("Disarm", ramp=0xFFFF)
    too_slow_stop = send("Stop", ramp=min(2 * subject.ramp_max, 0xFFFF))
    while_disarmed = _rows_while_disarmed(subject, 0xFFFF)
    return [
        (playing, send("Set", **part), slow_stop),
        (playing, disarm),
        (playing, slowest_stop, during_fade, disarm),
        (playing, slowest_disarm, *while_disarmed, subject.clear, during_fade, slow_stop),
        (playing, too_slow_stop),
    ]


@driving("protocol.md#layers")
def silence_never_later(subject: Subject) -> RequestRows:
    """Second Stop during a fade: silent at the earlier of both ends.

    Compare the time left of the running fade with the new ramp, and keep the fade that ends first.
    """
    subject.require_ramp()
    slow_stop = send("Stop", ramp=min(400, subject.ramp_max))
    quick_stop = send("Stop", ramp=50)
    playing = subject.all_channels()
    courses: list[Row] = [(playing, slow_stop, quick_stop), (playing, quick_stop, slow_stop)]
    courses.append((subject.layer_0(), layer(0, ramp=50), slow_stop))
    # The remaining time of a fade counts, not its duration.
    courses.append((playing, send("Stop", ramp=300), Wait(0.2), send("Stop", ramp=150)))
    return courses


@driving("protocol.md#states")
def stop_ends_all(subject: Subject) -> RequestRows:
    """Stop during fades, onsets, endings and waiting sets: all end with the Stop's ramp.

    Fade every voice of every layer, released or not, skip endings, and drop what waits.
    """
    subject.require_ramp()
    quick_stop = send("Stop", ramp=10)
    return [(*rows, quick_stop) for rows in subject.transitions(subject.ramp_max)]


@driving("protocol.md#states")
def stops_are_numbered(subject: Subject) -> RequestRows:
    """Every Stop: the next latch number; Clear with another number: WRONG_LATCH.

    Give every Stop and every fault the next 16-bit number, 1 to 65535 and then 1, also while
    disarmed or stopped. Compare all 16 bits in Clear, and change nothing if there is nothing to
    clear.
    """
    latch = token_after(token_after(token_after(subject.latch)))
    rows: list[Row] = [STOP_NOW, STOP_NOW, STOP_NOW]
    for other_latch in ((latch - 1) % 0x10000, (latch + 1) % 0x10000, latch ^ 0x100):
        rows.append(send("Clear", latch=other_latch, code="WRONG_LATCH"))
    rows += [subject.clear, subject.clear, subject.arm, subject.clear]
    return [*rows, subject.layer_0(), subject.clear]


@driving("protocol.md#states")
def clear_too_early(subject: Subject) -> RequestRows:
    """Clear during the fade of a Stop: the state does not change.

    Leave QUICK_STOP_ACTIVE only when no voice lasts; until then, answer Clear with the present
    Status.
    """
    subject.require_ramp()
    ramp = subject.ramp
    last_channel = layer(0, subject.tone(subject.channels[-1]))
    after_fade = Wait(ramp / 1000 + 0.02)
    return [
        subject.arm,
        last_channel,
        send("Stop", ramp=ramp),
        subject.clear,
        after_fade,
        subject.clear,
    ]


@driving("protocol.md#start-of-a-set")
def silence(subject: Subject) -> RequestRows:
    """Silence: all layers fade with its ramp, staged sets are dropped, the amplifier stays armed.

    Fade every voice, drop collected, staged and waiting sets, and stay in OPERATION_ENABLED. Reject
    a ramp above ramp_max with BAD_VALUE.
    """
    ending = subject.envelope(0.1, 1, 1)
    second_channel = 1 % len(subject.channels)
    playing = play_now(
        layer(0, subject.tone(0, 0.5, ending=ending)),
        layer(1, subject.tone(0, 0.4, frequency=subject.second_frequency)),
        layer(2, subject.tone(second_channel, 0.1)),
    )
    content = subject.layer_0()
    first_part, *_, last_part = subject.sets.parts(content, token=4, now=0, count=3)
    rows: list[Row] = [subject.arm, playing, stage(content)]
    rows += [send("Silence", ramp=subject.ramp), subject.follow, commit(2, "BAD_TOKEN")]
    rows += [content, send("Set", **first_part), SILENCE_NOW, send("Set", **last_part)]
    rows.append(send("Silence", ramp=subject.ramp_max + 1, code="BAD_VALUE"))
    return rows
