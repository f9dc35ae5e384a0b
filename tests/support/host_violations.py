"""What a host must not do, each in a conversation written by hand.

Messages are by docs/decisions/0088-protocol-4.md, rules by docs/reference/witness.md.
"""

import hand_written as hand
from hand_written_talk import HALF, Broken, Talk

LOUD = hand.layer(0, hand.tone(0, 100, 0.5))

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
