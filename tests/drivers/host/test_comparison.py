"""What an amplifier says it plays, compared with what it was sent."""

from dataclasses import asdict, replace

import pytest

from drivers.errors import CommandRefused
from drivers.host.amplifier import read_measured
from drivers.playing import Layer, Tone
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, Envelope, LayerSet, achieved_problem
from sim.amplifier.readings import capabilities
from virtual_lines import KINDS, MemoryLine, group_of, in_virtual_time

SENT = LayerSet(2, 20, 0, (Command(0, 2000, 5000, 17_990), Command(1, 2000, 0, 0)))
CAN = {**capabilities(2), "frequency_step": 3, "level_step": 5, "phase_step": 41}
PLAYED = SENT.commands[0]
SAME = [
    *(PLAYED, replace(PLAYED, frequency=2002), replace(PLAYED, level=4997)),
    replace(PLAYED, phase=-17_989),  # 21 steps beyond 179.9 degrees, across 180
]
OTHER = {
    "frequency": [replace(PLAYED, frequency=2003)],
    "level": [replace(PLAYED, level=4996)],
    "phase": [replace(PLAYED, phase=-17_988)],
    "level of channel 0": [],
    "level of channel 1": [PLAYED, Command(1, 2000, 1, 0)],
    "channels that are not driven": [PLAYED, Command(2, 2000, 1, 0)],
}


def shown(*commands: Command) -> Values:
    """The reply to GetAchieved of a layer with these tones."""
    return {**asdict(SENT), "commands": [asdict(each) for each in commands]}


@pytest.mark.parametrize("played", SAME)
def test_half_a_step_and_what_the_wire_rounds_is_no_contradiction(played: Command) -> None:
    """Half of the steps of the amplifier and of the wire: 2, 3 and 21 steps of the wire."""
    assert achieved_problem(SENT, shown(played), CAN, is_exact=False, slack=0.5) is None


@pytest.mark.parametrize("name", OTHER)
def test_more_than_that_is_one(name: str) -> None:
    """Of frequency, level and phase, and channels that are missing or too many."""
    problem = achieved_problem(SENT, shown(*OTHER[name]), CAN, is_exact=False, slack=0.5)
    assert problem is not None
    assert name in problem[1]


@pytest.mark.parametrize("kind", KINDS)
@in_virtual_time
async def test_ledger_goes_on_with_what_was_achieved(kind: str) -> None:
    """An amplifier of steps of 10 % plays 0.6 for 0.58: 0.41 beside it is refused, 0.4 plays."""
    end = MemoryLine(kind, "a")
    far, (host,) = end.far["a"], end.hosts.values()
    far.capabilities = {**far.capabilities, "level_step": 1000}
    group = await group_of(end)
    commit = far.playback.commit

    def rounded(layers: tuple[LayerSet, ...], token: int, time: float) -> None:
        commands = [
            tuple(replace(each, level=round(each.level, -3)) for each in layer.commands)
            for layer in layers
        ]
        made = [replace(one, commands=each) for one, each in zip(layers, commands, strict=True)]
        commit(made, token, time)

    far.playback.commit = rounded  # type: ignore[method-assign]
    played = await group.apply({"a": [Layer(0, (Tone(0, 100.0, 0.58),), 0.001)]})
    achieved = await host.read_achieved(played.layers["a"][0], played.token)
    assert achieved.commands[0].level == 6000
    with pytest.raises(CommandRefused):
        await group.apply({"a": [Layer(1, (Tone(0, 150.0, 0.41),), 0.001)]})
    await group.apply({"a": [Layer(1, (Tone(0, 150.0, 0.4),), 0.001)]})


@in_virtual_time
async def test_phase_is_kept_of_a_frequency_that_the_amplifier_rounds() -> None:
    """101.3 Hz in steps of 1.5 Hz from 0 on are 102: sent so from then on, the tone goes on."""
    end = MemoryLine("serial", "a")
    far, (host,) = end.far["a"], end.hosts.values()
    far.capabilities = {**far.capabilities, "frequency_step": 30}
    group = await group_of(end)
    commit, take = far.playback.commit, far._take

    def rounded(layers: tuple[LayerSet, ...], token: int, time: float) -> None:
        (one,) = layers
        (only,) = one.commands
        exact = replace(only, frequency=30 * round(only.frequency / 30))
        commit([replace(one, commands=(exact,))], token, time)

    far.playback.commit = rounded  # type: ignore[method-assign]
    far._take = lambda part, now: {**take(part, now), "exact": 0}  # type: ignore[method-assign]
    for level in (0.5, 0.4):
        again = Tone(0, 101.3, level, keep_phase=True)
        played = await group.apply({"a": [Layer(0, (again,), 0.02)]})
        assert played.layers["a"][0].commands[0].frequency == 2040
        for playback in (far.playback, host.ledger.playback):
            assert [voice.frequency for voice in playback.all_voices[0]] == [102.0]


@pytest.mark.parametrize("said", [0, 1200])
@in_virtual_time
async def test_any_frequency_may_be_said_of_a_tone_at_level_0(said: int) -> None:
    """A pulse of 170 Hz leads to level 0, which does not drive: none of its kind plays at 60 Hz."""
    end = MemoryLine("serial", "a")
    far = end.far["a"]
    group = await group_of(end)
    take, handle = far._take, far.handle

    def handled(name: str, values: Values, now: float) -> Values:
        reply = handle(name, values, now)
        if name == "GetAchieved":
            reply["commands"] = [{**each, "frequency": said} for each in reply["commands"]]
        return reply

    far._take = lambda part, now: {**take(part, now), "exact": 0}  # type: ignore[method-assign]
    far.handle = handled  # type: ignore[method-assign]
    pulse = Tone(0, 170.0, 0.0, onset=Envelope(100, ((300, 0),)))
    for _ in range(2):
        played = await group.apply({"a": [Layer(0, (pulse,), 0.001)]})
        assert played.layers["a"][0].commands[0].frequency == 3400
        assert {voice.frequency for voice in far.playback.all_voices[0]} == {170.0}


@in_virtual_time
async def test_layers_that_play_on_are_no_contradiction_where_sets_are_inexact() -> None:
    """Renewed, or still waiting for an onset: they show an earlier set, however often."""
    end = MemoryLine("serial", "a")
    far = end.far["a"]
    group = await group_of(end)
    onset = Envelope(1000, ((1000, 0),) * 9)
    await group.apply({"a": [Layer(0, (Tone(0, 100.0, 0.5),), 0.001)]})
    await group.apply({"a": [Layer(1, (Tone(0, 150.0, 0.1, onset=onset),), 0.001)]})
    take = far._take
    far._take = lambda part, now: {**take(part, now), "exact": 0}  # type: ignore[method-assign]
    for _ in range(3):
        await group.apply({"a": [Layer(0, renew=True)]})
        await group.apply({"a": [Layer(1, (Tone(0, 200.0, 0.1),), 0.001, after=True)]})
    assert group.is_armed


@in_virtual_time
async def test_levels_that_are_measured_have_an_error() -> None:
    """0.002 of full level, a quarter at most: 0.5 measured as 0.498 agrees, as 0.497 does not.

    The tolerance of two steps of 1e-4 comes on top.
    """
    end = MemoryLine("serial", "a")
    far, (host,) = end.far["a"], end.hosts.values()
    far.capabilities = {**far.capabilities, "features": far.capabilities["features"] | 1 << 2}
    group = await group_of(end)
    await group.apply({"a": [Layer(0, (Tone(0, 100.0, 0.5),), 0.001)]})
    status = far.status

    def measured(level: int) -> None:
        far.status = lambda now: {**status(now), "levels": [level, 0]}  # type: ignore[method-assign]

    for level, count in ((4978, 0), (4977, 1)):
        measured(level)
        end.loop.now += 0.02  # type: ignore[attr-defined]
        await host.ping()
        assert host._contradictions == count


@pytest.mark.parametrize("kind", KINDS)
@in_virtual_time
async def test_voltage_and_current_of_each_channel(kind: str) -> None:
    """In volts and amperes; none without the feature."""
    end = MemoryLine(kind, "a")
    far, (host,) = end.far["a"], end.hosts.values()
    values: Values = {
        "count": 2,
        "channels": [
            {"channel_voltage": 12_345, "channel_current": 250},
            {"channel_voltage": 0, "channel_current": 0},
        ],
    }
    handle = far.handle
    far.handle = lambda name, given, now, **options: (  # type: ignore[method-assign]
        values if name == "GetMeasured" else handle(name, given, now, **options)
    )
    await host.open()
    assert await read_measured(host) == [(1234.5, 250e-6), (0.0, 0.0)]
    far.capabilities = {**far.capabilities, "features": 0}
    await host.open()
    assert await read_measured(host) == []
