"""What a host or an amplifier must not do, each in a conversation written by hand.

Messages are by docs/decisions/0088-protocol-4.md, rules by docs/reference/witness.md.
"""

from typing import Any

import hand_written as hand
from hand_written import HALF, Broken, Talk

LOUD = hand.layer(0, hand.tone(0, 100, 0.5))
ABOVE: dict[str, Any] = {"token": 6, "tokens": (5, 6, 0, 0)}
"""Layers of 0.7 each at one channel."""

BROKEN: Broken = {
    "state_that_is_none": ("garbage", lambda: Talk().armed().says(9)),
    "set_accepted_before_arm": ("enabled", lambda: Talk().identified().staged(5, hand.layer(0))),
    "present_clock_in_place_of_a_mark": (  # 0.15 s are 32.2 million steps
        "clock",
        lambda: Talk().armed().sends(hand.MARK, address=0).rest(0.15).says(clock=32_212_000),
    ),
    "refused_though_staged": (
        "commit",
        lambda: Talk().armed().staged(5, hand.layer(0)).refused(hand.COMMIT, (9, 5, 0), 6),
    ),
    "another_session_feeds": (
        "session",
        lambda: Talk().armed().exchange(hand.PING, (8, 0), hand.status()),
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
        lambda: (
            Talk()
            .armed()
            .says(hand.FAULT, fault=hand.ARC, latch=1)
            .rest(0.03)
            .says(hand.FAULT, fault=hand.ARC, latch=1, high_voltage=True)
        ),
    ),
    "staged_before_all_parts": (
        "commit",
        lambda: (
            Talk()
            .armed()
            .exchange(hand.SET, hand.part(5, LOUD[4:], index=1, parts=2), hand.taken(5))
        ),
    ),
    "missing_though_all_came": (
        "commit",
        lambda: (
            Talk()
            .armed()
            .sends(hand.SET, hand.part(5, LOUD[:4], parts=2))
            .exchange(
                hand.SET,
                hand.part(5, LOUD[4:], index=1, parts=2),
                hand.taken(5, staged=False, exact=False),
            )
        ),
    ),
    "part_replied_to": (
        "credit",
        lambda: (
            Talk()
            .armed()
            .exchange(hand.SET, hand.part(5, LOUD[:4], parts=2), hand.taken(5, staged=False))
        ),
    ),
    "exact_though_not_whole": (
        "plays",
        lambda: (
            Talk()
            .armed()
            .exchange(
                hand.SET,
                hand.part(5, LOUD[4:], index=1, parts=2),
                hand.taken(5, staged=False),
            )
        ),
    ),
    "played_before_its_moment": (
        "silent",
        lambda: (
            Talk()
            .armed()
            .staged(5, LOUD)
            .exchange(hand.COMMIT, (9, 5, 1000), hand.status(token=5))
            .rest(0.1)
            .says(token=5, levels=(5000, 0))
        ),
    ),
    "not_played_at_its_moment": (
        "commit",
        lambda: (
            Talk()
            .armed()
            .staged(5, LOUD)
            .exchange(hand.COMMIT, (9, 5, 100), hand.status(token=5))
            .rest(0.2)
            .says(token=5, tokens=(5, 0, 0, 0))
        ),
    ),
    "played_before_its_commit": (
        "commit",
        lambda: (
            Talk()
            .armed()
            .exchange(
                hand.SET,
                hand.part(5, hand.layer(0)),
                hand.taken(5, staged=False, played=True),
            )
        ),
    ),
    "whole_and_not_staged": (
        "commit",
        lambda: (
            Talk()
            .armed()
            .exchange(
                hand.SET,
                hand.part(5, hand.layer(0)),
                hand.taken(5, staged=False, exact=False),
            )
        ),
    ),
    "broadcast_commit_ignored": (
        "commit",
        lambda: (
            Talk()
            .armed()
            .staged(5, LOUD)
            .sends(hand.COMMIT, (9, 5, 0), address=0)
            .says(kind=hand.GET_STATUS)
        ),
    ),
    "plays_as_before": (
        "commit",
        lambda: (
            Talk()
            .armed()
            .playing()
            .staged(6, hand.layer(0, hand.tone(0, 100, 0.3)))
            .committed(6, levels=(5000, 0), tokens=(6, 0, 0, 0))
            .rest(0.03)
            .says(**HALF | {"token": 6, "tokens": (6, 0, 0, 0)})
        ),
    ),
    "ended_by_itself_too_late": (
        "token",
        lambda: (
            Talk()
            .armed()
            .staged(5, hand.layer(0, hand.tone(0, 100, 0.0005), valid_for=50))
            .committed(5, tokens=(5, 0, 0, 0))
            .rest(0.1)
            .says(token=5, tokens=(5, 0, 0, 0))
        ),
    ),
    "commit_of_a_set_of_long_ago": (
        "token",
        lambda: Talk().armed().staged(5, hand.layer(0)).fed(6).committed(5),
    ),
    "older_set_accepted": (
        "token",
        lambda: (
            Talk()
            .armed()
            .playing()
            .told("faults", "a", are_on=True)  # which excuses the host alone
            .numbered(99)
            .host_bytes(hand.frame(hand.SET, hand.part(4, hand.layer(0)), sequence=99))
            .rest(0.001)
            .replies(hand.SET, hand.taken(4))
        ),
    ),
    "broadcast_stop_ignored": (
        "stop",
        lambda: Talk().armed().sends(hand.STOP, (5,), address=0).says(kind=hand.GET_STATUS),
    ),
    "reply_twice": (
        "credit",
        lambda: Talk().armed().says().replies(hand.PING, hand.status()),
    ),
    "no_reply": ("answer", lambda: Talk().armed().sends(hand.GET_STATUS).rest(0.04)),
    "watchdog_too_early": (
        "watchdog",
        lambda: (
            Talk()
            .armed()
            .rest(0.2)
            .says(hand.FAULT, kind=hand.GET_STATUS, fault=hand.WATCHDOG, latch=1)
        ),
    ),
    "stop_ends_by_itself": (
        "latched",
        lambda: (
            Talk()
            .armed()
            .exchange(hand.STOP, (5,), hand.status(hand.STOPPED, latch=1))
            .rest(0.1)
            .says(hand.SWITCHED_OFF, kind=hand.GET_STATUS, latch=1)
        ),
    ),
    "cleared_by_another_latch": (
        "latched",
        lambda: (
            Talk()
            .armed()
            .exchange(hand.STOP, (5,), hand.status(hand.STOPPED, latch=1))
            .rest(0.1)
            .exchange(hand.CLEAR, (7,), hand.status(hand.SWITCHED_OFF, latch=1))
        ),
    ),
    "armed_in_a_fault": (
        "latched",
        lambda: (
            Talk()
            .armed()
            .says(hand.FAULT, fault=hand.ARC, latch=1)
            .exchange(hand.ARM, (8, 250, 0), hand.status(latch=1))
        ),
    ),
    "without_a_ramp": (
        "ramp",
        lambda: (
            Talk()
            .armed()
            .staged(5, hand.layer(0, hand.tone(0, 100, 0.5), ramp=100))
            .committed(5, levels=(5000, 0), tokens=(5, 0, 0, 0))
        ),
    ),
    "another_frequency_in_achieved": (
        "plays",
        lambda: (
            Talk()
            .armed()
            .playing()
            .exchange(hand.GET_ACHIEVED, (0,), [5, *hand.layer(0, hand.tone(0, 50, 0.5))])
        ),
    ),
    "another_channel_in_achieved": (
        "commit",
        lambda: (
            Talk()
            .armed()
            .playing()
            .exchange(hand.GET_ACHIEVED, (0,), [5, *hand.layer(0, hand.tone(1, 100, 0.5))])
        ),
    ),
    "not_exact_without_a_reason": (
        "plays",
        lambda: Talk().armed().exchange(hand.SET, hand.part(5, LOUD), hand.taken(5, exact=False)),
    ),
    "not_limited_above_full_level": (
        "plays",
        lambda: (
            Talk(level=1.5)
            .armed()
            .playing(level=0.7)
            .staged(6, hand.layer(1, hand.tone(0, 150, 0.7)))
            .exchange(hand.COMMIT, (9, 6, 0), hand.status(levels=(7000, 0), **ABOVE))
            .rest(0.03)
            .says(levels=(10000, 0), **ABOVE)
            .rest(0.11)
            .says(levels=(10000, 0), **ABOVE)
        ),
    ),
    "plays_on_after_silence": (
        "silent",
        lambda: (
            Talk()
            .armed()
            .playing()
            .exchange(hand.SILENCE, (9, 10), hand.status(token=5, levels=(5000, 0)))
            .rest(0.02)
            .says(token=5, levels=(5000, 0))
        ),
    ),
    "fault_not_listed": (
        "faults",
        lambda: (
            Talk()
            .armed()
            .says(hand.FAULT, fault=hand.ARC, latch=1)
            .exchange(hand.GET_FAULTS, (), (0,))
        ),
    ),
    "fault_five_seconds_old": (
        "faults",
        lambda: (
            Talk()
            .armed()
            .says(hand.FAULT, fault=hand.ARC, latch=1)
            .exchange(hand.GET_FAULTS, (), (1, hand.ARC, 255, 0, 5000))
        ),
    ),
    "damaged_frame_carried_out": (
        "damage",
        lambda: (
            Talk()
            .armed()
            .told("faults", "a", are_on=True)
            .numbered(77)
            .host_bytes(hand.frame(hand.PING, (9, 0), sequence=77), flipped=-3)
            .rest(0.001)
            .replies(hand.PING, hand.status())
        ),
    ),
}
"""Conversations by what is wrong, each with the rule that it breaks."""


HOST_VIOLATIONS_BROKEN: Broken = {
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
    "rise_too_steep": ("limits", lambda: Talk(slew=40).armed().playing()),  # 0.5 within 10 ms
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
    "knot_above_the_level": (
        "limits",
        lambda: (
            Talk()
            .armed()
            .staged(5, hand.layer(0, [0 << 4 | 1 << 1, 2000, 5000, 0, 1, 100, 9000, 0]))
        ),
    ),
    "layers_above_the_level_together": (
        "limits",
        lambda: (
            Talk()
            .armed()
            .playing()
            .staged(6, hand.layer(1, hand.tone(0, 150, 0.5)))
            .committed(6, levels=(5000, 0), tokens=(5, 6, 0, 0))
        ),
    ),
    "wrong_checksum": (
        "garbage",
        lambda: Talk().armed().host_bytes(hand.frame(hand.GET_STATUS, sequence=77), flipped=-2),
    ),
    "set_before_arm": (
        "enabled",
        lambda: Talk().identified().rest(0.01).refused(hand.SET, hand.part(5, LOUD), 5),
    ),
    "vibration_without_a_finger": (
        "justified",
        lambda: Talk().armed().told("contacts", [1]).told("contacts", []).rest(0.1).playing(),
    ),
    "another_pattern": ("pattern", lambda: Talk(expected=[(100.0, 0.4, 0.0)]).armed().playing()),
    "plays_on_after_the_last_lift": (
        "lift",
        lambda: Talk().armed().told("contacts", [1]).playing().told("contacts", []).rest(0.05),
    ),
    "ramp_of_100_ms_after_the_last_lift": (
        "lift",
        lambda: (
            Talk()
            .armed()
            .told("contacts", [1])
            .playing()
            .told("contacts", [])
            .exchange(hand.SILENCE, (9, 100), hand.status(**HALF | {"tokens": (0,) * 4}))
        ),
    ),
    "touch_without_a_pattern": (
        "touch",
        lambda: Talk().armed().told("contacts", [1]).rest(0.11),
    ),
    "committed_on_one_of_two": (
        "commit",
        lambda: (
            Talk(names=("m", "n"))
            .armed()
            .armed(address=2)
            .staged(5, LOUD)
            .staged(5, LOUD, address=2)
            .committed(5, tokens=(5, 0, 0, 0))
            .rest(0.03)
        ),
    ),
    "same_token_with_other_contents": (
        "token",
        lambda: Talk().armed().staged(5, hand.layer(0)).staged(5, hand.layer(1)),
    ),
    "status_before_a_stop": (
        "stop",
        lambda: (
            Talk()
            .armed()
            .told("operator_command", "stop")
            .rest(0.007)
            .says(kind=hand.GET_STATUS)
            .exchange(hand.STOP, (5,), hand.status(hand.STOPPED, latch=1))
        ),
    ),
    "stop_not_sent": ("stop", lambda: Talk().armed().told("operator_command", "stop").rest(0.03)),
    "stop_neither_confirmed_nor_repeated": (
        "stop",
        lambda: (
            Talk()
            .armed()
            .playing()
            .exchange(
                hand.STOP, (5,), hand.status(hand.STOPPED, latch=1, levels=(5000, 0), token=5)
            )
            .rest(0.15)
        ),
    ),
    "heartbeat_after_a_stop": (
        "stop",
        lambda: (
            Talk()
            .armed()
            .exchange(hand.STOP, (5,), hand.status(hand.STOPPED, latch=1))
            .rest(0.01)
            .says(hand.STOPPED, latch=1)
        ),
    ),
    "no_heartbeat": (
        "heartbeat",
        lambda: Talk().armed().fed(1).rest(3.1).says(hand.FAULT, fault=hand.WATCHDOG, latch=1),
    ),
    "fed_while_the_loop_stalls": (
        "heartbeat",
        lambda: Talk().armed().told("set_stalled").rest(0.01).says(),
    ),
    "armed_without_a_request": (
        "armed",
        lambda: Talk().told("operator_command", "disarm").rest(0.5).armed(),
    ),
    "armed_without_identification": (
        "identified",
        lambda: Talk().told_of("opened").exchange(hand.ARM, (9, 250, 0), hand.status()),
    ),
    "request_before_a_reply": (
        "credit",
        lambda: (
            Talk(names=("m", "n"))
            .armed()
            .armed(address=2)
            .sends(hand.GET_STATUS)
            .rest(0.005)
            .sends(hand.GET_STATUS, address=2)
            .rest(0.001)
            .replies(hand.GET_STATUS, hand.status(left=241), address=2)
            .numbered(9)  # Hello, GetCaps, GetStatus and Arm of both came before
            .replies(hand.GET_STATUS, hand.status(left=235))
        ),
    ),
}
"""Conversations by what is wrong, each with the rule that it breaks."""
