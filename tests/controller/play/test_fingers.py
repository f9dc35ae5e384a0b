"""Fingers that join, leave and slide on a layout, and what each feels over the wire.

All hosts are judged by the rules for hosts, and contents at the fingertips of the simulated plate.
"""

import asyncio
from collections.abc import Mapping
from itertools import pairwise

import pytest

from kit.chain import Position
from kit.clock import in_virtual_time
from tests.controller.play.fingers_on_layouts import (
    ABOVE,
    LEFT,
    RIGHT,
    hands,
    has_no_thread,
    lasting_contents,
    sensations,
    worst_promise,
)

TWO_FINGERS = {1: LEFT, 2: RIGHT}
THREE_FINGERS = {1: LEFT, 2: RIGHT, 3: ABOVE}
RIGHT_MOVED = (0.244, 0.049)
NEIGHBORS = {1: (0.138, 0.06), 2: (0.165, 0.06)}
"""Two fingers close together, of different regions."""


@in_virtual_time
async def test_two_fingers_each_feel_their_own_content_as_promised() -> None:
    """The contrasts at the fingertips are within 1 dB of the answer for the nominal plate."""
    async with hands(TWO_FINGERS, held=1.0) as fingers:
        assert len(fingers.applied) == 1
        assert fingers.status("verdict") == {1: "own", 2: "own"}
        assert fingers.spacing >= 30
        nominal = {
            content.key.finger.id: content.sensations[0].contrast_db or 0.0
            for content in fingers.contents
        }
        assert fingers.contrasts() == pytest.approx(nominal, abs=1.0)


@in_virtual_time
async def test_third_finger_joins_and_all_are_weighted_again_in_one_commit() -> None:
    """Each finger keeps its layer and its frequency; a better answer follows later."""
    async with hands(TWO_FINGERS, held=0.5) as fingers:
        assert fingers.layers == {1: [0], 2: [1]}
        fingers.mark()
        fingers.at[3] = ABOVE
        await fingers.hold(0.09)

        assert fingers.changes == [[0, 1, 2]]
        assert fingers.continued == {0: {True}, 1: {True}, 2: {False}}
        assert fingers.layers == {1: [0], 2: [1], 3: [2]}
        assert fingers.kept_frequencies
        assert fingers.status("held_back") == {1: None, 2: None, 3: None}


@in_virtual_time
async def test_one_finger_leaves_and_the_layer_of_the_other_is_not_touched() -> None:
    """One set ends its layer; the other layer is renewed alone, and a Silence ends everything."""
    async with hands(TWO_FINGERS, held=0.6) as fingers:
        assert fingers.layers == {1: [0], 2: [1]}
        former = lasting_contents(fingers.applied[-1])
        fingers.mark()
        del fingers.at[1]
        await fingers.hold(0.5)
        assert fingers.changes == [[0]]
        assert fingers.driven == {0: False}
        assert fingers.layers == {2: [1]}
        assert lasting_contents(fingers.applied[-1]) == {2: former[2]}

        fingers.mark()
        await fingers.hold(3.0)
        renewed = {number for commit in fingers.new_commits for number in commit.numbers}
        assert renewed == {1}
        assert fingers.contrasts() == {}  # without crosstalk there is none

        fingers.mark()
        fingers.at.clear()
        await fingers.hold(0.1)
        assert fingers.changes == [[]]


@in_virtual_time
async def test_slide_keeps_its_frequencies_until_the_finger_rests() -> None:
    """Other frequencies promise 2 dB more on its way; it is led to them once it rests, in steps."""
    async with hands({1: (0.034, 0.089), 2: RIGHT}, held=2.0) as fingers:
        fingers.mark()
        await fingers.slide(0.4, 0.0576, -0.0436, 1)
        assert len(fingers.new_reports) >= 5
        assert fingers.kept_frequencies

        promise_of_the_slide = worst_promise(fingers.applied[-1])
        fingers.mark()
        await fingers.hold(1.5)
        assert 0.05 <= fingers.new_reports[0].time - fingers.marked_at <= 0.2
        assert not fingers.kept_frequencies
        assert worst_promise(fingers.applied[-1]) - promise_of_the_slide >= 2


@pytest.mark.parametrize(("speed", "report_count"), [(0.2, 1), (0.04, 0)])
@in_virtual_time
async def test_finger_that_sets_out_is_answered_before_it_has_gone_8_mm(
    speed: float, report_count: int
) -> None:
    """At 0.2 m/s its slope over 60 ms is 3 mm after 20 ms; at 40 mm/s it rests."""
    async with hands(TWO_FINGERS, held=1.5) as fingers:
        fingers.mark()
        await fingers.slide(0.035, -speed * 0.035, 0.0, 1)
        assert len(fingers.new_reports) == report_count


@in_virtual_time
async def test_weights_are_led_within_their_layers_after_a_leave() -> None:
    """The other two fingers keep frequency, phase and layer, along 300 ms."""
    positions = {1: (0.206, 0.015), 2: (0.151, 0.098), 3: (0.07, 0.077)}
    async with hands(positions, layout="one region", held=1.5) as fingers:
        fingers.mark()
        del fingers.at[3]
        await fingers.hold(0.09)
        assert fingers.kept_frequencies

        former_promise = worst_promise(fingers.applied[-1])
        fingers.mark()
        await fingers.hold(1.1)
        assert fingers.kept_frequencies
        assert set.union(*fingers.continued.values()) == {True}
        assert worst_promise(fingers.applied[-1]) - former_promise >= 0.5


@in_virtual_time
async def test_arming_again_forgets_no_active_layer() -> None:
    """A finger that lifts just then falls silent, and the other content continues."""
    async with hands(TWO_FINGERS, held=0.6) as fingers:
        assert fingers.layers == {1: [0], 2: [1]}
        fingers.mark()
        await fingers.controller.arm()
        del fingers.at[2]
        await fingers.hold(0.1)
        assert fingers.driven == {0: True, 1: False}


@in_virtual_time
async def test_twenty_fingers_of_a_region_feel_its_effect() -> None:
    """They share one layer of eight; the twenty-first finger is rejected and counted."""
    async with hands(layout="one region") as fingers:
        fingers.spread(20)
        await fingers.hold(0.4)
        assert len(fingers.contents) == 1
        assert fingers.status("feels") == dict.fromkeys(range(1, 21), "buzz")
        assert min(fingers.levels_db_sl().values()) > 5

        fingers.must_be_felt = False
        fingers.at[21] = (0.15, 0.21)
        await fingers.hold(0.1)
        cycle = fingers.controller.cycle
        assert len(cycle.tracker.contacts) == 20
        assert cycle.rejects.counts.keys() == {"too_many"}


@in_virtual_time
async def test_nothing_plays_that_a_protected_finger_would_notice() -> None:
    """Both contents are silent while it rests, with a reason, and play once it has lifted.

    16 dB SL would need 26 dB of contrast there; four ERAs promise less than 20.
    """
    async with hands(
        THREE_FINGERS, layout="above is protected", held=0.6, breaks="touch"
    ) as fingers:
        assert fingers.levels_db_sl()[3] < -10
        assert fingers.status("verdict") == {1: "held back", 2: "held back", 3: None}
        reasons = fingers.status("held_back")
        assert "protected" in reasons[1]
        assert "protected" in reasons[2]

        await fingers.hold(1.5)
        del fingers.at[3]
        await fingers.hold(1.0)
        assert fingers.held_back == {1: None, 2: None}
        assert fingers.levels_db_sl()[1] > 14

        fingers.at[3] = ABOVE
        await fingers.hold(1.0)
        assert fingers.levels_db_sl()[3] < -10


@pytest.mark.parametrize(
    ("content", "report_count"), [("weak", 1), ("strong", 0), ("click", 0)], ids=str
)
@in_virtual_time
async def test_content_plays_near_a_protected_finger_only_below_its_threshold(
    content: str, report_count: int
) -> None:
    """At most -10 dB SL may reach that finger, of a click over its duration."""
    layout = f"{content} beside what is protected"
    async with hands({3: ABOVE}, layout=layout, held=0.2, breaks="touch") as fingers:
        fingers.at[1] = LEFT
        await fingers.hold(1.0)
        assert len(fingers.applied) == report_count
        level = fingers.levels_db_sl()[3]
        assert level < -10
        for report in fingers.applied[-1:]:
            promised = {key.id: levels[0] for key, levels in report.quiet_levels.items()}
            assert level < promised[3]


@pytest.mark.parametrize(
    ("layout", "verdicts"),
    [
        ("above comes first", {"mixed", "own"}),
        ("above wants its own", {"held back", "own"}),
    ],
)
@in_virtual_time
async def test_three_fingers_on_four_actuators(layout: str, verdicts: set[str]) -> None:
    """One of three is mixed; if it requires its own content, another finger gives way."""
    async with hands(THREE_FINGERS, layout=layout, held=1.0) as fingers:
        statuses = fingers.status("verdict")
        assert {*statuses.values()} == verdicts
        if layout == "above wants its own":
            assert statuses[3] == "own"
            assert fingers.levels_db_sl()[3] > 12


@in_virtual_time
async def test_fingers_that_may_share_state_whose_content_they_feel() -> None:
    """Two near fingers of different effects feel the vibration of the higher priority."""
    async with hands(NEIGHBORS, layout="shared", held=1.0) as fingers:
        assert fingers.status("verdict") == {1: "shared", 2: "own"}
        assert fingers.status("effect") == {1: "low", 2: "high"}
        assert fingers.status("feels") == {1: "high", 2: "high"}
        assert len(fingers.contents) == 1


@in_virtual_time
async def test_shared_content_continues_through_a_click_of_its_finger() -> None:
    """The click has a layer of its own, and each finger's verdict is reported once per change."""
    async with hands(NEIGHBORS, layout="shared", held=1.0) as fingers:
        assert fingers.layers == {2: [0]}
        former = lasting_contents(fingers.applied[-1])
        fingers.mark()
        fingers.play("tick", 2)
        await fingers.hold(0.3)

        assert fingers.changes == [[1], [1]]
        assert lasting_contents(fingers.applied[-1]) == former
        verdicts = [
            {id: felt.sensation.verdict for id, felt in sensations(report).items()}
            for report in fingers.new_reports
        ]
        assert verdicts == [{1: "shared", 2: "mixed"}, {1: "shared", 2: "own"}]


@in_virtual_time
async def test_refused_click_leaves_a_shared_content() -> None:
    """Only the click is left out of the set."""
    async with hands(NEIGHBORS, layout="shared", held=1.0) as fingers:
        former = lasting_contents(fingers.applied[-1])
        fingers.mark()
        fingers.refuse_layers("too much power", 1)
        fingers.play("tick", 2)
        await fingers.hold(0.1)
        assert lasting_contents(fingers.applied[-1]) == former
        assert fingers.driven == {}
        assert fingers.silenced == []
        assert len(fingers.contents) == 1


@in_virtual_time
async def test_unserved_fingers_have_a_reason() -> None:
    """Of six fingers the four newest have the four layers; the plate cannot serve all of these."""
    positions = {
        1: (0.03, 0.17),
        2: (0.08, 0.05),
        3: (0.13, 0.17),
        4: (0.18, 0.05),
        5: (0.23, 0.17),
        6: (0.28, 0.05),
    }
    async with hands(layers=4) as fingers:
        fingers.at = positions
        await fingers.hold(0.5)
        reasons = fingers.held_back
        assert reasons.keys() == positions.keys()
        no_layer = [id for id, reason in reasons.items() if "no layer is free" in (reason or "")]
        assert no_layer == [1, 2]
        newest = " ".join(reasons[id] or "" for id in (3, 4, 5, 6))
        assert "shares the vibration" in newest
        assert "required contrast of 6 dB" in newest


@in_virtual_time
async def test_resting_fingers_are_served_once_the_ledger_admits_them() -> None:
    """The ledger does not state when; they are planned again within 1.1 s."""
    async with hands(breaks="touch") as fingers:
        fingers.refuse_layers("duty limit reached", 1)
        fingers.at = {1: LEFT, 2: RIGHT}
        await fingers.hold(0.5)
        assert fingers.applied == []
        fingers.restore()
        await fingers.hold(1.2)
        assert fingers.held_back == {1: None, 2: None}


@in_virtual_time
async def test_end_of_one_layer_by_itself_is_reported_while_others_continue(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One layer is not renewed and ends after 2 s; no set is sent for that.

    Nor does it count as felt once another finger lifts.
    """
    async with hands(THREE_FINGERS, held=1.8) as fingers:
        assert fingers.layers == {1: [0], 2: [1], 3: [2]}
        slots = fingers.controller.cycle.planner.slots
        renewals = slots.renewals

        def renewals_of_others(now: float) -> object:
            due = renewals(now)
            layers = {number: layer for number, layer in due.layers.items() if number != 0}
            return type(due)(layers)

        monkeypatch.setattr(slots, "renewals", renewals_of_others)
        fingers.mark()
        await fingers.hold(2.5)
        assert len(fingers.new_reports) == 1
        assert fingers.layers == {2: [1], 3: [2]}
        reasons = fingers.held_back
        assert "has ended" in (reasons.pop(1) or "")
        assert reasons == {2: None, 3: None}

        del fingers.at[3]
        await fingers.hold(0.2)
        assert fingers.layers == {2: [1]}
        reasons = fingers.held_back
        assert "has ended" in (reasons.pop(1) or "")
        assert reasons == {2: None}


@in_virtual_time
async def test_lifted_finger_falls_silent_while_an_amplifier_is_degraded() -> None:
    """Its layer alone ends within 20 ms, though the other finger moves.

    The other content starts again in its layer afterwards, because its state is unknown by then.
    """
    async with hands(TWO_FINGERS, held=0.6) as fingers:
        assert fingers.layers == {1: [0], 2: [1]}
        fingers.mark()
        fingers.degrade()
        fingers.at[2] = RIGHT_MOVED
        await fingers.hold(0.03)
        assert fingers.new_commits == []

        fingers.mark()
        del fingers.at[1]
        await fingers.hold(0.1)
        (commit,) = fingers.new_commits
        assert commit.time <= 0.02
        assert fingers.changes == [[0]]
        assert fingers.driven == {0: False}

        fingers.restore()
        fingers.mark()
        await fingers.hold(0.1)
        assert fingers.changes == [[1]]


@in_virtual_time
async def test_refused_end_of_a_lifted_finger_while_an_amplifier_is_degraded_is_silence() -> None:
    """All layers end; then the other finger's content starts, because the amplifier recovered."""
    async with hands(TWO_FINGERS, held=0.6) as fingers:
        fingers.degrade()
        fingers.at[2] = RIGHT_MOVED
        await fingers.hold(0.03)
        fingers.mark()
        fingers.refuse_next_set()
        del fingers.at[1]
        await fingers.hold(0.1)
        assert len(fingers.refused) == 1
        assert fingers.changes == [[], [0]]
        assert fingers.new_commits[0].time <= 0.02


@pytest.mark.parametrize("delay", [0.0, 0.12])
@in_virtual_time
async def test_touch_near_one_mute_amplifier_of_three_leaves_active_contents(delay: float) -> None:
    """It hears, and sends nothing for 0.2 s, from the touch on or already since 0.12 s.

    The content of the resting finger continues in its phase; the other waits for the reply.
    """
    async with hands({1: LEFT}, amplifiers=("a", "b", "c"), held=1.0, breaks="plate") as fingers:
        fingers.far_ends[2].fault("drop", toward="host", lasts=0.2)
        await fingers.hold(delay)
        degraded = [*fingers.controller.group.members.degraded]
        assert degraded == (["c"] if delay else [])
        fingers.at[2] = RIGHT
        await fingers.hold(0.5)
        assert fingers.continued == {0: {True}, 1: {False}}
        assert fingers.layers == {1: [0], 2: [1]}
        assert fingers.new_commits[0].time >= 0.18


@in_virtual_time
async def test_lift_near_one_mute_amplifier_of_three_ends_that_fingers_vibration_alone() -> None:
    """The two that reply end it within 20 ms; the other finger's content is not started again."""
    amplifiers = ("a", "b", "c")
    async with hands(TWO_FINGERS, amplifiers=amplifiers, held=1.0, breaks="plate") as fingers:
        assert fingers.layers == {1: [0], 2: [1]}
        fingers.far_ends[2].fault("drop", toward="host", lasts=0.2)
        await fingers.hold(0.15)
        fingers.mark()
        del fingers.at[2]
        await fingers.hold(0.03)
        assert fingers.driven == {1: False}
        assert fingers.new_commits[0].time <= 0.02
        await fingers.hold(0.5)
        assert fingers.driven == {1: False}
        assert fingers.layers == {1: [0]}


@in_virtual_time
async def test_answer_for_a_finger_that_has_lifted_changes_nothing() -> None:
    """A finger comes and lifts while the answer for two is computed: the other's set stays."""
    async with hands({1: LEFT}, held=0.3) as fingers:
        fingers.slow_answers(0.2)
        fingers.mark()
        fingers.at[2] = RIGHT
        await fingers.hold(0.05)
        del fingers.at[2]
        await fingers.hold(0.5)
        assert fingers.new_commits == []
        assert len(fingers.applied) == 1


@pytest.mark.parametrize(
    ("moves", "breaks"), [({}, None), ({3: (0.079, 0.208)}, "touch")], ids=["idle", "answering"]
)
@in_virtual_time
async def test_finger_that_returns_elsewhere_feels_nothing_chosen_for_its_old_position(
    moves: Mapping[int, Position], breaks: str | None
) -> None:
    """It has the same id; once an answer is computed that was asked for before it lifted."""
    async with hands(THREE_FINGERS, held=0.6, breaks=breaks) as fingers:
        fingers.slow_answers(0.07)
        if moves:
            fingers.at |= moves
            await fingers.hold(0.02)
        del fingers.at[2]
        await fingers.hold(0.02)
        fingers.mark()
        fingers.at[2] = (0.27, 0.10)
        await fingers.hold(0.3)
        assert fingers.served_positions.keys() == {1, 2, 3}
        assert fingers.served_positions[2] == {(0.27, 0.10)}


@in_virtual_time
async def test_answer_of_a_former_layout_is_not_played() -> None:
    """The effects change while the answer is computed: only the new ones play."""
    async with hands({1: LEFT}, held=0.5, breaks="touch") as fingers:
        fingers.slow_answers(0.07)
        fingers.at[2] = RIGHT
        await fingers.hold(0.03)
        fingers.mark()
        fingers.choose_layout("higher")
        await fingers.hold(0.3)
        assert len(fingers.new_reports) == 1
        assert len(fingers.frequencies) == 2
        assert min(fingers.frequencies) >= 200


@in_virtual_time
async def test_effect_that_is_played_again_before_its_answer_is_felt() -> None:
    """A program repeats it every 30 ms, and answers take 50: each is for an earlier play."""
    async with hands(TWO_FINGERS, held=0.3) as fingers:
        fingers.slow_answers(0.05)
        fingers.mark()
        for _ in range(10):
            fingers.play("long", 1)
            await fingers.hold(0.03)
        assert "long" in fingers.played_effects


@in_virtual_time
async def test_answer_that_fails_silences_all_with_a_reason() -> None:
    """It is asked for once, not in every turn of the loop; moving fingers are asked for again."""
    async with hands({1: LEFT}, held=0.3, breaks="touch") as fingers:
        raised = fingers.fail_answers(ZeroDivisionError("by no finger"))
        fingers.mark()
        fingers.at[2] = RIGHT
        await fingers.hold(0.5)
        assert len(raised) == 1
        assert fingers.driven == {0: False}
        assert fingers.silenced[-1].reason == "ZeroDivisionError: by no finger"

        fingers.restore()
        fingers.at[2] = RIGHT_MOVED
        await fingers.hold(0.3)
        assert fingers.status("held_back") == {1: None, 2: None}


@in_virtual_time
async def test_abandoned_answer_is_never_played_and_the_next_waits_for_its_end() -> None:
    """It takes 4 s. After one second several fingers are silent, even if they move, until its end.

    One finger needs no thread.
    """
    async with hands({1: LEFT}, held=0.3, breaks="touch") as fingers:
        questions = fingers.slow_answers(4.0, 0.02)
        fingers.mark()
        fingers.at[2] = RIGHT
        await fingers.hold(0.9)
        assert "is being chosen" in fingers.status("held_back")[2]
        await fingers.hold(0.6)
        assert fingers.silenced[-1].time - fingers.marked_at == pytest.approx(1.005, abs=0.005)
        assert not fingers.is_loud

        await fingers.slide(0.5, 0.05, 0.0, 2)
        reasons = fingers.status("held_back")
        assert "no answer within 1 s" in reasons[1]
        assert "no answer within 1 s" in reasons[2]
        assert len(questions) == 1
        del fingers.at[2]
        await fingers.hold(0.1)
        assert fingers.status("held_back") == {1: None}

        fingers.at[2] = RIGHT
        await fingers.hold(2.3)
        assert questions[1] - fingers.marked_at == pytest.approx(4.0, abs=1e-3)
        assert fingers.status("held_back") == {1: None, 2: None}


@in_virtual_time
async def test_thread_that_cannot_start_is_asked_for_again() -> None:
    """Without a thread everything is silent, and felt again once there is one."""
    async with hands({1: LEFT}, held=0.3, breaks="touch") as fingers:
        has_no_thread(fingers.patch)
        fingers.at[2] = RIGHT
        await fingers.hold(0.3)
        assert not fingers.is_loud
        fingers.restore()
        await fingers.hold(0.4)
        assert fingers.status("held_back") == {1: None, 2: None}


@in_virtual_time
async def test_moving_fingers_with_slow_answers_delay_no_heartbeat_and_no_lift() -> None:
    """Answers take 0.4 s; at rest the plate is silent immediately, and stays silent."""
    async with hands(layout="one region", breaks="touch") as fingers:
        questions = fingers.slow_answers(0.4)
        fingers.spread(3)
        fingers.mark()
        await fingers.slide(0.9, 0.027, 0.0, *fingers.at)
        assert len(questions) >= 2
        assert len(fingers.new_reports) >= 1
        times = fingers.far_end.times("Ping", "Set", "Commit")
        pauses = [end - start for start, end in pairwise(times)]
        assert max(pauses) <= 0.06

        fingers.mark()
        fingers.at.clear()
        await fingers.hold(0.02)
        assert fingers.changes == [[]]
        assert fingers.new_commits[0].time <= 0.005
        await asyncio.sleep(1.0)
        assert not fingers.is_loud
        assert len(fingers.new_commits) == 1
