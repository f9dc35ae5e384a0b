"""Rules of the witness: each violation is found; correct traffic and own delays are none."""

import re
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

import hand_written as hand
from era_haptics.lab.witness.capture import read_capture
from era_haptics.lab.witness.witness import Witness
from hand_written import HALF, Talk
from plate_witness import RULES

BROKEN = {**hand.HOST_VIOLATIONS_BROKEN, **hand.BROKEN}
FADING: dict[str, Any] = {**HALF, "tokens": (0, 0, 0, 0)}
PAGE = Path(__file__).parents[4] / "docs" / "reference" / "witness.md"


@pytest.mark.parametrize("name", BROKEN)
def test_witness_finds_a_broken_rule(name: str) -> None:
    """The conversation breaks one rule, and no other."""
    rule, talk = BROKEN[name]
    assert {*talk().found} == {rule}


def test_every_rule_is_found_broken() -> None:
    """Those of the page and those of the plate, by a conversation of its own each."""
    rules = PAGE.read_text(encoding="utf-8").partition("## The rules")[2].partition("## In tests")
    listed = set(re.findall(r"^\| (\w+) \|", rules[0], flags=re.M)) - {"name"}
    assert {rule for rule, _ in BROKEN.values()} == listed | RULES.keys()


def _committed_at(at: int) -> Talk:
    """0.2 on channel 0 plays; a set of 0.5 is committed for a moment, 1 ms after the clock was 0.

    Its high word counts 0.305 ms.
    """
    talk = Talk().armed().playing(4, 0.2).staged(5, hand.layer(0, hand.tone(0, 100, 0.5)))
    before: dict[str, Any] = {"tokens": (4, 0, 0, 0), "levels": (2000, 0)}
    talk.says(clock=0, token=4, **before)
    return talk.exchange(hand.COMMIT, (9, 5, at), hand.status(token=5, **before))


def waited(seconds: float) -> Talk:
    """The fifth request of a host has its reply after it has given it up and sent the sixth."""
    talk = Talk().armed().sends(hand.SET, hand.part(5, hand.layer(0))).rest(seconds)
    talk.sends(hand.GET_STATUS).numbered(5).rest(0.0005).replies(hand.SET, hand.taken(5))
    return talk.numbered(6).replies(hand.GET_STATUS, hand.status())


def tripped(kind: int, latch: int) -> Talk:
    """A request to fall silent and its reply take 4 ms, 250 ms after Arm: the watchdog expires."""
    status = hand.status(hand.FAULT, fault=hand.WATCHDOG, latch=latch)
    return Talk().armed().rest(0.246).sends(kind, (5,)).rest(0.004).replies(kind, status)


def fading(kind: int, latch: int) -> Talk:
    """Arm was not heard either: the reply shows half of the level, amid the fade of 5 ms."""
    talk = Talk().identified(hand.ENABLED)
    talk.exchange(hand.SILENCE, (9, 5), hand.status()).rest(0.02).playing()
    shown: dict[str, Any] = {"fault": hand.WATCHDOG, "latch": latch, "token": 5}
    status = hand.status(hand.REACTING, levels=(2500, 0), **shown)
    return talk.rest(0.2).sends(kind, (5,)).rest(0.0005).replies(kind, status)


def ended(after: float, level: int) -> Talk:
    """A layer ends 60 ms after its commit, whose reply took 12; a silent set came 3 ms later."""
    talk = Talk().armed()
    talk.staged(5, hand.layer(0, hand.tone(0, 100, 0.5), ramp=40, valid_for=60))
    talk.sends(hand.COMMIT, (9, 5, 0)).rest(0.012)
    talk.replies(hand.COMMIT, hand.status(token=5, tokens=(5, 0, 0, 0)))
    talk.rest(0.049).staged(6, hand.layer(0, ramp=40)).committed(6, levels=(4878, 0))
    return talk.rest(after).says(token=6, levels=(level, 0))


def at_new_address(talk: Talk) -> Talk:
    """A status at address 3, which is its own, and another that has no reply."""
    limited = hand.status(hand.SWITCHED_OFF, limited=True)
    talk.exchange(hand.GET_STATUS, (), limited, address=3)
    return talk.sends(hand.GET_STATUS, address=3).rest(0.04)


def at_the_moment(token: int, level: int) -> Talk:
    """A moment comes 30 ms after the clock was 0, amid 27 ms of a status.

    Meanwhile an Event would have the witness know how late it is; here contacts do.
    """
    talk = _committed_at(100).rest(0.007).sends(hand.GET_STATUS).rest(0.026)
    status = hand.status(token=5, tokens=(token, 0, 0, 0), levels=(level, 0))
    return talk.told("contacts", ()).rest(0.001).replies(hand.GET_STATUS, status)


def silenced_at_the_moment(level: int, later: int) -> Talk:
    """Silence is carried out before the moment of a set or behind it; 40 ms later it is over."""
    fading = hand.status(token=5, levels=(level, 0))
    talk = _committed_at(12).exchange(hand.SILENCE, (9, 20), fading)
    return talk.rest(0.04).says(token=5, levels=(later, 0))


STOPPED = hand.status(hand.STOPPED, latch=1)
PLAYING: dict[str, Any] = {"token": 5, "levels": (5000, 0)}
JUST_SO: Mapping[str, tuple[list[str], Callable[[], Talk]]] = {
    # A host gives a request up 30 ms after it wrote it, of which its bytes waited for 2 ms.
    "request that has waited in a transport": ([], lambda: waited(0.028)),
    "request that cannot have waited": (["credit"], lambda: waited(0.018)),
    # Within 11 ms, as the page says; 9 ms after Arm 241 ms are left.
    "all of the watchdog is left": (
        [],
        lambda: Talk().armed().rest(0.008).says(kind=hand.GET_STATUS, left=240),
    ),
    "as little of it as a host allows": (
        [],
        lambda: Talk().armed().rest(0.008).says(kind=hand.GET_STATUS, left=231),
    ),
    "less of it than a host allows": (
        ["watchdog"],
        lambda: Talk().armed().rest(0.008).says(kind=hand.GET_STATUS, left=225),
    ),
    # It is seen 100 ms after its request, of which this program did not run for that long.
    "reply that is late": (
        ["answer"],
        lambda: (
            Talk()
            .armed()
            .sends(hand.GET_STATUS)
            .rest(0.1)
            .replies(hand.GET_STATUS, hand.status(left=199))
        ),
    ),
    "reply that the witness has seen late": (
        [],
        lambda: (
            Talk()
            .armed()
            .sends(hand.GET_STATUS)
            .rest(0.1)
            .told("delayed", 0.1)
            .replies(hand.GET_STATUS, hand.status(left=199))
        ),
    ),
    # The older set, request 7, was accepted before the newer one, as its number shows.
    "reply behind newer ones says nothing of now": (
        [],
        lambda: (
            Talk()
            .armed()
            .playing()
            .told("faults", "a", are_on=True)
            .sends(hand.SET, hand.part(6, hand.layer(0, hand.tone(0, 100, 0.3))))
            .rest(0.04)
            .staged(7, hand.layer(0))
            .committed(7, tokens=(0, 0, 0, 0), levels=(5000, 0))
            .numbered(7)
            .replies(hand.SET, hand.taken(6))
        ),
    ),
    # It may be sooner than what is on its way.
    "watchdog before a stop": ([], lambda: tripped(hand.STOP, 2)),
    "watchdog before a disarm": ([], lambda: tripped(hand.DISARM, 1)),
    "watchdog of unknown time before a stop": ([], lambda: fading(hand.STOP, 2)),
    "watchdog of unknown time before a disarm": ([], lambda: fading(hand.DISARM, 1)),
    # One amplifier plays alone until watchdogs expire, since nothing can be sent.
    "loop that stalls between two commits sends the second no more": (
        [],
        lambda: (
            Talk(names=("m", "n"))
            .armed()
            .armed(address=2)
            .staged(5, hand.LOUD)
            .staged(5, hand.LOUD, address=2)
            .committed(5, tokens=(5, 0, 0, 0))
            .told("set_stalled")
            .rest(0.03)
        ),
    ),
    # 20 ms behind that the fade of 40 ms is 23 ms old: 0.25 (1 + cos(23/40 pi)).
    "layer that may have ended by itself before a set": ([], lambda: ended(0.017, 1917)),
    "layer that has ended": ([], lambda: ended(0.1, 0)),
    "layer that has not ended in time": (["plays"], lambda: ended(0.1, 1917)),
    # Nothing was asked for 0.4 s, in which an arc was sooner than the watchdog of 0.25 s.
    "fault before the watchdog shows afterwards": (
        [],
        lambda: (
            Talk()
            .armed()
            .rest(0.4)
            .says(hand.FAULT, kind=hand.GET_STATUS, fault=hand.ARC, latch=1)
            .exchange(hand.GET_FAULTS, (), (1, hand.ARC, 255, 0, 300))
        ),
    ),
    # An amplifier that was silent under the finger has nothing to end in time.
    "disarm after the last lift releases only what plays": (
        [],
        lambda: (
            Talk()
            .armed()
            .told("contacts", [1])
            .rest(0.01)
            .told("contacts", [])
            .rest(0.01)
            .exchange(hand.DISARM, (100,), hand.status(hand.SWITCHED_ON))
        ),
    ),
    # It was written with it, and on Modbus RTU each frame waits for the silence before it.
    "status behind a broadcast precedes a stop": (
        [],
        lambda: (
            Talk()
            .armed()
            .playing()
            .told("operator_command", "stop")
            .rest(0.005)
            .says(kind=hand.GET_STATUS, left=213, tokens=(5, 0, 0, 0), **PLAYING)
            .exchange(hand.STOP, (5,), hand.status(hand.STOPPED, latch=1, **PLAYING))
        ),
    ),
    # The host had begun to stop by itself, of which its operator's stop takes part.
    "stop is not awaited again while its reply is": (
        [],
        lambda: (
            Talk()
            .armed()
            .playing()
            .sends(hand.STOP, (5,))
            .told("operator_command", "stop")
            .rest(0.028)
            .replies(hand.STOP, hand.status(hand.STOPPED, latch=1, token=5))
        ),
    ),
    "stop is not awaited again 3 ms later": (
        [],
        lambda: (
            Talk()
            .armed()
            .playing()
            .sends(hand.STOP, (5,))
            .rest(0.003)
            .told("operator_command", "stop")
            .rest(0.028)
            .replies(hand.STOP, hand.status(hand.STOPPED, latch=1, token=5))
        ),
    ),
    # A broadcast for another amplifier of the line reaches it too.
    "stop of what a stop has silenced needs no second confirmation": (
        [],
        lambda: (
            Talk()
            .armed()
            .exchange(hand.STOP, (5,), STOPPED)
            .sends(hand.STOP, (5,), address=0)
            .rest(0.3)
        ),
    ),
    # A reply begins within 10 ms, or never: what is sent before may meet it on the line.
    "reading gives way once its reply is due no more": (
        [],
        lambda: Talk().armed().sends(hand.GET_STATUS).rest(0.011).says(),
    ),
    "reading gives way too soon": (
        ["credit"],
        lambda: Talk().armed().sends(hand.GET_STATUS).rest(0.005).says(),
    ),
    # Set for serial number "7" by itself or as a broadcast.
    "amplifier is followed to its new address": (
        ["plays", "answer"],
        lambda: at_new_address(
            Talk()
            .identified()
            .exchange(hand.SET_ADDRESS, (3, 1, 0x3700), hand.status(hand.SWITCHED_OFF))
        ),
    ),
    "amplifier is followed to its new address by a broadcast": (
        ["plays", "answer"],
        lambda: at_new_address(
            Talk().identified().sends(hand.SET_ADDRESS, (3, 1, 0x3700), address=0)
        ),
    ),
    # A status may show either.
    "status before a moment": ([], lambda: at_the_moment(4, 2000)),
    "status after a moment": ([], lambda: at_the_moment(5, 5000)),
    "silence before the moment of a set": ([], lambda: silenced_at_the_moment(2000, 0)),
    "silence after the moment of a set": ([], lambda: silenced_at_the_moment(5000, 0)),
    "silence at the moment of a set that does not last": (
        ["silent"],
        lambda: silenced_at_the_moment(0, 5000),
    ),
    # Its reply may show what played before, unless the moment has passed at its first byte.
    "moment before the exchange of its commit": (["token"], lambda: _committed_at(3)),
    "moment amid the exchange of its commit": ([], lambda: _committed_at(5)),
    "moment behind the exchange of its commit": ([], lambda: _committed_at(6)),
    # A Mark is shown once: a status 0.15 s later, 32.2 million steps, shows the present.
    "status that was not heard may have shown a mark": (
        ["answer"],
        lambda: (
            Talk()
            .armed()
            .sends(hand.MARK, address=0)
            .rest(0.05)
            .sends(hand.GET_STATUS)
            .rest(0.1)
            .says(kind=hand.GET_STATUS, left=98, clock=32_212_000)
        ),
    ),
}
"""Conversations that just keep to the rules, or just not, each with the rules that it breaks."""


@pytest.mark.parametrize("name", JUST_SO)
def test_witness_finds_what_is_broken_and_no_more(name: str) -> None:
    """Beside each other: what hosts and amplifiers may do, and the first that they may not."""
    broken, talk = JUST_SO[name]
    assert talk().found == broken


def refusal(kind: int, code: int) -> bytes:
    """Return the payload of a Nak that names no channel."""
    return struct.pack("<HHH", kind, code, 255)


@pytest.mark.parametrize(
    ("kind", "version", "words", "reply", "payload"),
    [
        (hand.HELLO, 3, (7,), hand.HELLO, hand.identity()),
        (hand.GET_STATUS, 3, (), hand.NAK, refusal(hand.GET_STATUS, 8)),  # UNSUPPORTED_VERSION
        (hand.STOP, hand.VERSION, (), hand.NAK, refusal(hand.STOP, 2)),  # BAD_LENGTH
        (hand.DISARM, hand.VERSION, (5, 0), hand.NAK, refusal(hand.DISARM, 2)),
    ],
)
def test_reply_to_what_no_host_may_send_is_no_fault(
    kind: int, version: int, words: tuple[int, ...], reply: int, payload: bytes
) -> None:
    """Of another version or length: refused as the pages say, but a Hello is replied to."""
    talk = Talk().identified()
    talk.host_bytes(hand.frame(kind, words, sequence=77, version=version)).rest(0.001)
    version = hand.VERSION if version == hand.VERSION else 0
    reply |= hand.REPLY
    talk.amplifier_bytes(hand.raw_frame(reply, payload, sequence=77, version=version))
    assert talk.found == ["garbage"]
    assert "host sent" in str(talk.witness.finish()[0])


def test_arm_may_be_withdrawn_before_its_reply() -> None:
    """It was carried out, so that the set committed last is none."""
    talk = Talk().armed().playing()
    talk.exchange(hand.DISARM, (5,), hand.status(hand.SWITCHED_ON, **FADING)).rest(0.01)
    talk.sends(hand.ARM, (8, 250, 0))
    talk.exchange(hand.DISARM, (5,), hand.status(hand.SWITCHED_ON, token=0))
    assert "token" not in talk.found


@pytest.mark.parametrize(("latch", "broken"), [(0, False), (1, True)])
def test_stop_is_over_where_the_amplifier_has_restarted(latch: int, broken: bool) -> None:
    """It has latched nothing since, and is armed; one that merely unlatched by itself is not."""
    talk = Talk().armed()
    talk.exchange(hand.STOP, (5,), hand.status(hand.STOPPED, latch=1))
    talk.says(hand.SWITCHED_OFF, kind=hand.GET_STATUS, latch=latch)
    talk.exchange(hand.ARM, (10, 250, 0), hand.status(latch=latch))
    assert ("stop" in talk.found) is broken


@pytest.mark.parametrize(
    ("state", "broken"), [(hand.SWITCHED_OFF, []), (hand.STOPPED, ["latched", "stop"])]
)
def test_stop_that_was_not_heard_is_over_for_a_host_that_opens_the_wire_again(
    state: int, broken: list[str]
) -> None:
    """It was lost on a disturbed wire; one that was heard shows, and must be cleared."""
    talk = Talk().armed().told("faults", "a", are_on=True)
    talk.sends(hand.STOP, (5,)).rest(0.3).told("faults", "a", are_on=False)
    talk.told_of("closed").rest(0.6).told_of("opened").identified(state, latch=1)
    talk.exchange(hand.ARM, (10, 250, 0), hand.status(latch=1))
    assert sorted({*talk.found}) == broken


def test_ramp_of_a_stop_is_clipped() -> None:
    """65.535 s are those 1000 ms that an amplifier has: half of the level after half a second."""
    talk = Talk().armed().playing()
    latched: dict[str, Any] = {"latch": 1, "token": 5}
    talk.exchange(hand.STOP, (65535,), hand.status(hand.STOPPED, levels=(5000, 0), **latched))
    talk.rest(0.497).says(hand.STOPPED, kind=hand.GET_STATUS, levels=(2500, 0), **latched)
    talk.rest(0.6).says(hand.STOPPED, kind=hand.GET_STATUS, **latched)
    assert [each for each in talk.found if each != "stop"] == []


@pytest.mark.parametrize(("is_disturbed", "broken"), [(True, set()), (False, {"clock"})])
def test_status_amid_a_fault_may_show_a_mark_that_came_twice(
    is_disturbed: bool, broken: set[str]
) -> None:
    """Its copy comes 40 ms later, so that a status 80 ms behind it shows a clock of 40 ms ago.

    By that every later Mark would be 40 ms late, of which 12 ms and the rate explain 16 at most.
    """
    talk = Talk().armed()
    begin = talk.time
    for copied in (0.04, 0.0, 0.0, 0.0, 0.0):
        talk.rest(0.15).sends(hand.MARK, address=0)
        marked = talk.time - begin
        talk.rest(0.01).says(clock=round(marked / 20 * 2**32))
        if copied and is_disturbed:
            talk.told("faults", "a", are_on=True).told("faults", "a", are_on=False)
        if copied:
            talk.rest(0.068).says(clock=round((marked + copied) / 20 * 2**32))
    assert {*talk.found} == broken


@pytest.mark.parametrize(("beats", "broken"), [(2, ["credit"]), (13, [])])
def test_request_with_the_bytes_of_an_old_one_is_no_copy(beats: int, broken: list[str]) -> None:
    """0.4 s later, on a disturbed wire, it is one, without a reply; 2.6 s later it is new."""
    talk = Talk().armed().says(kind=hand.GET_STATUS)
    number = talk.sequence - 1
    talk.fed(beats - 2).told("faults", "a", are_on=True).told("faults", "a", are_on=False)
    last = talk.fed(2).rest(0.09).sequence
    talk.numbered(number).sends(hand.GET_STATUS).rest(0.009).replies(hand.GET_STATUS, hand.status())
    assert talk.numbered(last).found == broken


def test_clock_goes_on_from_where_an_arm_has_shifted_it() -> None:
    """By 16384 steps, 5 s; the status before it was not heard, so that of Arm may show a Mark."""
    talk = Talk().identified().sends(hand.GET_STATUS).rest(0.1)
    talk.exchange(hand.ARM, (9, 250, 16384), hand.status(clock=round(5.1 / 20 * 2**32)))
    talk.rest(0.1).sends(hand.MARK, address=0)
    talk.rest(0.01).says(clock=round(5.2 / 20 * 2**32))
    assert "clock" not in talk.found


def test_capture_replays_as_it_was_heard(tmp_path: Path) -> None:
    """What was recorded while a rule was broken breaks it again, with the same frames around."""
    talk = Talk().armed().playing().says(token=5, levels=(4000, 0), tokens=(5, 0, 0, 0))
    path = tmp_path / "capture.txt"
    path.write_text("\n".join(talk.capture), encoding="utf-8")
    witness = Witness(talk.config)
    for piece in read_capture(path, wires=witness.wires):
        witness.record_bytes(piece.wire, piece.direction, piece.time, piece.data)
    assert [*map(str, witness.finish())] == [*map(str, talk.witness.finish())]
    assert [one.invariant for one in witness.finish()] == ["plays"]
    assert witness.frames == len(talk.capture)
