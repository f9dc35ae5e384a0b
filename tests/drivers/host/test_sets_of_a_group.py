"""Sets play whole, once and together on all amplifiers of a group, or the host reports a failure.

Requests and replies are lost or late, amplifiers refuse, and other requests are under way.
"""

import asyncio
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import pytest

from drivers.errors import (
    CommandRefused,
    DriverError,
    LinkDegraded,
    LinkTimeout,
    Overtaken,
    Preempted,
)
from drivers.host import joint_sets
from drivers.host.joint_sets import PlayedSet
from drivers.host.set_admission import StagedSet
from drivers.protocol.definition import MESSAGES
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, Envelope, LayerSet
from drivers.wires.serial_frames import REPLY_BIT, FrameReader, encode_frame, pack_words
from kit.clock import unaltered
from registry import threads
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from tests.drivers.host.group_on_lines import (
    HALF,
    SILENT,
    Rig,
    begin,
    block_writes,
    connect,
    intercept,
    late,
    layer,
    losing,
    lost,
    of_parts,
    on_wires,
    refuse,
    set_unsteered_clock,
    tone,
)


@on_wires()
async def test_set_that_one_ledger_refuses_is_committed_on_none(wire: str) -> None:
    """The second amplifier lacks channel 2; the first one plays on."""
    rig = await connect("a", "b", wire=wire)
    await rig.play(0.5)
    louder = layer(0, tone(0.9))
    missing_channel = layer(0, tone(0.5, channel=2))

    with pytest.raises(CommandRefused) as refusal:
        await rig.group.apply({"a": [louder], "b": [missing_channel]})

    assert refusal.value.channel == 2
    assert rig.group.is_armed
    await asyncio.sleep(0.01)
    assert rig.levels == {"a": HALF, "b": HALF}
    await rig.play(0.3)


@on_wires()
async def test_ledger_notes_a_set_that_the_repeated_commit_started(wire: str) -> None:
    """The broadcast is lost; a set that is too loud together with the first one is refused."""
    rig = await connect("ab", wire=wire)
    rig.line.inward = losing("Commit")
    await rig.play(0.6)
    await asyncio.sleep(0.002)
    assert rig.levels == {"a": [0.6, 0.0], "b": [0.6, 0.0]}
    for name, host in rig.hosts.items():
        assert host.ledger.playback.tokens == {0: rig.group.sets.token}, name

    too_loud = layer(1, tone(0.5, 150.0))
    with pytest.raises(CommandRefused):
        await rig.apply(too_loud)

    await rig.group.beat()


@on_wires("serial")
async def test_set_that_would_be_committed_too_late_is_not(wire: str) -> None:
    """The ledger admits it for 0.1 s, but its commit is lost for longer, and b has played it.

    Both are silenced, and stay armed for the next set.
    """
    rig = await connect("a", "b", wire=wire)
    quiet = layer(1, tone(0.1, 150.0, channel=1))
    await rig.apply(quiet)
    rig.lines[0].inward = losing("Commit", count=2)
    rig.lines[1].inward = losing("Set", count=2)

    with pytest.raises(Preempted):
        await rig.play(0.5)

    await asyncio.sleep(0.005)
    assert rig.levels == {"a": SILENT, "b": SILENT}
    assert rig.group.is_armed
    assert not rig.group.sets.is_incomplete
    await rig.play(0.5)
    await rig.group.beat()


@on_wires("serial")
async def test_aborted_exchange_is_no_fault(wire: str) -> None:
    """A set is given up before the commits have replies; a silence follows, and all stay armed."""
    rig = await connect("a", "b", wire=wire)
    rig.alter_replies(late(0.02))
    playing = await begin(rig.play(0.5))
    await asyncio.sleep(0.03)
    rig.watch()

    rig.group.abort_exchange()

    with pytest.raises(Preempted):
        await playing
    assert rig.group.sets.is_incomplete
    await rig.group.silence(0.001)
    assert rig.sent_after("a Silence") <= 0.0081
    assert rig.levels == {"a": SILENT, "b": SILENT}
    assert rig.group.is_armed
    assert not rig.group.sets.is_incomplete


@on_wires("serial")
async def test_set_at_the_moment_of_a_loss_reports_the_loss(wire: str) -> None:
    """Before any heartbeat finds it; a control loop that continued would wait forever."""
    rig = await connect("a", "b", wire=wire)
    await rig.play(0.5)
    rig.lines[1].outward = lost
    with pytest.raises(LinkDegraded):
        await rig.group.beat()
    await asyncio.sleep(rig.group.members.lost_from - threads.now())

    with pytest.raises(LinkTimeout) as loss:
        await rig.play(0.5)

    assert type(loss.value) is LinkTimeout
    assert not rig.group.is_open
    assert rig.levels == {"a": SILENT, "b": SILENT}


def commit_few(amplifier: SimulatedAmplifier, count: int) -> None:
    """Have an amplifier play so many layers of each set, and report that it plays all."""
    commit = amplifier.playback.commit

    def commit_some(layers: tuple[LayerSet, ...], token: int, moment: float) -> None:
        if count:
            commit(layers[:count], token, moment)

    amplifier.playback.commit = commit_some


@on_wires("serial")
async def test_set_that_plays_in_part_stops(wire: str) -> None:
    """An amplifier commits one of two layers: two heartbeats in a row contradict the set."""
    rig = await connect("a", wire=wire)
    commit_few(rig.far["a"], 1)
    await rig.apply(layer(0, tone(0.5)), layer(1, tone(0.2, 150.0)))
    await rig.group.beat()
    await asyncio.sleep(0.05)

    with pytest.raises(CommandRefused):
        await rig.group.beat()

    assert rig.levels == {"a": SILENT}
    assert not rig.group.is_armed


@on_wires("serial")
async def test_amplifier_that_does_not_start_a_set_is_found(wire: str) -> None:
    """Two statuses, 1 and 12 ms after the start, show nothing of the set."""
    rig = await connect("a", "b", wire=wire)
    commit_few(rig.far["b"], 0)
    await rig.play(0.5)
    await asyncio.sleep(0.001)
    await rig.hosts["b"].read_status()
    await asyncio.sleep(0.011)

    with pytest.raises(CommandRefused):
        await rig.hosts["b"].read_status()


@on_wires("serial")
async def test_set_without_replies_is_given_up_but_no_fault(wire: str) -> None:
    """Three times 30 ms on one line; two amplifiers on the other take longer than 100 ms."""
    rig = await connect("a", "bc", wire=wire)
    rig.alter_replies(losing("Set", count=1000))

    with pytest.raises(LinkDegraded):
        await rig.play(0.5)

    await asyncio.sleep(0.02)
    assert rig.levels == dict.fromkeys("abc", SILENT)
    assert rig.group.is_armed


async def apply_parts(rig: Rig, count: int) -> None:
    """Apply a set of about so many parts to the first amplifier."""
    await rig.apply(*of_parts(count))


@on_wires("can", "serial")
async def test_missing_part_of_a_set_is_sent_again_with_later_parts(wire: str) -> None:
    """Part 1 of four is lost: parts 0 1 2 3 are sent, then 1 2 3."""
    rig = await connect("a", wire=wire)
    parts = 0

    def lose_part_1(name: str, data: bytes) -> list[tuple[float, bytes]]:
        nonlocal parts
        parts += name == "Set"
        return [] if parts == 2 and name == "Set" else unaltered(name, data)

    rig.line.inward = lose_part_1
    rig.watch()

    await apply_parts(rig, 4)

    assert rig.requests() == ["a Set"] * 7
    assert rig.retries == 1
    await asyncio.sleep(0.06)
    assert rig.levels["a"] != SILENT


@on_wires("serial")
async def test_reply_to_an_earlier_part_does_not_confirm_a_set(wire: str) -> None:
    """An amplifier replies to each of eight parts that the set plays: all are sent."""
    rig = await connect("a", wire=wire)
    values = {
        "token": rig.group.sets.token + 1,
        "exact": 1,
        "staged": 0,
        "played": 1,
        "missing": 0,
    }
    message = MESSAGES["Set"]
    payload = pack_words(message.reply.pack(values))

    def confirm(name: str, data: bytes) -> list[tuple[float, bytes]]:
        (frame,) = FrameReader().feed(data)
        if name == "Set":
            reply = frame._replace(kind=message.number | REPLY_BIT, payload=payload)
            rig.line.later(0.0001, rig.line.line.received, encode_frame(reply))
        return unaltered(name, data)

    rig.line.inward = confirm
    rig.watch()

    await apply_parts(rig, 8)

    assert rig.requests() == ["a Set"] * 8
    await asyncio.sleep(0.06)
    assert rig.levels["a"] != SILENT


@on_wires("can", "serial", "tcp")
async def test_part_that_never_arrives_is_given_up(wire: str) -> None:
    """An amplifier that reports it missing is sent it three times, and counts as degraded."""
    rig = await connect("a", wire=wire)

    def take_none(part: Values, _: float) -> Values:
        return {"token": part["token"], "exact": 0, "staged": 0, "played": 0, "missing": 0}

    rig.far["a"]._take_part = take_none

    async with asyncio.timeout(1.0):
        with pytest.raises(LinkTimeout):
            await apply_parts(rig, 3)

    assert rig.group.members.degraded == ("a",)


@on_wires("can", "rtu", "serial")
async def test_heartbeats_and_stops_go_between_the_parts_of_a_set(wire: str) -> None:
    """A request that comes amid the parts is sent next; after a stop no other part is sent."""
    rig = await connect("a", wire=wire)
    rig.line.outward = late(0.002)
    playing = await begin(apply_parts(rig, 8))
    await asyncio.sleep(0.001)
    rig.watch()
    await rig.hosts["a"].ping()
    await playing
    assert rig.requests()[:2] == ["a Ping", "a Set"]

    playing = await begin(apply_parts(rig, 8))
    await asyncio.sleep(0.001)
    rig.watch()
    await rig.group.stop()

    with pytest.raises(Preempted):
        await playing
    assert rig.requests()[0] == "a Stop"
    assert "a Set" not in rig.requests()
    assert rig.far["a"].state == "QUICK_STOP_ACTIVE"


@on_wires()
async def test_commit_of_a_set_that_was_given_up_is_not_sent(wire: str) -> None:
    """It waits behind a reading of the line that two amplifiers share."""
    rig = await connect("ab", wire=wire)
    await rig.play(0.5)
    playing = await begin(rig.play(0.3))
    rig.line.outward = late(0.0002, GetStatus=0.02)
    await rig.wait_until_sent("b Set")
    reading = await begin(rig.hosts["a"].read_status())
    await asyncio.sleep(0.005)
    rig.watch()

    rig.group.abort_exchange()

    with pytest.raises(DriverError):
        await playing
    await reading
    await asyncio.sleep(0.01)
    assert rig.requests() == []
    assert rig.levels == {"a": HALF, "b": HALF}


@on_wires("serial")
async def test_set_on_a_line_that_is_busy_for_too_long_is_no_fault(wire: str) -> None:
    """Three statuses without replies take 270 ms; a set that is admitted for 100 ms is refused."""
    rig = await connect("a", "b", wire=wire, watchdog=1.0)
    rig.alter_replies(losing("GetStatus", count=1000))
    readings = [await begin(rig.hosts["b"].read_status()) for _ in range(3)]

    with pytest.raises(CommandRefused) as refusal:
        await rig.play(0.5)

    assert type(refusal.value) is CommandRefused
    assert refusal.value.until is not None
    await asyncio.gather(*readings, return_exceptions=True)
    await asyncio.sleep(0.02)
    assert rig.levels == {"a": SILENT, "b": SILENT}
    assert rig.group.is_armed

    rig.alter_replies(unaltered)
    await rig.hosts["b"].read_status()
    await rig.play(0.5)
    await asyncio.sleep(0.02)
    assert rig.levels == {"a": HALF, "b": HALF}


@on_wires("serial")
async def test_set_with_a_failed_commit_is_incomplete_until_silenced(wire: str) -> None:
    """A port rejects the commit: the other amplifier is silenced before the next set."""
    rig = await connect("a", "b", wire=wire, watchdog=1.0)
    block_writes(rig.lines[1], 2)

    with pytest.raises(DriverError, match="write blocked"):
        await rig.play(0.5)

    assert rig.group.sets.is_incomplete
    await asyncio.sleep(0.02)
    assert rig.levels == {"a": HALF, "b": SILENT}
    await rig.group.silence(0.001)
    await asyncio.sleep(0.002)
    assert rig.levels == {"a": SILENT, "b": SILENT}
    assert not rig.group.sets.is_incomplete


@on_wires()
async def test_refused_commit_may_play_if_an_earlier_attempt_had_no_reply(wire: str) -> None:
    """The reply to a commit is lost and its repetition refused; then one is refused directly."""
    rig = await connect("a", "b", wire=wire)
    refuse(rig.far["a"], "Commit", "WRONG_STATE", after=1)
    rig.alter_replies(losing("Commit"))
    with pytest.raises(CommandRefused) as refusal:
        await rig.play(0.5)
    assert refusal.value.may_play

    await rig.group.clear()
    await rig.group.arm()
    with pytest.raises(CommandRefused) as refusal:
        await rig.play(0.5)
    assert not refusal.value.may_play


@pytest.mark.parametrize("count", [1, 2])
@on_wires()
async def test_set_taken_under_another_token_is_sent_again_once(wire: str, count: int) -> None:
    """One such reply is passed over; two in a row stop the amplifier."""
    rig = await connect("a", wire=wire)
    take = rig.far["a"]._take_part
    wrong_bits = [1] * count

    def take_under_another_token(part: Values, now: float) -> Values:
        wrong_bit = wrong_bits.pop() if wrong_bits else 0
        return {**take(part, now), "token": part["token"] ^ wrong_bit}

    rig.far["a"]._take_part = take_under_another_token

    if count == 1:
        await rig.play(0.5)
    else:
        with pytest.raises(DriverError, match="token"):
            await rig.play(0.5)

    await asyncio.sleep(0.02)
    assert rig.group.is_armed == (count == 1)
    assert rig.levels == {"a": HALF if count == 1 else SILENT}


@pytest.mark.parametrize("lines", ["ab", "a b"])
@on_wires()
async def test_layers_play_together_and_do_not_affect_each_other(wire: str, lines: str) -> None:
    """A second layer adds 0.2; then the first becomes silent simultaneously on both amplifiers."""
    rig = await connect(*lines.split(), wire=wire)
    await rig.play(0.5)
    second = layer(1, tone(0.2, 150.0), tone(0.1, 150.0, channel=1))
    await rig.apply(second)
    await asyncio.sleep(0.01)
    assert rig.levels == {"a": [0.7, 0.1], "b": [0.7, 0.1]}
    assert starts_differ_by(rig, channel=1) < 50e-6

    await rig.apply(layer(0))

    await asyncio.sleep(0.01)
    assert rig.levels == {"a": [0.2, 0.1], "b": [0.2, 0.1]}
    assert rig.retries == 0
    for line in rig.lines:
        assert line.line.wire.counters.unexpected_frames == 0


def start_times(rig: Rig, channel: int = 0) -> dict[str, float]:
    """Return when the only voice of each amplifier on a channel began [s]."""
    starts = {}
    for name in rig.far:
        (voice,) = rig.voices(name, channel)
        starts[name] = voice.began
    return starts


def starts_differ_by(rig: Rig, channel: int = 0) -> float:
    """Return the time between the first and the last start [s]."""
    starts = start_times(rig, channel).values()
    return max(starts) - min(starts)


@pytest.mark.parametrize(("lines", "tolerance"), [("a b", 305e-6), ("ab", 50e-6)])
@on_wires("serial")
async def test_sets_start_together_by_clocks_that_cannot_be_steered(
    wire: str, lines: str, tolerance: float
) -> None:
    """The clock of b is 0.35 s behind, more than the 0.25 s after which its words repeat.

    Two lines start within a step of the word that states the moment, one line simultaneously.
    """
    rig = await connect(*lines.split(), wire=wire, is_armed=False)
    set_unsteered_clock(rig, "a", 7.3)
    set_unsteered_clock(rig, "b", -0.35)
    await rig.group.open()
    await rig.group.arm()

    played = await rig.apply(layer(0, tone(0.5)))

    await asyncio.sleep(0.02)
    assert starts_differ_by(rig) < tolerance
    if len(rig.lines) == 2:
        stated = pytest.approx(played.starts_at, abs=tolerance)
        assert start_times(rig) == {"a": stated, "b": stated}


async def do_nothing(_: Rig) -> None:
    """Let no time pass."""


async def wait_6_ms(_: Rig) -> None:
    """Let more time pass than an admission lasts."""
    await asyncio.sleep(0.006)


async def read_a_status(rig: Rig) -> None:
    """Receive a reply."""
    await rig.hosts["a"].read_status()


@pytest.mark.parametrize(
    ("meanwhile", "checks"), [(do_nothing, 1), (wait_6_ms, 2), (read_a_status, 2)]
)
@on_wires("serial")
async def test_planned_set_is_checked_again_only_after_5_ms_or_a_reply(
    wire: str, meanwhile: Any, checks: int
) -> None:
    """The ledger's answer to the plan is reused when the set is played."""
    rig = await connect("a", wire=wire, watchdog=1.0)
    ledger = rig.hosts["a"].ledger
    ledger.admit = Mock(side_effect=ledger.admit)
    planned = {"a": StagedSet([layer(0, tone(0.5))])}
    assert rig.group.sets.refusal_of(planned) is None
    await meanwhile(rig)

    await rig.group.play(planned)

    assert ledger.admit.call_count == checks


GIVING_WAY = {
    "busy line": ("a", "GetStatus"),
    "busy neighbor": ("a b", "GetStatus"),
    "staged": ("a b", "Set"),
}
"""Lines, and the request whose reply takes 3 ms while a set waits."""


@pytest.mark.parametrize("case", GIVING_WAY)
@on_wires("serial")
async def test_set_gives_way_until_it_is_committed(wire: str, case: str) -> None:
    """The earlier set plays on, and the next one plays without delay."""
    lines, busy_with = GIVING_WAY[case]
    rig = await connect(*lines.split(), wire=wire)
    await rig.play(0.5)
    await asyncio.sleep(0.02)
    rig.watch()
    rig.line.outward = late(0.0002, **{busy_with: 0.003})
    reading = await begin(read_a_status(rig)) if busy_with == "GetStatus" else None
    newer_sets: list[str] = []
    staged = StagedSet([layer(0, tone(0.4))])
    playing = await begin(
        rig.group.play(dict.fromkeys(rig.hosts, staged), lambda: bool(newer_sets))
    )
    await asyncio.sleep(0.001)

    newer_sets.append("next")

    with pytest.raises(Overtaken):
        await playing
    if reading:
        await reading
        assert rig.requests() == ["a GetStatus"]
    else:
        assert [rig.requests(line) for line in (0, 1)] == [["a Set"], ["b Set"]]
    assert rig.levels == dict.fromkeys(rig.hosts, HALF)
    assert rig.group.is_armed
    await rig.play(0.2)
    await asyncio.sleep(0.02)
    assert rig.levels == {name: [0.2, 0.0] for name in rig.hosts}


def play_in_steps(amplifier: SimulatedAmplifier, **steps: int) -> None:
    """Have an amplifier play multiples of steps of level or frequency, and no set exactly."""
    commit = amplifier.playback.commit
    take = amplifier._take_part

    def rounded(command: Command) -> Command:
        values = {}
        for name, step in steps.items():
            values[name] = step * round(getattr(command, name) / step)
        return replace(command, **values)

    def commit_rounded(layers: tuple[LayerSet, ...], token: int, moment: float) -> None:
        rounded_layers = []
        for layer_set in layers:
            commands = tuple(map(rounded, layer_set.commands))
            rounded_layers.append(replace(layer_set, commands=commands))
        commit(tuple(rounded_layers), token, moment)

    amplifier.playback.commit = commit_rounded
    amplifier._take_part = lambda part, now: {**take(part, now), "exact": 0}


async def achieved_tone(rig: Rig, played: PlayedSet) -> Command:
    """Return the first tone of a set as the first amplifier achieves it."""
    (command,) = (await rig.hosts["a"].read_achieved(played.layers["a"][0], played.token)).commands
    return command


@on_wires()
async def test_ledger_counts_the_level_that_was_achieved(wire: str) -> None:
    """In steps of 10 %, 0.58 plays as 0.6: another 0.41 is refused, 0.4 plays."""
    rig = await connect("a", wire=wire, is_armed=False)
    rig.far["a"].capabilities["level_step"] = 1000
    play_in_steps(rig.far["a"], level=1000)
    await rig.group.open()
    await rig.group.arm()

    played = await rig.apply(layer(0, tone(0.58)))

    command = await achieved_tone(rig, played)
    assert command.level == 6000
    with pytest.raises(CommandRefused):
        await rig.apply(layer(1, tone(0.41, 150.0)))
    await rig.apply(layer(1, tone(0.4, 150.0)))


@on_wires("serial")
async def test_rounded_frequency_keeps_its_phase(wire: str) -> None:
    """101.3 Hz in steps of 1.5 Hz is 102 Hz: the next set goes on with the same voice."""
    rig = await connect("a", wire=wire, is_armed=False)
    rig.far["a"].capabilities["frequency_step"] = 30
    play_in_steps(rig.far["a"], frequency=30)
    await rig.group.open()
    await rig.group.arm()

    for level in (0.5, 0.4):
        kept = layer(0, tone(level, 101.3, keep_phase=True), ramp=0.02)
        played = await rig.apply(kept)
        command = await achieved_tone(rig, played)
        assert command.frequency == 2040
        assert first_frequencies(rig) == ([102.0], [102.0])


def first_frequencies(rig: Rig) -> tuple[list[float], list[float]]:
    """Return the frequencies of the first channel of an amplifier, and of its ledger [Hz]."""
    playing = rig.far["a"].playback.all_voices[0]
    expected = rig.hosts["a"].ledger.playback.all_voices[0]
    return [voice.frequency for voice in playing], [voice.frequency for voice in expected]


@pytest.mark.parametrize("reported", [0, 1200])
@on_wires("serial")
async def test_reported_frequency_of_a_tone_at_level_zero_is_ignored(
    wire: str, reported: int
) -> None:
    """A pulse of 170 Hz leads to level 0; the amplifier reports no frequency or 60 Hz for it."""
    rig = await connect("a", wire=wire)
    amplifier = rig.far["a"]
    play_in_steps(amplifier)

    def answer(own: Any) -> Values:
        reply = own()
        for command in reply["commands"]:
            command["frequency"] = reported
        return reply

    intercept(amplifier, "GetAchieved", answer)
    pulse = layer(0, tone(0.0, 170.0, onset=Envelope(100, ((300, 0),))))

    for count in (1, 2):
        played = await rig.apply(pulse)
        assert played.layers["a"][0].commands[0].frequency == 3400
        assert first_frequencies(rig) == ([170.0] * count, [170.0] * count)


@on_wires("serial")
async def test_continuing_layers_do_not_contradict_inexact_sets(wire: str) -> None:
    """A renewed layer and one that waits for an onset show an earlier set, however often."""
    rig = await connect("a", wire=wire)
    await rig.play(0.5)
    onset = Envelope(1000, ((1000, 0),) * 6)
    await rig.apply(layer(1, tone(0.1, 150.0, onset=onset)))
    play_in_steps(rig.far["a"])

    for _ in range(3):
        await rig.apply(layer(0, renew=True))
        await rig.apply(layer(1, tone(0.1, 200.0), after=True))

    assert rig.group.is_armed


@pytest.mark.parametrize("count", [0, 1, 8])
@on_wires()
async def test_amplifier_left_out_for_65536_sets_plays_on_and_takes_the_next(
    wire: str, count: int
) -> None:
    """Its layers continue to the sample; of each 4096 sets to the other amplifier, one is sent."""
    rig = await connect("a", "b", wire=wire)
    layers = [layer(number, tone(0.1)) for number in range(count)] or [layer(0)]
    half = [layer(0, tone(0.5))]
    await rig.group.apply({"a": half, "b": layers})
    await asyncio.sleep(0.02)
    starts = [(voice.began, voice.layer) for voice in rig.voices("b")]
    sets = rig.group.sets

    for _ in range(16):
        sets.token = (sets.token // 4096 + 1) * 4096 % 65536 or 1
        await rig.group.apply({"a": half})
        await rig.group.beat()

    assert [(voice.began, voice.layer) for voice in rig.voices("b")] == starts
    await rig.play(0.2)
    await rig.group.silence(0.0)
    assert rig.levels == {"a": SILENT, "b": SILENT}


async def test_waiting_for_a_line_with_an_unawaited_request_leaves_the_processor_free() -> None:
    """In 30 ms it looks at most every 0.5 ms, although the caller of the request was cancelled."""

    class BusyLine:
        """A line with a request whose caller was cancelled."""

        looks = 0

        @property
        def current(self) -> Any:
            self.looks += 1
            reply = asyncio.get_running_loop().create_future()
            reply.cancel()
            return Mock(result=reply)

    line: Any = BusyLine()

    await joint_sets._wait_until_free([line], until=threads.now() + 0.03)

    assert 2 <= line.looks <= 2 * 60
