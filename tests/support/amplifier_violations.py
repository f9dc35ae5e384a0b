"""What an amplifier must not do, each in a conversation written by hand.

Messages are by docs/decisions/0061-protocol-3.md, rules by docs/reference/witness.md.
"""

from typing import Any

import hand_written as hand
from hand_written_talk import HALF, Broken, Talk, breaking

BROKEN: Broken = {
    "state_that_is_none": ("garbage", lambda: Talk().armed().says(9)),
    "set_accepted_before_arm": ("enabled", lambda: Talk().identified().staged(5, hand.layer(0))),
    "refused_though_staged": (
        "commit",
        lambda: Talk().armed().staged(5, hand.layer(0)).refused(hand.COMMIT, (9, 5), 6),
    ),
    "another_session_feeds": (
        "session",
        lambda: Talk().armed().exchange(hand.PING, (8,), hand.status()),
    ),
    "reports_another_set": ("token", lambda: Talk().armed().playing().says(**HALF | {"token": 4})),
    "reports_another_set_of_a_layer": (
        "token",
        lambda: Talk().armed().playing().says(**HALF | {"tokens": (0, 5, 0, 0)}),
    ),
    "stop_refused": ("stop", lambda: Talk().armed().refused(hand.STOP, (5,), 7)),
    "arms_itself": ("armed", lambda: Talk().identified().rest(0.1).says(kind=hand.GET_STATUS)),
    "reply_of_another_set": (
        "credit",
        lambda: Talk().armed().exchange(hand.SET, hand.part(5, hand.layer(0)), hand.taken(4)),
    ),
    "no_watchdog": (
        "watchdog",
        lambda: Talk().armed().rest(0.3).says(kind=hand.GET_STATUS, left=0),
    ),
    "watchdog_left_of_before": (
        "watchdog",
        lambda: Talk().armed().rest(0.05).says(kind=hand.GET_STATUS, left=250),
    ),
    "stop_without_a_latch": (
        "latched",
        lambda: Talk().armed().exchange(hand.STOP, (5,), hand.status(hand.STOPPED)),
    ),
    "latch_that_changes_by_itself": ("latched", lambda: Talk().armed().says(latch=1)),
    "switched_on_by_itself": ("state", lambda: Talk().armed().says(hand.SWITCHED_ON)),
    "fault_without_a_cause": ("state", lambda: Talk().armed().says(hand.FAULT, latch=1)),
    "address_set_while_armed": (
        "state",
        lambda: Talk().armed().exchange(hand.SET_ADDRESS, (2, 1, 0x3700), hand.status()),
    ),
    "another_level": (
        "plays",
        lambda: Talk().armed().playing().says(**HALF | {"levels": (4000, 0)}),
    ),
    "limited_below_full_level": (
        "plays",
        lambda: Talk().armed().playing().says(**HALF, limited=True),
    ),
    "other_capabilities": (
        "constant",
        lambda: Talk().armed().exchange(hand.GET_CAPS, (), hand.capabilities(layers=5)),
    ),
    "high_voltage_in_a_fault": (
        "high_voltage",
        lambda: Talk().armed().says(hand.FAULT, fault=hand.ARC, latch=1, high_voltage=True),
    ),
}
"""Conversations by what is wrong, each with the rule that it breaks; more are below."""
breaks = breaking(BROKEN)


@breaks("commit")
def _staged_before_all_parts() -> Talk:
    stream = hand.layer(0, hand.tone(0, 100, 0.5))
    talk = Talk().armed()
    return talk.exchange(hand.SET, hand.part(5, stream[:4], parts=2), hand.taken(5))


@breaks("commit")
def _played_before_its_commit() -> Talk:
    words = hand.part(5, hand.layer(0))
    return Talk().armed().exchange(hand.SET, words, hand.taken(5, staged=False, played=True))


@breaks("commit")
def _whole_and_not_staged() -> Talk:
    words = hand.part(5, hand.layer(0))
    return Talk().armed().exchange(hand.SET, words, hand.taken(5, staged=False))


@breaks("commit")
def _broadcast_commit_ignored() -> Talk:
    talk = Talk().armed().staged(5, hand.layer(0, hand.tone(0, 100, 0.5)))
    talk.sends(hand.COMMIT, (9, 5), address=0)
    return talk.says(kind=hand.GET_STATUS)


@breaks("commit")
def _plays_as_before() -> Talk:
    talk = Talk().armed().playing().staged(6, hand.layer(0, hand.tone(0, 100, 0.3)))
    talk.committed(6, levels=(5000, 0), tokens=(6, 0, 0, 0)).rest(0.03)
    return talk.says(**HALF | {"token": 6, "tokens": (6, 0, 0, 0)})


@breaks("token")
def _ended_by_itself_too_late() -> Talk:
    talk = Talk().armed()
    talk.staged(5, hand.layer(0, hand.tone(0, 100, 0.0005), valid_for=50))
    return talk.committed(5, tokens=(5, 0, 0, 0)).rest(0.1).says(token=5, tokens=(5, 0, 0, 0))


@breaks("token")
def _commit_of_a_set_of_long_ago() -> Talk:
    talk = Talk().armed().staged(5, hand.layer(0))
    for _ in range(6):
        talk.rest(0.2).says()
    return talk.committed(5)


@breaks("stop")
def _broadcast_stop_ignored() -> Talk:
    talk = Talk().armed()
    talk.sends(hand.STOP, (5,), address=0)
    return talk.says(kind=hand.GET_STATUS)


@breaks("credit")
def _reply_twice() -> Talk:
    talk = Talk().armed().says()
    talk.replies(hand.PING, hand.status())
    return talk


@breaks("answer")
def _no_reply() -> Talk:
    talk = Talk().armed()
    talk.sends(hand.GET_STATUS)
    return talk.rest(0.04)


@breaks("watchdog")
def _watchdog_too_early() -> Talk:
    talk = Talk().armed().rest(0.2)
    return talk.says(hand.FAULT, kind=hand.GET_STATUS, fault=hand.WATCHDOG, latch=1)


@breaks("latched")
def _stop_ends_by_itself() -> Talk:
    talk = Talk().armed().exchange(hand.STOP, (5,), hand.status(hand.STOPPED, latch=1))
    return talk.rest(0.1).says(hand.SWITCHED_OFF, kind=hand.GET_STATUS, latch=1)


@breaks("latched")
def _cleared_by_another_latch() -> Talk:
    talk = Talk().armed().exchange(hand.STOP, (5,), hand.status(hand.STOPPED, latch=1))
    return talk.rest(0.1).exchange(hand.CLEAR, (7,), hand.status(hand.SWITCHED_OFF, latch=1))


@breaks("latched")
def _armed_in_a_fault() -> Talk:
    talk = Talk().armed().says(hand.FAULT, fault=hand.ARC, latch=1)
    return talk.exchange(hand.ARM, (8, 250), hand.status(latch=1))


@breaks("ramp")
def _without_a_ramp() -> Talk:
    talk = Talk().armed().staged(5, hand.layer(0, hand.tone(0, 100, 0.5), ramp=100))
    return talk.committed(5, levels=(5000, 0), tokens=(5, 0, 0, 0))


@breaks("plays")
def _another_frequency_in_achieved() -> Talk:
    reply = [5, *hand.layer(0, hand.tone(0, 50, 0.5))]
    return Talk().armed().playing().exchange(hand.GET_ACHIEVED, (0,), reply)


@breaks("commit")
def _another_channel_in_achieved() -> Talk:
    reply = [5, *hand.layer(0, hand.tone(1, 100, 0.5))]
    return Talk().armed().playing().exchange(hand.GET_ACHIEVED, (0,), reply)


@breaks("plays")
def _not_exact_without_a_reason() -> Talk:
    words = hand.part(5, hand.layer(0, hand.tone(0, 100, 0.5)))
    return Talk().armed().exchange(hand.SET, words, hand.taken(5, exact=False))


@breaks("plays")
def _not_limited_above_full_level() -> Talk:
    talk = Talk(level=1.5).armed().playing(level=0.7)
    talk.staged(6, hand.layer(1, hand.tone(0, 150, 0.7)))
    above: dict[str, Any] = {"token": 6, "tokens": (5, 6, 0, 0)}
    talk.exchange(hand.COMMIT, (9, 6), hand.status(levels=(7000, 0), **above)).rest(0.03)
    return talk.says(levels=(10000, 0), **above)


@breaks("silent")
def _plays_on_after_silence() -> Talk:
    talk = Talk().armed().playing()
    silent: dict[str, Any] = {"token": 5, "levels": (5000, 0)}
    return talk.exchange(hand.SILENCE, (9, 10), hand.status(**silent)).rest(0.02).says(**silent)


@breaks("faults")
def _fault_not_listed() -> Talk:
    talk = Talk().armed().says(hand.FAULT, fault=hand.ARC, latch=1)
    return talk.exchange(hand.GET_FAULTS, (), (0,))


@breaks("faults")
def _fault_five_seconds_old() -> Talk:
    talk = Talk().armed().says(hand.FAULT, fault=hand.ARC, latch=1)
    return talk.exchange(hand.GET_FAULTS, (), (1, hand.ARC, 255, 0, 5000))


@breaks("damage")
def _damaged_frame_carried_out() -> Talk:
    talk = Talk().armed()
    talk.witness.faults(talk.time, "a", are_on=True)
    data = bytearray(hand.frame(hand.PING, (9,), sequence=77))
    data[-3] ^= 1
    talk.host_bytes(bytes(data))
    talk.sequence = 77
    talk.rest(0.001).replies(hand.PING, hand.status())
    return talk


@breaks("token")
def _older_set_accepted() -> Talk:
    talk = Talk().armed().playing()
    talk.witness.faults(talk.time, "a", are_on=True)  # which excuses the host alone
    stale = hand.frame(hand.SET, hand.part(4, hand.layer(0)), sequence=99)
    talk.sequence = 99
    talk.host_bytes(stale)
    talk.rest(0.001).replies(hand.SET, hand.taken(4))
    return talk
