"""What a host must not do, each in a conversation written by hand.

Messages are by docs/decisions/0061-protocol-3.md, rules by docs/reference/witness.md.
"""

from typing import Any

import hand_written as hand
from hand_written_talk import HALF, Broken, Talk, breaking

BROKEN: Broken = {
    "set_of_520_hz": (
        "limits",
        lambda: Talk().armed().staged(5, hand.layer(0, hand.tone(0, 520, 0.5))),
    ),
    "set_above_the_level": (
        "limits",
        lambda: Talk().armed().staged(5, hand.layer(0, hand.tone(0, 100, 0.81))),
    ),
    "set_for_an_unknown_channel": (
        "limits",
        lambda: Talk().armed().staged(5, hand.layer(0, hand.tone(2, 100, 0.5))),
    ),
    "set_for_an_unknown_layer": (
        "limits",
        lambda: Talk().armed().staged(5, hand.layer(4, hand.tone(0, 100, 0.5))),
    ),
    "rise_too_steep": ("limits", lambda: Talk(slew_per_s=40).armed().playing()),  # 0.5 within 10 ms
    "message_of_an_unknown_type": ("garbage", lambda: Talk().armed().refused(27, (), 1)),
    "set_with_half_a_command": (
        "garbage",
        lambda: Talk().armed().refused(hand.SET, hand.part(5, hand.layer(0, [0, 2000])), 2),
    ),
    "set_of_another_session": (
        "session",
        lambda: Talk().armed().refused(hand.SET, hand.part(5, hand.layer(0), session=8), 10),
    ),
    "older_set_sent": (
        "token",
        lambda: Talk().armed().playing().refused(hand.SET, hand.part(4, hand.layer(0)), 6),
    ),
}
"""Conversations by what is wrong, each with the rule that it breaks; more are below."""
breaks = breaking(BROKEN)


@breaks("limits")
def _knot_above_the_level() -> Talk:
    onset = [0 << 4 | 1 << 1, 2000, 5000, 0, 1, 100, 9000, 0]
    return Talk().armed().staged(5, hand.layer(0, onset))


@breaks("limits")
def _layers_above_the_level_together() -> Talk:
    talk = Talk().armed().playing()
    talk.staged(6, hand.layer(1, hand.tone(0, 150, 0.5)))
    return talk.committed(6, levels=(5000, 0), tokens=(5, 6, 0, 0))


@breaks("limits")
def _channels_above_the_power_together() -> Talk:
    talk = Talk(power=0.4).armed()
    talk.staged(5, hand.layer(0, hand.tone(0, 100, 0.5), hand.tone(1, 100, 0.5)))
    return talk.committed(5, tokens=(5, 0, 0, 0))


@breaks("garbage")
def _wrong_checksum() -> Talk:
    talk = Talk().armed()
    data = hand.frame(hand.GET_STATUS, sequence=77)
    talk.host_bytes(data[:-2] + bytes([data[-2] ^ 1]) + data[-1:])
    return talk


@breaks("enabled")
def _set_before_arm() -> Talk:
    words = hand.part(5, hand.layer(0, hand.tone(0, 100, 0.5)))
    return Talk().identified().rest(0.01).refused(hand.SET, words, 5)


@breaks("justified")
def _vibration_without_a_finger() -> Talk:
    talk = Talk().armed()
    talk.witness.contacts(talk.time, [1])
    talk.witness.contacts(talk.time, [])
    return talk.rest(0.1).playing()


@breaks("pattern")
def _another_pattern() -> Talk:
    talk = Talk().armed()
    talk.witness.expect({"m": {0: [(100.0, 0.4, 0.0)]}})
    return talk.playing()


@breaks("lift")
def _plays_on_after_the_last_lift() -> Talk:
    talk = Talk().armed()
    talk.witness.contacts(talk.time, [1])
    talk.playing()
    talk.witness.contacts(talk.time, [])
    return talk.rest(0.05)


@breaks("lift")
def _ramp_of_100_ms_after_the_last_lift() -> Talk:
    talk = Talk().armed()
    talk.witness.contacts(talk.time, [1])
    talk.playing()
    talk.witness.contacts(talk.time, [])
    return talk.exchange(hand.SILENCE, (9, 100), hand.status(**HALF | {"tokens": (0,) * 4}))


@breaks("touch")
def _touch_without_a_pattern() -> Talk:
    talk = Talk().armed()
    talk.witness.contacts(talk.time, [1])
    return talk.rest(0.11)


@breaks("commit")
def _committed_on_one_of_two() -> Talk:
    talk = Talk(names=("m", "n")).armed().armed(address=2)
    for address in (1, 2):
        talk.staged(5, hand.layer(0, hand.tone(0, 100, 0.5)), address=address)
    return talk.committed(5, tokens=(5, 0, 0, 0)).rest(0.03)


@breaks("token")
def _same_token_with_other_contents() -> Talk:
    talk = Talk().armed().staged(5, hand.layer(0))
    return talk.staged(5, hand.layer(1))


@breaks("stop")
def _status_before_a_stop() -> Talk:
    talk = Talk().armed()
    talk.witness.operator_command(talk.time, "stop")
    talk.rest(0.005).says(kind=hand.GET_STATUS)
    return talk.exchange(hand.STOP, (5,), hand.status(hand.STOPPED, latch=1))


@breaks("stop")
def _stop_not_sent() -> Talk:
    talk = Talk().armed()
    talk.witness.operator_command(talk.time, "stop")
    return talk.rest(0.03)


@breaks("stop")
def _stop_neither_confirmed_nor_repeated() -> Talk:
    talk = Talk().armed().playing()
    playing: dict[str, Any] = {"levels": (5000, 0), "token": 5}
    talk.exchange(hand.STOP, (5,), hand.status(hand.STOPPED, latch=1, **playing))
    return talk.rest(0.15)


@breaks("stop")
def _heartbeat_after_a_stop() -> Talk:
    talk = Talk().armed().exchange(hand.STOP, (5,), hand.status(hand.STOPPED, latch=1))
    return talk.rest(0.01).says(hand.STOPPED, latch=1)


@breaks("heartbeat")
def _no_heartbeat() -> Talk:
    talk = Talk().armed()
    return talk.rest(0.2).says().rest(3.1).says(hand.FAULT, fault=hand.WATCHDOG, latch=1)


@breaks("heartbeat")
def _fed_while_the_loop_stalls() -> Talk:
    talk = Talk().armed()
    talk.witness.set_stalled(talk.time)
    return talk.rest(0.01).says()


@breaks("armed")
def _armed_without_a_request() -> Talk:
    talk = Talk()
    talk.witness.operator_command(0.5, "disarm")
    return talk.armed()


@breaks("identified")
def _armed_without_identification() -> Talk:
    talk = Talk()
    talk.witness.opened("a", talk.time)
    return talk.exchange(hand.ARM, (9, 250), hand.status())


@breaks("credit")
def _request_before_a_reply() -> Talk:
    talk = Talk(names=("m", "n")).armed().armed(address=2)
    talk.sends(hand.GET_STATUS)
    talk.rest(0.005).sends(hand.GET_STATUS, address=2)
    talk.rest(0.001).replies(hand.GET_STATUS, hand.status(left=241), address=2)
    talk.sequence -= 1
    talk.replies(hand.GET_STATUS, hand.status(left=235))
    return talk
