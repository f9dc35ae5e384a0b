"""One simulated amplifier on a virtual clock, against the protocol's own words."""

import dataclasses
import math

import pytest

from drivers.command import CommandSet, DriveCommand
from drivers.protocol.messages import (
    Achieved,
    AmplifierState,
    Apply,
    Arm,
    Capabilities,
    ChannelLimits,
    Clear,
    Commit,
    Disarm,
    Fault,
    FaultList,
    GetCaps,
    GetFaults,
    GetStatus,
    Hello,
    Identity,
    Nak,
    NakCode,
    Ping,
    Reply,
    Request,
    Stage,
    Status,
    Stop,
)
from sim.amplifier.amplifier import SimulatedAmplifier


def playing(
    token: int, *levels: float, ramp: float = 0.0, valid_for: float = 0.0, frequency: float = 110.0
) -> CommandSet:
    """A set that plays these levels on the first channels, all at one frequency."""
    commands = tuple(DriveCommand(channel, frequency, x) for channel, x in enumerate(levels))
    return CommandSet(token, commands, ramp=ramp, valid_for=valid_for)


def armed(at: float = 0.0, *, watchdog: float = 0.25) -> SimulatedAmplifier:
    """Four channels, enabled and silent."""
    amplifier = SimulatedAmplifier("main", channels=4)
    assert isinstance(amplifier.handle(Arm(watchdog), at), Status)
    return amplifier


def status(amplifier: SimulatedAmplifier, now: float) -> Status:
    """How it is, asked in a way that does not feed the watchdog."""
    reply = amplifier.handle(GetStatus(), now)
    assert isinstance(reply, Status)
    return reply


def refused(reply: Reply, code: NakCode, channel: int | None = None) -> None:
    """Assert that this is a refusal for this reason."""
    assert reply == Nak(code, channel)


S = AmplifierState
# One row per state, one column per request; "!" is refused, "." stays as it is.
REQUESTS: list[Request] = [
    *(Hello(), GetCaps(), GetStatus(), GetFaults(), Ping()),
    *(Arm(0.25), Disarm(0.01), Stage(playing(7, 0.5)), Commit(7), Apply(playing(7, 0.5))),
    *(Stop(0.01), Clear(1)),
]
EXPECTED = {
    #                        hello..ping     arm   disarm stage commit apply stop  clear
    S.NOT_READY: [*"....." + "!", ".", "!", "!", "!", ".", "."],
    S.SWITCH_ON_DISABLED: [*".....", S.OPERATION_ENABLED, ".", *"!!!", S.QUICK_STOP_ACTIVE, "."],
    S.READY_TO_SWITCH_ON: [*".....", S.OPERATION_ENABLED, ".", *"!!!", S.QUICK_STOP_ACTIVE, "."],
    S.SWITCHED_ON: [*".....", S.OPERATION_ENABLED, ".", *"!!!", S.QUICK_STOP_ACTIVE, "."],
    S.OPERATION_ENABLED: [*"......", S.SWITCHED_ON, *"...", S.QUICK_STOP_ACTIVE, "."],
    S.QUICK_STOP_ACTIVE: [*".....", "!", ".", *"!!!", ".", S.SWITCH_ON_DISABLED],
    S.FAULT_REACTION_ACTIVE: [*".....", "!", ".", *"!!!", ".", "."],
    S.FAULT: [*".....", "!", ".", *"!!!", ".", S.SWITCH_ON_DISABLED],
}
REPLIES = {
    **{Hello: Identity, GetCaps: Capabilities, GetFaults: FaultList},
    **{Stage: Achieved, Commit: Achieved, Apply: Achieved},
}


def brought_to(state: AmplifierState, request: Request) -> SimulatedAmplifier:
    """An amplifier in a state, reached by the protocol where the protocol leads there."""
    amplifier = armed()
    amplifier.handle(Apply(playing(5, 0.5)), 0.0)
    if isinstance(request, Commit):
        amplifier.handle(Stage(playing(7, 0.5)), 0.0)
    match state:
        case AmplifierState.SWITCH_ON_DISABLED:
            amplifier.handle(Disarm(0.0), 0.01)
        case AmplifierState.SWITCHED_ON:
            amplifier.handle(Disarm(0.5), 0.01)
        case AmplifierState.QUICK_STOP_ACTIVE:
            amplifier.handle(Stop(0.0), 0.01)
        case AmplifierState.FAULT_REACTION_ACTIVE:
            amplifier.tick(0.251)
        case AmplifierState.FAULT:
            amplifier.tick(0.256)
        case (
            AmplifierState.NOT_READY | AmplifierState.READY_TO_SWITCH_ON
        ):  # never entered: passed through at once
            amplifier = SimulatedAmplifier("main", channels=4)
            amplifier.state = state
        case _:
            pass
    assert amplifier.state is state
    return amplifier


@pytest.mark.parametrize("state", list(AmplifierState), ids=lambda state: state.name)
@pytest.mark.parametrize("column", range(12), ids=[type(r).__name__ for r in REQUESTS])
def test_amplifier_follows_the_state_table(state: AmplifierState, column: int) -> None:
    """Each pair leads where the protocol says, or is refused and changes nothing."""
    request, expected = REQUESTS[column], EXPECTED[state][column]
    amplifier = brought_to(state, request)
    now = 0.252 if state is AmplifierState.FAULT_REACTION_ACTIVE else 0.26
    now = 0.02 if state in (S.OPERATION_ENABLED, S.SWITCHED_ON) else now
    before = status(amplifier, now)
    reply = amplifier.handle(request, now)
    if expected == "!":
        refused(reply, NakCode.WRONG_STATE)
        assert status(amplifier, now) == before
    else:
        assert isinstance(reply, REPLIES.get(type(request), Status))
        assert amplifier.state is (state if expected == "." else expected)


def test_arm_starts_at_level_zero() -> None:
    """Armed: enabled, high voltage on, silent, no token; watchdogs out of range are refused."""
    amplifier = SimulatedAmplifier("main", channels=4)
    assert not status(amplifier, 0.0).high_voltage
    for watchdog in (0.0, 0.0999, 2.001, math.nan, math.inf):
        refused(amplifier.handle(Arm(watchdog), 0.0), NakCode.BAD_VALUE)
    amplifier.handle(Arm(0.25), 1.0)
    now = status(amplifier, 1.1)
    assert (now.state, now.token, now.high_voltage) == (S.OPERATION_ENABLED, 0, True)
    assert now.levels == (0, 0, 0, 0)
    assert now.watchdog_left == pytest.approx(0.15)


def test_watchdog_expires_at_its_time_when_ticked_late() -> None:
    """Playing until 0.25 s, half down 2.5 ms later, silent and in FAULT 5 ms later."""
    amplifier = armed()
    amplifier.handle(Apply(playing(1, 1.0)), 0.0)
    assert amplifier.next_event == 0.25
    assert status(amplifier, 0.2499).levels[0] == 1.0
    late = armed()
    late.handle(Apply(playing(1, 1.0)), 0.0)
    tripped = status(late, 0.2525)
    assert (tripped.state, tripped.fault) == (S.FAULT_REACTION_ACTIVE, Fault.WATCHDOG)
    assert tripped.levels[0] == pytest.approx(0.5)
    for one, moment in ((late, 0.2551), (amplifier, 7.0)):
        done = status(one, moment)
        assert (done.state, done.fault, done.levels[0]) == (S.FAULT, Fault.WATCHDOG, 0)
        assert not done.high_voltage
    faults = amplifier.handle(GetFaults(), 7.25)
    assert isinstance(faults, FaultList)
    assert faults.faults[0].age == pytest.approx(7.0)


@pytest.mark.parametrize("request_", REQUESTS, ids=lambda request: type(request).__name__)
def test_watchdog_is_fed_by_accepted_requests(request_: Request) -> None:
    """Arm, Ping, Stage, Commit and Apply feed it, no other request does."""
    amplifier = armed()
    if isinstance(request_, Commit):
        amplifier.handle(Stage(playing(7, 0.5)), 0.0)
    amplifier.handle(request_, 0.2)
    amplifier.tick(0.3)
    feeds = isinstance(request_, Arm | Ping | Stage | Commit | Apply)
    assert (amplifier.state is AmplifierState.OPERATION_ENABLED) == feeds


def test_watchdog_is_not_fed_by_refused_requests() -> None:
    """A host that only sends nonsense does not keep the plate alive."""
    amplifier = armed()
    refused(amplifier.handle(Commit(99), 0.2), NakCode.BAD_TOKEN)
    refused(amplifier.handle(Apply(playing(1, 1.5)), 0.2), NakCode.BAD_VALUE, 0)
    assert status(amplifier, 0.25).fault is Fault.WATCHDOG


BAD = [
    (DriveCommand(4, 110.0, 0.5), NakCode.BAD_CHANNEL, 4),
    (DriveCommand(-1, 110.0, 0.5), NakCode.BAD_CHANNEL, -1),
    (DriveCommand(0, 110.0, 0.5), NakCode.BAD_CHANNEL, 0),  # named twice
    (DriveCommand(1, 9.9, 0.5), NakCode.BAD_VALUE, 1),
    (DriveCommand(1, 3276.8, 0.5), NakCode.BAD_VALUE, 1),
    (DriveCommand(1, math.nan, 0.5), NakCode.BAD_VALUE, 1),
    (DriveCommand(1, 110.0, 1.0001), NakCode.BAD_VALUE, 1),
    (DriveCommand(1, 110.0, -0.1), NakCode.BAD_VALUE, 1),
    (DriveCommand(1, 110.0, math.nan), NakCode.BAD_VALUE, 1),
    (DriveCommand(1, 110.0, 0.5, phase=math.inf), NakCode.BAD_VALUE, 1),
]


@pytest.mark.parametrize(("bad", "code", "channel"), BAD)
def test_apply_is_atomic(bad: DriveCommand, code: NakCode, channel: int) -> None:
    """One bad channel refuses the set; what was playing and what was staged stay as they were."""
    amplifier = armed()
    amplifier.handle(Apply(playing(1, 0.1, 0.2)), 0.0)
    amplifier.handle(Stage(playing(2, 0.9)), 0.0)
    outputs = amplifier.outputs
    good = DriveCommand(0, 200.0, 1.0)
    for request in (Apply, Stage):
        refused(amplifier.handle(request(CommandSet(3, (good, bad), 0.0, 0.0)), 0.1), code, channel)
    assert amplifier.outputs == outputs
    assert status(amplifier, 0.1).token == 1
    assert isinstance(amplifier.handle(Commit(2), 0.1), Achieved)


@pytest.mark.parametrize(
    ("header", "code"),
    [
        *(((token, 0.0, 0.0), NakCode.BAD_TOKEN) for token in (0, 65536)),
        *(((1, ramp, 0.0), NakCode.BAD_VALUE) for ramp in (-0.01, 1.1, math.nan)),
        *(((1, 0.0, valid_for), NakCode.BAD_VALUE) for valid_for in (-1.0, 61.0)),
    ],
)
def test_apply_refuses_an_invalid_header(header: tuple[int, float, float], code: NakCode) -> None:
    """Token, ramp and duration must be within the protocol's ranges."""
    token, ramp, valid_for = header
    wanted = CommandSet(token, (DriveCommand(0, 110.0, 0.5),), ramp, valid_for)
    refused(armed().handle(Apply(wanted), 0.1), code)


def test_channel_has_its_own_limits() -> None:
    """Beyond them the whole set is refused with the channel; silence has any frequency."""
    limits = (ChannelLimits(20.0, 600.0, 1.0), ChannelLimits(50.0, 300.0, 0.5))
    amplifier = SimulatedAmplifier("main", channels=2)
    amplifier.capabilities = dataclasses.replace(amplifier.capabilities, channel_limits=limits)
    amplifier.restart(0.0)
    amplifier.handle(Arm(0.25), 0.0)
    for token, frequency, level in ((1, 40.0, 0.1), (2, 310.0, 0.1), (3, 110.0, 0.6)):
        commands = (DriveCommand(0, frequency, level), DriveCommand(1, frequency, level))
        refused(
            amplifier.handle(Apply(CommandSet(token, commands, ramp=0.0, valid_for=0.0)), 0.0),
            NakCode.BAD_VALUE,
            1,
        )
    commands = (DriveCommand(0, 40.0, 1.0), DriveCommand(1, 40.0, 0.0))
    reply = amplifier.handle(Apply(CommandSet(4, commands, ramp=0.0, valid_for=0.0)), 0.0)
    assert isinstance(reply, Achieved)


def test_apply_silences_unnamed_channels() -> None:
    """A set is the whole plate's: what it does not name is silent after its ramp."""
    amplifier = armed()
    amplifier.handle(Apply(playing(1, 0.5, 0.6, 0.7)), 0.0)
    amplifier.handle(Apply(playing(2, 0.5, ramp=0.02)), 0.1)
    assert status(amplifier, 0.12).levels == (0.5, 0, 0, 0)


def test_apply_ignores_a_repeated_token() -> None:
    """A repeated Apply or Commit answers as the first did and leaves the phase running.

    The same token with another set, and an earlier token, are refused.
    """
    amplifier = armed()
    first = amplifier.handle(Apply(playing(1, 0.5)), 0.0)
    outputs = amplifier.outputs
    assert amplifier.handle(Apply(playing(1, 0.5)), 0.1) == first
    assert amplifier.handle(Commit(1), 0.1) == first
    refused(amplifier.handle(Apply(playing(1, 0.4)), 0.1), NakCode.BAD_TOKEN)
    assert amplifier.outputs == outputs
    amplifier.handle(Apply(playing(2, 0.3)), 0.2)
    refused(amplifier.handle(Apply(playing(1, 0.5)), 0.2), NakCode.BAD_TOKEN)
    assert status(amplifier, 0.2).levels[0] == 0.3
    amplifier.handle(Disarm(0.0), 0.3)
    amplifier.handle(Arm(0.25), 0.3)
    amplifier.handle(Apply(playing(1, 0.5)), 0.3)
    assert status(amplifier, 0.3).token == 1


@pytest.mark.parametrize(
    ("token", "is_played"), [(1, True), (32766, True), (32767, False), (65534, False)]
)
def test_token_must_be_newer(token: int, is_played: bool) -> None:
    """After 65535: by less than 32768 modulo 65536, as RFC 1982 has it."""
    amplifier = armed()
    amplifier.handle(Apply(playing(65535, 0.1)), 0.0)
    reply = amplifier.handle(Apply(playing(token, 0.2)), 0.0)
    assert isinstance(reply, Achieved) == is_played


def test_staged_set_expires() -> None:
    """After a second its commit is refused; one in time is played."""
    amplifier = armed(watchdog=2.0)
    amplifier.handle(Stage(playing(1, 0.1)), 0.0)
    refused(amplifier.handle(Commit(1), 1.001), NakCode.BAD_TOKEN)
    amplifier.handle(Stage(playing(1, 0.1)), 1.1)
    assert isinstance(amplifier.handle(Commit(1), 2.099), Achieved)


@pytest.mark.parametrize("late", [Stage, Apply])
def test_stage_refuses_a_late_copy(late: type[Stage] | type[Apply]) -> None:
    """The output changes at the commit of the staged set, not at a late copy or another token."""
    amplifier = armed()
    for token in (1, 2):
        amplifier.handle(Apply(playing(token, 0.1 * token)), 0.0)
    amplifier.handle(Stage(playing(3, 0.3)), 0.0)
    refused(amplifier.handle(Commit(4), 0.0), NakCode.BAD_TOKEN)
    assert status(amplifier, 0.0).levels[0] == pytest.approx(0.2)
    refused(amplifier.handle(late(playing(1, 0.1)), 0.0), NakCode.BAD_TOKEN)
    assert isinstance(amplifier.handle(Commit(3), 0.0), Achieved)
    assert status(amplifier, 0.0).levels[0] == pytest.approx(0.3)


def test_set_ends_after_valid_for() -> None:
    """After valid_for the set fades out along its ramp; its token stays and is not played again."""
    amplifier = armed()
    amplifier.handle(Apply(playing(1, 1.0, ramp=0.02, valid_for=0.1)), 0.0)
    assert amplifier.next_event == pytest.approx(0.1)
    assert status(amplifier, 0.0999).levels[0] == 1.0
    assert status(amplifier, 0.11).levels[0] == pytest.approx(0.5)
    ended = status(amplifier, 0.1201)
    assert (ended.state, ended.token, ended.levels[0]) == (S.OPERATION_ENABLED, 1, 0)
    amplifier.handle(Apply(playing(1, 1.0, ramp=0.02, valid_for=0.1)), 0.2)
    assert status(amplifier, 0.24).levels[0] == 0


def test_achieved_reports_rounded_values() -> None:
    """0.05 Hz, 1e-4 of full stroke, 0.01 degrees within half a turn, the protocol's steps."""
    wanted = CommandSet(1, (DriveCommand(2, 110.0249, 0.123449, 270.0),), 0.0, 0.0)
    reply = armed().handle(Apply(wanted), 0.0)
    assert isinstance(reply, Achieved)
    assert reply.commands == (DriveCommand(2, 110.0, 0.1234, -90.0),)
    finer = dataclasses.replace(
        wanted, token=2, commands=(DriveCommand(2, 110.0251, 0.123451, 12.3449),)
    )
    reply = armed().handle(Apply(finer), 0.0)
    assert isinstance(reply, Achieved)
    assert reply.commands == (DriveCommand(2, 110.05, 0.1235, 12.34),)


def test_stop_is_latched() -> None:
    """Silent within its ramp, then it stays stopped until Clear, which needs level zero."""
    amplifier = armed()
    amplifier.handle(Apply(playing(1, 1.0)), 0.0)
    amplifier.handle(Stop(0.05), 0.1)
    assert status(amplifier, 0.125).levels[0] == pytest.approx(0.5)
    amplifier.handle(Clear(1), 0.125)
    assert amplifier.state is AmplifierState.QUICK_STOP_ACTIVE
    refused(amplifier.handle(Apply(playing(2, 1.0)), 0.13), NakCode.WRONG_STATE)
    stopped = status(amplifier, 10.0)
    assert (stopped.state, stopped.levels[0]) == (S.QUICK_STOP_ACTIVE, 0)
    assert stopped.fault is Fault.NONE
    assert not stopped.high_voltage
    amplifier.handle(Clear(1), 10.0)
    assert amplifier.state is AmplifierState.SWITCH_ON_DISABLED


@pytest.mark.parametrize("ramp", [math.nan, -1.0, 1e9])
def test_stop_accepts_any_ramp(ramp: float) -> None:
    """Whatever ramp a stop asks for, the plate is silent within the longest allowed one."""
    amplifier = armed(watchdog=2.0)
    amplifier.handle(Apply(playing(1, 1.0)), 0.0)
    assert isinstance(amplifier.handle(Stop(ramp), 0.1), Status)
    assert status(amplifier, 1.1001).levels[0] == 0


def test_disarm_ramps_down_before_high_voltage_is_off() -> None:
    """High voltage stays while a channel still plays, and is off afterwards."""
    amplifier = armed()
    amplifier.handle(Apply(playing(1, 1.0)), 0.0)
    amplifier.handle(Disarm(0.05), 0.1)
    during = status(amplifier, 0.125)
    assert (during.state, during.high_voltage) == (S.SWITCHED_ON, True)
    after = status(amplifier, 0.151)
    assert (after.state, after.high_voltage, after.levels[0]) == (S.SWITCH_ON_DISABLED, False, 0)
    # no host, no watchdog: a disarmed amplifier stays as it is
    assert status(amplifier, 100.0).fault is Fault.NONE
