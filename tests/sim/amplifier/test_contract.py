"""The simulated amplifier of protocol 3 against docs/decisions/0061 and arithmetic by hand."""

import math
from itertools import product

import pytest

from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import Command, Envelope, LayerSet, pack_layers, parts
from drivers.protocol.table import FAULTS, MESSAGES, STATES, STATUS_FLAGS
from sim.amplifier.contract import Amplifier

ARM = {"session": 7, "watchdog": 250}
OFF, READY, ON, ENABLED = list(STATES)[1:5]
STOPPED, REACTION, FAULT = list(STATES)[5:]


def armed(*, channels: int = 2) -> Amplifier:
    """An amplifier armed by session 7 at time 0, watchdog 0.25 s."""
    amplifier = Amplifier("a", channels=channels)
    amplifier.handle("Arm", ARM, 0.0)
    return amplifier


def tone(channel: int = 0, frequency: int = 2000, level: int = 5000, **other: object) -> Command:
    """A tone of 100 Hz at half level unless told otherwise."""
    return Command(channel, frequency, level, 0, **other)  # type: ignore[arg-type]


def part_of(token: int, *layers: LayerSet, now: bool = True) -> Values:
    """The only part of a set of session 7."""
    (part,) = parts(pack_layers(layers), session=7, token=token, now=now)
    return part


def play(amplifier: Amplifier, token: int, at: float, *commands: Command, **layer: int) -> Values:
    """Play commands in a layer at once, with a ramp of 20 ms."""
    number = layer.pop("layer", 0)
    one = LayerSet(number, layer.pop("ramp", 20), layer.pop("valid_for", 0), commands)
    return amplifier.handle("Set", part_of(token, one), at)


def levels(amplifier: Amplifier, at: float) -> list[int]:
    """Levels of the status at a time, in 1e-4."""
    return list(amplifier.handle("GetStatus", {}, at)["levels"])


def refused(amplifier: Amplifier, name: str, values: Values, at: float = 0.1) -> str:
    """The code with which a request is refused, which changes nothing of the status."""
    amplifier.tick(at)
    before = amplifier.status(at)
    with pytest.raises(Refusal) as raised:
        amplifier.handle(name, values, at)
    assert amplifier.status(at) == before
    return raised.value.code


def in_state(state: str) -> tuple[Amplifier, float]:
    """An amplifier in a state, and a time at which it is."""
    amplifier = Amplifier("a", channels=1)
    if state == "NOT_READY" or state == READY:
        amplifier.state = state
    elif state != OFF:
        amplifier.handle("Arm", ARM, 0.0)
        play(amplifier, 1, 0.0, tone(), ramp=0)
    if state == ON:
        amplifier.handle("Disarm", {"ramp": 1000}, 0.1)
    elif state == STOPPED:
        amplifier.handle("Stop", {"ramp": 0}, 0.1)
    elif state in (REACTION, FAULT):
        amplifier.trip("ARC", 0.1)
    amplifier.tick(at := 0.2 if state == FAULT else 0.101)
    assert amplifier.state == state
    return amplifier, at


REQUESTS: dict[str, Values] = {
    **{"Arm": {"session": 8, "watchdog": 250}, "Disarm": {"ramp": 5}, "Stop": {"ramp": 5}},
    **{"Commit": {"session": 7, "token": 1}, "Silence": {"session": 7, "ramp": 5}},
    "Set": part_of(2, LayerSet(0, 5, 0)),
    "SetAddress": {"address": 2, "serial_number": "SIM-a"},
}
# From docs/reference: the state that follows each request, by state; "-": refused.
FOLLOWING = {
    "NOT_READY": dict.fromkeys(REQUESTS, "-") | {"Disarm": "NOT_READY", "Stop": "NOT_READY"},
    OFF: dict.fromkeys(REQUESTS, "-")
    | {"Arm": ENABLED, "Disarm": OFF, "Stop": STOPPED, "SetAddress": OFF},
    READY: dict.fromkeys(REQUESTS, "-")
    | {"Arm": ENABLED, "Disarm": READY, "Stop": STOPPED, "SetAddress": READY},
    ON: dict.fromkeys(REQUESTS, "-") | {"Arm": ENABLED, "Disarm": ON, "Stop": STOPPED},
    ENABLED: dict.fromkeys(REQUESTS, ENABLED)
    | {"Arm": "-", "Disarm": ON, "Stop": STOPPED, "SetAddress": "-"},
    **{
        state: dict.fromkeys(REQUESTS, "-") | {"Disarm": state, "Stop": state}
        for state in (STOPPED, REACTION, FAULT)
    },
}


@pytest.mark.parametrize(("state", "name"), list(product(STATES, REQUESTS)))
def test_requests_lead_where_the_state_table_says(state: str, name: str) -> None:
    """Every pair of state and request; a refused one changes nothing."""
    amplifier, at = in_state(state)
    if FOLLOWING[state][name] == "-":
        assert refused(amplifier, name, REQUESTS[name], at) in ("WRONG_STATE", "WRONG_SESSION")
    else:
        amplifier.handle(name, REQUESTS[name], at)
        assert amplifier.state == FOLLOWING[state][name]


def test_watchdog_that_expired_unseen_has_expired_when_it_was_due() -> None:
    """Fed at 0.1 s: at 0.3525 s half of the ramp of 5 ms is over, at 0.355 s it is silent."""
    amplifier = armed()
    play(amplifier, 1, 0.1, tone(), ramp=0)
    assert levels(amplifier, 0.3525) == [2500, 0]
    status = amplifier.handle("GetStatus", {}, 0.3551)
    assert (status["state"], status["fault"]) == (STATES[FAULT], FAULTS["WATCHDOG"])
    assert (status["levels"], status["tokens"], status["latch"]) == ([0, 0], [0] * 8, 1)


def test_feeding_requests_are_those_of_the_table() -> None:
    """Whoever feeds shows the whole watchdog again; refused ones do not feed."""
    asked = {**REQUESTS, "Arm": ARM, "Ping": {"session": 7}, "GetStatus": {}, "GetCaps": {}}
    for name in ("Arm", "Set", "Commit", "Silence", "Ping", "GetStatus", "GetCaps"):
        amplifier = armed()
        play(amplifier, 1, 0.0, tone())
        amplifier.handle(name, asked[name], 0.1)
        assert amplifier.status(0.1)["watchdog_left"] == (250 if MESSAGES[name].feeds else 150)
    amplifier = armed()
    foreign: tuple[tuple[str, Values], ...] = (
        *(("Ping", {"session": 8}), ("Arm", {"session": 8, "watchdog": 100})),
        *(("Commit", {"session": 8, "token": 1}), ("Silence", {"session": 8, "ramp": 0})),
    )
    for name, values in foreign:
        assert refused(amplifier, name, values) == "WRONG_SESSION"


def test_session_that_ended_does_not_arm_again() -> None:
    """A late Arm is refused; another session begins without sets."""
    amplifier = armed()
    play(amplifier, 9, 0.0, tone())
    amplifier.handle("Disarm", {"ramp": 0}, 0.1)
    assert refused(amplifier, "Arm", ARM) == "WRONG_SESSION"
    status = amplifier.handle("Arm", {"session": 8, "watchdog": 100}, 0.2)
    assert (status["token"], status["levels"], status["watchdog_left"]) == (0, [0, 0], 100)


def test_repeated_arm_restarts_the_watchdog_with_its_time() -> None:
    """What plays goes on."""
    amplifier = armed()
    play(amplifier, 1, 0.0, tone(), ramp=0)
    status = amplifier.handle("Arm", {"session": 7, "watchdog": 500}, 0.1)
    assert (status["watchdog_left"], status["levels"], status["token"]) == (500, [5000, 0], 1)


def test_clear_acknowledges_the_stop_that_it_names() -> None:
    """Each stop has the next number, also amid one; an older number clears nothing."""
    amplifier = armed()
    play(amplifier, 1, 0.0, tone(), ramp=0)
    assert amplifier.handle("Stop", {"ramp": 0}, 0.1)["latch"] == 1
    assert amplifier.handle("Stop", {"ramp": 0}, 0.1)["latch"] == 2
    assert refused(amplifier, "Clear", {"latch": 1}) == "WRONG_LATCH"
    assert amplifier.handle("Clear", {"latch": 2}, 0.1)["state"] == STATES[OFF]


def test_clear_waits_for_silence() -> None:
    """Amid the stop's ramp of 100 ms it changes nothing."""
    amplifier = armed()
    play(amplifier, 1, 0.0, tone(), ramp=0)
    amplifier.handle("Stop", {"ramp": 100}, 0.1)
    assert amplifier.handle("Clear", {"latch": 1}, 0.15)["state"] == STATES[STOPPED]
    assert amplifier.handle("Clear", {"latch": 1}, 0.21)["state"] == STATES[OFF]


BAD_SETS: dict[str, tuple[LayerSet, str, int | None]] = {
    "layer": (LayerSet(8, 5, 0, (tone(),)), "BAD_VALUE", None),
    "channel": (LayerSet(0, 5, 0, (tone(2),)), "BAD_CHANNEL", 2),
    "channel twice": (LayerSet(0, 5, 0, (tone(1), tone(1))), "BAD_CHANNEL", 1),
    "below the lowest frequency": (LayerSet(0, 5, 0, (tone(0, 199),)), "BAD_VALUE", 0),
    "above the channel's frequency": (LayerSet(0, 5, 0, (tone(1, 6001),)), "BAD_VALUE", 1),
    "above the channel's level": (LayerSet(0, 5, 0, (tone(1, 2000, 8001),)), "BAD_VALUE", 1),
    "knot above the channel's level": (
        *(LayerSet(0, 5, 0, (tone(1, onset=Envelope(50, ((8001, 0),))),)), "BAD_VALUE", 1),
    ),
    "ending too fast": (
        *(LayerSet(0, 5, 0, (tone(ending=Envelope(9, ((1, 0),))),)), "BAD_VALUE", 0),
    ),
}


@pytest.mark.parametrize("bad", BAD_SETS)
def test_set_is_refused_as_a_whole(bad: str) -> None:
    """One bad layer of two refuses both, with the channel; what plays and is staged stays."""
    amplifier = Amplifier("a", channels=2)
    amplifier.capabilities["limits"][1].update(frequency_max=6000, level_max=8000)
    amplifier.handle("Arm", ARM, 0.0)
    play(amplifier, 1, 0.0, tone(), ramp=0)
    layer, code, channel = BAD_SETS[bad]
    part = part_of(2, LayerSet(3, 5, 0, (tone(1, 3000),)), layer)
    with pytest.raises(Refusal) as raised:
        amplifier.handle("Set", part, 0.1)
    assert (raised.value.code, raised.value.channel) == (code, channel)
    assert amplifier.status(0.1)["tokens"] == [1] + [0] * 7


def test_silence_may_have_any_frequency() -> None:
    """A command of level 0 is checked for no frequency."""
    amplifier = armed()
    assert play(amplifier, 1, 0.0, tone(0, 0, 0))["played"]


def test_set_is_staged_in_parts_and_committed_once() -> None:
    """In any order; the commit of an incomplete one is refused, a repeated one is confirmed."""
    amplifier = armed()
    knots = tuple((level, 0) for level in range(0, 3200, 100))
    layers = [LayerSet(n, 5, 0, (tone(0, onset=Envelope(50, knots)),)) for n in range(3)]
    cut = list(parts(pack_layers(layers), session=7, token=5, now=False))
    assert len(cut) > 1
    taken = [amplifier.handle("Set", part, 0.05) for part in reversed(cut)]
    assert [(each["staged"], each["missing"]) for each in (taken[0], taken[-1])] == [
        *((False, 0), (True, 0)),
    ]
    assert amplifier.handle("Set", cut[0], 0.06)["staged"]  # came again
    assert refused(amplifier, "Commit", {"session": 7, "token": 6}) == "BAD_TOKEN"
    status = amplifier.handle("Commit", {"session": 7, "token": 5}, 0.1)
    assert status["tokens"][:4] == [5, 5, 5, 0]
    amplifier.handle("Commit", {"session": 7, "token": 5}, 0.2)
    assert {voice.origin for voice in amplifier.playback.voices_of(0)} == {0.1}
    amplifier.handle("Set", {**cut[0], "token": 6}, 0.2)
    assert refused(amplifier, "Commit", {"session": 7, "token": 6}, 0.2) == "INCOMPLETE"


def test_late_copy_of_an_older_set_discards_no_staged_one() -> None:
    """Set 10 is staged, a copy of 9 comes late: refused, and 10 plays."""
    amplifier = armed()
    for token in (9, 10):
        one = LayerSet(0, 0, 0, (tone(0, 2000, 1000 * token),))
        assert amplifier.handle("Set", part_of(token, one, now=False), 0.05)["staged"]
    late = part_of(9, LayerSet(0, 0, 0), now=False)
    assert refused(amplifier, "Set", late) == "BAD_TOKEN"
    assert amplifier.handle("Commit", {"session": 7, "token": 10}, 0.1)["levels"] == [10000, 0]


def test_staged_set_expires_a_second_after_its_first_part() -> None:
    """At 1.01 s its commit is refused."""
    for late, at in ((False, 0.99), (True, 1.01)):
        amplifier = Amplifier("a", channels=1)
        amplifier.handle("Arm", {"session": 7, "watchdog": 2000}, 0.0)
        amplifier.handle("Set", part_of(1, LayerSet(0, 5, 0, (tone(),)), now=False), 0.0)
        commit = {"session": 7, "token": 1}
        if late:
            assert refused(amplifier, "Commit", commit, at) == "BAD_TOKEN"
        else:
            assert amplifier.handle("Commit", commit, at)["tokens"][0] == 1


@pytest.mark.parametrize(("token", "is_played"), [(1, True), (32766, True), (32767, False)])
def test_token_is_newer_by_less_than_half_the_circle(token: int, is_played: bool) -> None:
    """After 65535, as RFC 1982 has it; an older one is a late copy."""
    amplifier = armed()
    play(amplifier, 65535, 0.0, tone())
    if is_played:
        assert play(amplifier, token, 0.1, tone())["played"]
    else:
        late = part_of(token, LayerSet(0, 5, 0))
        assert refused(amplifier, "Set", late) == "BAD_TOKEN"


def test_layers_add_and_are_silenced_alone_or_together() -> None:
    """Two layers of 0.5 and 0.3 add up to 0.8; silence takes both and drops what is staged."""
    amplifier = armed()
    play(amplifier, 1, 0.0, tone(), ramp=0)
    play(amplifier, 2, 0.0, tone(0, 3000, 3000), layer=1, ramp=0)
    assert levels(amplifier, 0.05) == [8000, 0]
    play(amplifier, 3, 0.06, layer=0, ramp=0)
    assert (levels(amplifier, 0.06), amplifier.status(0.06)["tokens"][:2]) == ([3000, 0], [0, 2])
    amplifier.handle("Set", part_of(4, LayerSet(2, 5, 0, (tone(),)), now=False), 0.07)
    status = amplifier.handle("Silence", {"session": 7, "ramp": 10}, 0.08)
    assert status["state"] == STATES[ENABLED]
    assert (levels(amplifier, 0.085), levels(amplifier, 0.0901)) == ([1500, 0], [0, 0])
    assert refused(amplifier, "Commit", {"session": 7, "token": 4}) == "BAD_TOKEN"


def test_sum_above_full_level_is_said_once() -> None:
    """0.7 and 0.7 in two layers; a cross-fade at full level stays at full level."""
    amplifier = armed()
    limited = 1 << STATUS_FLAGS["limited"]
    play(amplifier, 1, 0.0, tone(0, 2000, 10000), ramp=0)
    play(amplifier, 2, 0.0, tone(0, 3000, 10000), ramp=20)
    assert not amplifier.handle("GetStatus", {}, 0.01)["flags"] & limited
    play(amplifier, 3, 0.05, tone(0, 2000, 1000), layer=1)
    status = amplifier.handle("GetStatus", {}, 0.1)
    assert (status["flags"] & limited, status["levels"][0]) == (limited, 10000)
    assert not amplifier.handle("GetStatus", {}, 0.1)["flags"] & limited


def test_set_ends_after_valid_for_unless_renewed() -> None:
    """100 ms, prolonged once at 90 ms: half of its ramp of 20 ms at 200 ms, then silent."""
    amplifier = armed()
    play(amplifier, 1, 0.0, tone(), ramp=20, valid_for=100)
    renewal = LayerSet(0, 0, 100, renew=True)
    amplifier.handle("Set", part_of(2, renewal), 0.09)
    assert levels(amplifier, 0.2) == [2500, 0]
    assert amplifier.handle("GetStatus", {}, 0.211)["tokens"][0] == 0


def test_achieved_tells_what_a_layer_plays() -> None:
    """The waiting set of a layer is not yet what it plays; a silent layer has no commands."""
    amplifier = armed()
    onset = Envelope(1000, ((5000, 0),))
    play(amplifier, 1, 0.0, tone(1, 2000, 4000, onset=onset), layer=2, valid_for=5000)
    waiting = LayerSet(2, 20, 0, (tone(0, 3000),), after=True)
    amplifier.handle("Set", part_of(2, waiting), 0.01)
    achieved = amplifier.handle("GetAchieved", {"layer": 2}, 0.02)
    assert (achieved["token"], achieved["valid_for"]) == (1, 5000)
    assert achieved["commands"] == [{"channel": 1, "frequency": 2000, "level": 4000, "phase": 0}]
    amplifier.tick(0.21)
    achieved = amplifier.handle("GetAchieved", {"layer": 2}, 0.21)
    assert (achieved["token"], [each["channel"] for each in achieved["commands"]]) == (2, [0])
    assert amplifier.handle("GetAchieved", {"layer": 3}, 0.21)["commands"] == []


def test_heat_derates_and_then_trips() -> None:
    """Above 70 °C half of every level, told as inexact; above 85 °C a fault until cool."""
    amplifier = armed()
    play(amplifier, 1, 0.0, tone(), ramp=0)
    amplifier.set_temperature(71.0, 0.1)
    assert levels(amplifier, 0.13) == [2500, 0]
    taken = play(amplifier, 2, 0.13, tone(1, 2000, 8000), layer=1, ramp=0)
    assert (taken["exact"], levels(amplifier, 0.14)) == (False, [2500, 4000])
    amplifier.set_temperature(86.0, 0.2)
    assert amplifier.handle("GetStatus", {}, 0.21)["fault"] == FAULTS["OVER_TEMPERATURE"]
    assert amplifier.handle("Clear", {"latch": 1}, 0.22)["state"] == STATES[FAULT]
    amplifier.set_temperature(60.0, 0.3)
    assert amplifier.handle("Clear", {"latch": 1}, 0.31)["state"] == STATES[OFF]


def test_temperature_follows_the_mean_square_level() -> None:
    """Half level on both channels: a quarter of 30 K, 1 - 1/e of it after 120 s."""
    amplifier = Amplifier("a", channels=2)
    amplifier.handle("Arm", {"session": 7, "watchdog": 2000}, 0.0)
    play(amplifier, 1, 0.0, tone(0), tone(1), ramp=0)
    for second in range(1, 121):
        status = amplifier.handle("Ping", {"session": 7}, float(second))
    assert status["temperature"] == pytest.approx(250 + 75 * (1 - 1 / math.e), abs=1)


def test_interlock_trips_and_keeps_disarmed() -> None:
    """Neither cleared nor armed until it is closed; the event names state, fault and latch."""
    amplifier, events = armed(), []
    amplifier.listeners.append(lambda event, at: events.append((event["state"], event["latch"])))
    amplifier.set_interlock(0.1, is_open=True)
    amplifier.tick(0.2)
    assert events == [(STATES[REACTION], 1), (STATES[FAULT], 1)]
    assert amplifier.handle("Clear", {"latch": 1}, 0.2)["state"] == STATES[FAULT]
    amplifier.set_interlock(0.3, is_open=False)
    amplifier.handle("Clear", {"latch": 1}, 0.3)
    assert amplifier.handle("Arm", {"session": 8, "watchdog": 250}, 0.3)["state"] == STATES[ENABLED]


def test_restart_forgets_all_but_its_faults() -> None:
    """Silent at once and disarmed, the next token may be any."""
    amplifier = armed()
    play(amplifier, 9, 0.0, tone())
    amplifier.trip("ARC", 0.1, channel=1)
    amplifier.restart(0.2)
    status = amplifier.handle("GetStatus", {}, 0.2)
    assert (status["state"], status["token"], status["levels"]) == (STATES[OFF], 0, [0, 0])
    faults = amplifier.handle("GetFaults", {}, 0.3)["faults"]
    assert faults == [{"fault": FAULTS["ARC"], "channel": 1, "age": 200}]


def test_high_voltage_is_on_while_armed_and_discharges() -> None:
    """1800 V; 1800/e after 20 ms without it, a current of 2 pi f/2 C U in a capacitor of 1 nF."""
    amplifier = armed()
    play(amplifier, 1, 0.0, tone(0, 2000, 10000), ramp=0)
    measured = amplifier.handle("GetMeasured", {}, 0.01)["channels"][0]
    voltage = 1800 / math.sqrt(2)
    assert measured["channel_voltage"] == pytest.approx(10 * voltage, abs=1)
    assert measured["channel_current"] == pytest.approx(math.pi * 100 * voltage * 1e-3, abs=1)
    amplifier.handle("Disarm", {"ramp": 0}, 0.1)
    assert amplifier.handle("GetStatus", {}, 0.12)["voltage"] == round(1800 / math.e)


@pytest.mark.parametrize("seed", range(3))
def test_status_and_replies_are_what_the_wire_carries(seed: int) -> None:
    """Every reply packs into at most 120 words and reads back the same."""
    amplifier = armed(channels=16)
    play(amplifier, 1, 0.0, *(tone(channel) for channel in range(16)), layer=seed)
    for name, values in (
        *(("GetStatus", {}), ("GetCaps", {}), ("GetFaults", {}), ("GetMeasured", {})),
        ("GetAchieved", {"layer": seed}),
    ):
        reply, record = amplifier.handle(name, values, 0.1), MESSAGES[name].reply
        words = record.pack(reply)
        assert len(words) <= 120
        assert record.pack(record.unpack(words, is_strict=True)) == words
