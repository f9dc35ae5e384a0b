"""The control loop in virtual time, with amplifiers that record their requests.

It opens, arms, stops, closes and loses several amplifiers; clicks play beside what lasts; as many
fingers as there may be are served; and an answer that comes too late is reported and never played.
"""

import asyncio
import logging
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from chain import FINGER, OTHER, Chain, set_chain, set_running
from controller.effects.kinds import Buzz, Click
from controller.effects.layout import SurfaceLayout, default_effects
from controller.operation.plate_controller import Controller
from controller.play.intent import (
    CLICK,
    HapticIntent,
    Prediction,
    Pulse,
    Selection,
    Target,
    sums_db,
)
from controller.play.loop import Observers, PlayReport
from controller.play.selection import Chooser, Selector
from controller.play.slots import Slot
from controller.sources.touch import Contact, ContactKey, Touch, TouchFrame
from courses import Acted, courses, follow
from drivers.errors import LinkError
from drivers.host.group import GroupState
from drivers.opening import Lines
from drivers.protocol.records import Refusal, Values
from model.answer.answer_report import Timing
from model.errors import InputError
from model.rig.rig import Channel
from plates import small_problem, small_table
from registry.limits import HAND_LOAD
from set_table import BuzzNewestContact, SetTiming
from several_fingers import (
    LAYOUT,
    LEFT,
    RIGHT,
    Fingers,
    fingers_on,
    playable,
    table,
)
from sim.far_ends.wire_assignment import SimulatedWire
from virtual_lines import in_virtual_time

COURSES = courses(Path(__file__).with_name("courses.yaml"))


@pytest.mark.parametrize("name", COURSES)
def test_control_loop_keeps_to_its_course(name: str) -> None:
    """Every step is as it is in the file."""
    follow({"of": Acted, **COURSES[name]}, set_running)


def now() -> float:
    """The loop's time [s]."""
    return asyncio.get_running_loop().time()


@in_virtual_time
async def test_controller_decides_anew_for_a_load_that_doubles_not_for_one_that_wavers() -> None:
    """A panel at 100 Hz whose pressure wavers by a third in load, then doubles, then comes back."""

    def press(*loads: float) -> None:
        touches = (Touch(1, 0.5, 0.5), *(Touch(2, 0.9, 0.9, load=load) for load in loads))
        chain.deliver(TouchFrame("panel", now(), touches))

    async with set_running() as chain:
        for base, decisions in ((1.0, 1), (2.0, 2), (1.2, 3)):
            for number in range(50):
                press(base * (1.15 if number % 2 else 1 / 1.15))
                await asyncio.sleep(0.01)
            assert len(chain.table.asked) == decisions
        asked = [tuple(each.load for each in fingers) for fingers in chain.table.asked]
    assert asked == [(1.0, 1.0), (pytest.approx(2 / 1.15), 1.0), (pytest.approx(1.2 / 1.15), 1.0)]


@in_virtual_time
async def test_a_hand_is_asked_for_with_its_load_and_feels_nothing() -> None:
    """The newest contact is to buzz: a hand that comes after a finger is none of those."""

    def touch(*hands: float) -> None:
        touches = (Touch(1, 0.5, 0.5), *(Touch(2, 0.9, 0.9, load=each) for each in hands))
        chain.deliver(TouchFrame("panel", now(), touches))

    async with set_running() as chain:
        for hands in ((), (HAND_LOAD,), ()):
            for _ in range(10):
                touch(*hands)
                await asyncio.sleep(0.01)
        asked = [[(each.load, each.stimulus is None) for each in one] for one in chain.table.asked]
    assert asked == [[(1.0, False)], [(1.0, False), (HAND_LOAD, True)], [(1.0, False)]]


@in_virtual_time
async def test_lift_as_a_set_is_confirmed_precedes_a_due_heartbeat() -> None:
    """It comes when the set is reported as playing, by replies as late as the heartbeat is due."""
    before: list[int] = []  # requests to each amplifier before the lift

    def lift(report: PlayReport) -> None:
        if report.contents:
            before.extend(len(end.asked) for end in chain.far_ends)
            chain.put()

    async with set_running("a", "b", observe=lambda loop: loop.reported.append(lift)) as chain:
        await asyncio.sleep(0.046)
        for end in chain.far_ends:
            end.delay(0.002)
        await chain.leave(0.05, FINGER)
        for end, count in zip(chain.far_ends, before, strict=True):
            assert end.names(count)[:2] == ["Silence", "Ping"]


@in_virtual_time
async def test_controller_survives_a_failing_observer(caplog: pytest.LogCaptureFixture) -> None:
    """Its exceptions are logged; pattern, silence and heartbeats are sent all the same."""

    def fail(*_: object) -> None:
        raise RuntimeError("no disk space for this row")

    def observe(loop: Observers) -> None:
        for callbacks in (loop.contacts_changed, loop.reported):
            callbacks.append(fail)

    async with set_running(observe=observe) as chain:
        await chain.leave(0.01, FINGER)
        await chain.leave(0.2)
        assert [each.is_silent for each in chain.far_end.sent()] == [True, False, True]
        assert len(chain.far_end.requests("Ping")) > 3
    assert "no disk space for this row" in caplog.text


@in_virtual_time
async def test_latency_counts_from_the_touch_though_its_first_set_is_lost() -> None:
    """No reply for 80 ms from the moment that a finger comes down: a touch, not quicker than so."""
    async with set_running() as chain:
        chain.far_end.fault("drop", toward="host")
        begin = now()
        await chain.leave(0.08, FINGER)
        chain.far_end.recover()
        await chain.leave(0.2, FINGER)
        applied = chain.applied[0]
        assert applied.is_touch
        assert applied.latency == pytest.approx(applied.time - begin)
        assert applied.latency >= 0.08


PLAYED = SurfaceLayout(LAYOUT.regions, {**default_effects(), **LAYOUT.effects}, elsewhere=None)
"""Contents of 14 dB SL, and a click without a level of its own."""


async def clicked(fingers: Fingers, name: str = "click") -> tuple[PlayReport, PlayReport, int]:
    """Play a click at finger 1: what was reported before it, of it, and how often in all."""
    count, before = len(fingers.applied), fingers.applied[-1]
    fingers.play(name)
    await fingers.hold(0.3)
    return before, fingers.applied[count], len(fingers.applied) - count


def by_finger(report: PlayReport) -> dict[int, Prediction]:
    """What each finger is predicted to feel."""
    return {each.contact.key.id: each for each in report.targets}


def short(report: PlayReport) -> list[Slot]:
    """The clicks that play."""
    return [one for one in report.contents.values() if one.content.key[1] == CLICK]


@in_virtual_time
async def test_a_click_beside_its_own_buzz_is_6_db_above_it_and_30_hz_from_all() -> None:
    """As modelled, in 2 sets of its own layer; what lasts of both fingers is not touched."""
    async with fingers_on(table(), PLAYED, at={1: LEFT, 2: RIGHT}, held=0.6) as fingers:
        sent = len(fingers.committed)
        before, during, _ = await clicked(fingers)
        (click,) = short(during)
        (number,) = [n for n, one in during.contents.items() if one is click]
        layers = [[one.layer for one in each] for _, _, each in fingers.committed[sent:]]
        assert layers == [[number]] * 2
        felt, buzz = by_finger(during)[1], by_finger(before)[1]
        assert felt.content == "click"
        assert buzz.nominal_db_sl is not None
        least = max(20.0, buzz.nominal_db_sl + 6)  # what the layout's default is, or more
        assert felt.nominal_db_sl == pytest.approx(least, abs=0.1)
        for one in before.contents.values():
            assert abs((one.content.frequency or 0) - (click.content.frequency or 0)) >= 30


@in_virtual_time
async def test_a_click_restates_what_its_neighbour_feels_and_only_meanwhile() -> None:
    """Foreign level: none of 40 ms is above it on this plate; contrast: by powers, by hand."""
    async with fingers_on(table(), PLAYED, at={1: LEFT, 2: RIGHT}, held=0.6) as fingers:
        before, during, count = await clicked(fingers)
        old, new, again = (by_finger(each)[2] for each in (before, during, fingers.applied[-1]))
        assert count == 2
        assert again == old
        figures = old.level_db_sl, old.promised_contrast_db, old.foreign_level_db_sl
        level, contrast, foreign = (10 ** ((each or 0.0) / 10) for each in figures)
        total = 10 ** ((new.foreign_level_db_sl or 0.0) / 10)
        assert total > 2 * foreign
        expected = level / (level / contrast + total - foreign)
        assert new.promised_contrast_db == pytest.approx(10 * math.log10(expected), abs=1e-6)
        assert new.verdict == ("own" if new.promised_contrast_db >= 12 else "mixed")
        assert (new.level_db_sl, new.frequency) == (old.level_db_sl, old.frequency)


@pytest.mark.parametrize(
    ("contrast", "foreign", "expected", "total", "verdict"),
    [
        (14.0, 5.0, 20 - 10 * math.log10(10**0.6 + 10**0.6), 8.539, "mixed"),
        (None, None, 14.0, 6.0, "own"),
        (11.0, None, 11.0, 6.0, "mixed"),
    ],
)
def test_powers_of_contents_add(
    contrast: float | None, foreign: float | None, expected: float, total: float, verdict: str
) -> None:
    """6 dB SL beside 20: on 6 dB SL that its contrast of 14 dB is to, on 5 dB SL, on nothing."""
    contact = Contact(ContactKey("a", 1), 0.1, 0.1, 0.0)
    was = "mixed" if contrast == 11 else "own"
    felt = Prediction(
        contact, 20.0, None, was, promised_contrast_db=contrast, foreign_level_db_sl=foreign
    ).beside([6.0], sums_db([[6.0], [-math.inf if foreign is None else foreign]]))
    assert felt.promised_contrast_db == pytest.approx(expected, abs=1e-3)
    assert felt.foreign_level_db_sl == pytest.approx(total, abs=1e-3)
    assert felt.verdict == verdict


@in_virtual_time
async def test_a_click_without_a_free_layer_is_refused_and_the_buzz_plays_on() -> None:
    """Of two layers none is left, and its finger's row says why; what lasts is as before."""
    contacts = [Contact(ContactKey("a", n), *at, 0.0) for n, at in enumerate((LEFT, RIGHT))]
    lasting = [Target(each.key, 14.0, content="buzz") for each in contacts]
    click = Target(contacts[0].key, 20.0, Pulse(0.04, 1.0), content="click", priority=9)
    selector, found = Selector(Chooser(table())), list[Selection]()
    for targets in (lasting, lasting, [*lasting, click]):
        intent = HapticIntent(tuple(targets))
        found.append(selector.select(contacts, intent, playable(2), now=1.0))
        await asyncio.sleep(0.1)
    assert found[2].contents == found[1].contents
    old, new = (each.predictions[0] for each in found[1:])
    assert replace(new, held_back=None) == old
    assert "no layer is free" in (new.held_back or "")


@in_virtual_time
async def test_a_click_has_what_the_buzz_of_its_finger_leaves_of_the_stroke() -> None:
    """It asks for more: one ERA is at full stroke then, none above; what lasts stays."""
    effects = {**PLAYED.effects, "low": Buzz(level=36.0), "loud": Click(level=60.0)}
    async with fingers_on(table(), replace(PLAYED, effects=effects), at={1: LEFT}, held=0.6) as on:
        before, during, _ = await clicked(on, "loud")
        levels = Counter[str]()
        for one in during.contents.values():
            levels.update({era: tone.level for era, tone in one.drive.items()})
        assert 0.97 < max(levels.values()) <= 1.0
        lasting = [one.content for one in before.contents.values()]
        assert [one.content for one in during.contents.values()][:1] == lasting
        assert not on.refused


ENABLED, STOPPED = "OPERATION_ENABLED", "QUICK_STOP_ACTIVE"


def states(chain: Chain) -> set[str]:
    """The states of all amplifiers."""
    return {end.state for end in chain.far_ends}


@in_virtual_time
async def test_a_touch_while_arming_ends_is_felt(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its set may be on the wire when the amplifiers are armed and what played is forgotten."""
    async with set_running() as chain:
        await chain.controller.disarm()
        arm = chain.controller.group.arm

        async def armed_late() -> None:
            await arm()
            await chain.leave(0, FINGER)

        monkeypatch.setattr(chain.controller.group, "arm", armed_late)
        await chain.controller.arm()
        await chain.hold(0.1, down=[FINGER])
        assert states(chain) == {ENABLED}
        assert chain.applied[-1].contents


@pytest.mark.parametrize("kind", ["Set", "Commit", "Ping"])
@in_virtual_time
async def test_unexpected_exception_stops_all(kind: str) -> None:
    """A bug anywhere, between stage and commit too, leaves nothing vibrating."""
    async with set_running("a", "b") as chain:
        wire = chain.controller.amplifiers["b"].line.wire
        request = wire.request

        def fail(address: int, name: str, values: Values, **more: bool) -> bytes:
            if name == kind:
                raise ZeroDivisionError("a bug")
            return request(address, name, values, **more)

        wire.request = fail  # type: ignore[method-assign]
        await chain.hold(0.1, down=[FINGER])
        running, chain.running = chain.running, None
        with pytest.raises(ZeroDivisionError):
            await running  # type: ignore[misc]
        assert states(chain) == {STOPPED}
        assert chain.controller.group.state is GroupState.STOPPED


@in_virtual_time
async def test_arm_arms_all_anew_when_one_no_longer_is() -> None:
    """One that another program has disarmed plays again, in sessions of which none was held."""
    async with set_running("a", "b", breaks="state") as chain:
        held = {end.amplifier.session for end in chain.far_ends}
        chain.far_ends[0].obey("Disarm", {"ramp": 0}, asyncio.get_running_loop().time())
        await chain.controller.arm()
        assert states(chain) == {ENABLED}
        assert held.isdisjoint({end.amplifier.session for end in chain.far_ends})


@in_virtual_time
async def test_incomplete_set_is_silenced_before_the_next() -> None:
    """A lift aborts the wait for commits, and a finger comes before silence: silence goes first.

    Some amplifiers may play the aborted set and others not, which is another pattern. The heartbeat
    that is due meanwhile waits for this silence.
    """
    async with set_running("a", "b") as chain:
        await asyncio.sleep(0.02)  # the heartbeat is due 50 ms after the first
        for end in chain.far_ends:
            end.delay(0.02)
        chain.put(FINGER)
        await asyncio.sleep(0.025)  # staged after 20 ms, and the commits wait for their replies
        assert [len(end.requests("Commit")) for end in chain.far_ends] == [1, 1]
        chain.put()
        chain.put(OTHER)
        await chain.hold(0.2, down=[OTHER])
        for end in chain.far_ends:
            after_arming, *sent = [
                name for name in end.names() if name in ("Set", "Commit", "Silence")
            ]
            assert after_arming == "Silence"
            assert sent == ["Set", "Commit", "Silence", "Set", "Commit"]
            commit, silence = end.times("Commit")[0], end.times("Silence")[1]
            assert not [time for time in end.times("Ping") if commit <= time <= silence]


@in_virtual_time
async def test_no_plan_fails_while_an_amplifier_is_identified_again(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A stop finds all closed, one by a lost line, and the other tells no capabilities any more.

    The finger that rests is planned for meanwhile, and felt once both are open again and armed.
    """
    async with set_running("a", "b") as chain:
        chain.far_ends[1].fault("unplug")
        await chain.hold(0.5)
        with pytest.raises(LinkError):
            await chain.controller.open()
        known, other = chain.far_ends

        def refuse(name: str, values: Values) -> None:
            if name == "GetCaps":
                raise Refusal("as told", "WRONG_STATE")

        known.lie(refuse)
        await chain.controller.stop_all()
        await chain.hold(0.5, down=[FINGER])
        assert not [each for each in caplog.records if "plan failed" in each.getMessage()]
        known.answer = lambda name, values: None
        other.recover()
        await chain.controller.open()
        await chain.controller.clear()
        await chain.controller.arm()
        await chain.hold(0.1)
        assert any(known.levels)


@pytest.mark.parametrize(
    ("count", "is_stopped", "logged"), [(2, False, []), (1000, True, ["ERROR"])]
)
@in_virtual_time
async def test_close_waits_for_zero_then_stops(
    caplog: pytest.LogCaptureFixture, count: int, is_stopped: bool, logged: list[str]
) -> None:
    """Delayed levels are read again; an amplifier that keeps one is stopped, which is logged."""
    left = count

    def lag(name: str, values: Values) -> Values | None:
        nonlocal left
        if name == "Disarm":
            chain.far_end.obey(name, values, asyncio.get_running_loop().time())
        if left <= 0 or "Disarm" not in chain.far_end.names() or name == "Stop":
            return None
        left -= 1
        return {**chain.far_end.status(), "levels": [3000, 0, 0]}

    caplog.set_level(logging.INFO)
    async with set_running(breaks="silent") as chain:
        chain.far_end.answer = lag
    assert bool(chain.far_end.requests("Stop")) is is_stopped
    assert not chain.far_end.is_open
    assert [record.levelname for record in caplog.records] == logged


@in_virtual_time
async def test_error_of_opening_names_the_amplifier_that_cannot_be_reached() -> None:
    """By a line that cannot be opened, or by no reply; not those that were open before."""
    async with set_chain("a", "b") as chain:
        await chain.controller.open()
        chain.far_ends[1].fault("drop", toward="amplifier")
        await chain.controller.release()
        with pytest.raises(LinkError) as mute:
            await chain.controller.open()
        chain.far_ends[1].fault("unplug")
        with pytest.raises(LinkError) as gone:
            await chain.controller.open()
    assert (mute.value.lost, gone.value.lost) == (("b",), ("b",))


@in_virtual_time
async def test_error_of_opening_names_the_amplifiers_of_a_line() -> None:
    """All that share a line which cannot be opened, as a CAN bus; not one on another line."""
    async with set_chain("a", "b", "c") as chain:
        line = chain.controller.urls["b"]
        chain.far_ends[1].fault("unplug")
        chain.controller.urls["c"] = f"{line}&address=2"
        with pytest.raises(LinkError) as gone:
            await chain.controller.open()
    assert gone.value.lost == ("b", "c")


@in_virtual_time
async def test_controller_refuses_amplifiers_that_do_not_fit_the_rig() -> None:
    """Other names, or fewer channels; nothing stays open."""
    async with set_chain() as chain:
        rig, urls = chain.far.bench.rig, chain.far.urls
        wiring = {**rig.wiring, "NE": Channel("main", 3)}
        for changed, given, problem in (
            (rig, {"other": "sim://"}, r"main.*other"),
            (replace(rig, wiring=wiring), urls, r"ERA NE .*0 to 2 on amplifier main, got 3; .*rig"),
        ):
            with pytest.raises(InputError, match=problem):
                await Controller(
                    changed,
                    chain.table,
                    lines=Lines,
                    intent_source=BuzzNewestContact(),
                    timing=SetTiming(),
                    urls=given,
                ).open()
            assert not chain.far_end.is_open


@in_virtual_time
async def test_open_refuses_a_table_without_playable_frequencies() -> None:
    """With the bands of amplifier and table; nothing stays open."""
    table, wire = small_table(), SimulatedWire("serial")
    given: dict[str, Any] = {"capabilities": {"frequency_min": 8000}, "timing": Timing(table)}
    async with Chain.on(wire, small_problem().rig, table, **given) as chain:
        with pytest.raises(InputError, match=r"60 to 250 Hz.*400-500"):
            await chain.controller.open()
        assert chain.controller.group.state is GroupState.CLOSED
        assert not chain.far_end.is_open
