"""What a stop and the status say that amplifiers may play: the same, and never too little.

Lost amplifiers, in virtual time: which are opened again, which may still play, and for how long.
"""

import asyncio
import random
import re
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest

from cases import shortly
from controller.daemon.amplifier_messages import amplifier_statuses
from controller.operation.operation_states import DaemonEvent, DaemonState
from drivers.by_hand.rows import silence_rows
from drivers.errors import DriverError
from kit.chain import FINGER
from kit.clock import in_virtual_time, run_virtual
from registry import threads
from tests.controller.operation.supervised_plate import (
    ARM,
    CLEAR,
    DISARM,
    LINK_LOST,
    STOP,
    SupervisedPlate,
    supervised,
)

ROOT = Path(__file__).parents[3]
FAULT, LOST = DaemonState.FAULT, DaemonState.COMM_LOST
SILENT = "confirmed_silent"
MAY_PLAY = "may_play"
ELAPSED = "watchdog_elapsed"
SILENCE_KEYS = ("silence", "may_play_for_s")

Rows = Mapping[str, Mapping[str, object]]
"""What is said of each amplifier."""
Happening = Callable[[SupervisedPlate], Awaitable[None]]


def happening(method: Callable[[SupervisedPlate], object]) -> Happening:
    """Something that happens to a plate at once."""

    async def happen(plate: SupervisedPlate) -> None:
        method(plate)

    return happen


def command(event: DaemonEvent) -> Happening:
    """An event that the supervisor handles."""

    async def happen(plate: SupervisedPlate) -> None:
        with suppress(DriverError):
            await plate.handle(event)

    return happen


def pause(seconds: float) -> Happening:
    """Nothing, for a time."""

    async def happen(_: SupervisedPlate) -> None:
        await asyncio.sleep(seconds)

    return happen


def lose_some(plate: SupervisedPlate) -> None:
    """Lose 70 % of all messages."""
    plate.far_end.fault("drop", share=0.7)


def show_level(plate: SupervisedPlate) -> None:
    """Let the first amplifier report a level, whatever it plays."""
    plate.answer("Stop", "GetStatus", levels=[1000, 0, 0])


def restore_amplifier(plate: SupervisedPlate) -> None:
    """Put the first amplifier back."""
    plate.far_end.amplifier.identity["serial_number"] = "SIM-a"
    plate.far_end.disturb()


ARMING, STOPPING, CLEARING, DISARMING = map(command, (ARM, STOP, CLEAR, DISARM))
UNPLUG = happening(lambda plate: plate.far_end.fault("unplug"))
MUTE = happening(lambda plate: plate.far_end.fault("drop"))
RECOVER = happening(lambda plate: plate.far_end.recover())
REPAIR = happening(SupervisedPlate.repair)
ANOTHER = happening(SupervisedPlate.replace_amplifier)
LOUD = happening(show_level)
HAPPENINGS: Sequence[Happening] = (
    ARMING,
    ARMING,
    DISARMING,
    CLEARING,
    STOPPING,
    happening(lambda plate: plate.put(FINGER)),
    REPAIR,
    REPAIR,
    UNPLUG,
    MUTE,
    happening(SupervisedPlate.lose_replies),
    happening(lose_some),
    ANOTHER,
    happening(restore_amplifier),
    LOUD,
)
"""What happens to a plate and its amplifiers at random: reached, lost, exchanged, loud or mute."""
PAUSES = (0.0, 0.003, 0.02, 0.1, 0.3, 1.2)


def rows_of_status(plate: SupervisedPlate) -> Rows:
    """What the status says of each amplifier, and what else is known of those that reply."""
    supervisor, controller = plate.supervisor, plate.controller
    what_may_play = supervisor.reopening.what_may_play
    statuses = amplifier_statuses(
        controller.amplifiers,
        controller.urls,
        are_open=controller.group.is_open,
        lost=supervisor.operation.lost,
        what_may_play=what_may_play,
        clock_errors=controller.group.clock_errors,
    )
    now = threads.now()
    rows = {name: silence_rows(what_may_play(name), now) for name in controller.urls}
    for status in statuses:
        replies = status.state is not None and not status.degraded
        expected = None if replies else rows[status.name]
        silence = status.silence and status.silence.model_dump()
        assert silence == expected, status.name
    may_any_play = MAY_PLAY in [row["silence"] for row in rows.values()]
    is_lost = supervisor.operation.lost is not None
    assert supervisor.reopening.assume_energised(now) is (is_lost and may_any_play)
    return rows


def read_group_states() -> Mapping[str, set[str]]:
    """Read the states of the group for each state of the daemon, from the architecture page."""
    states = dict[str, set[str]]()
    for line in (ROOT / "docs/architecture.md").read_text(encoding="utf-8").splitlines():
        cells = line.split("|")[1:-1]
        names = [set(re.findall("`([A-Z_]+)`", cell)) for cell in cells]
        if len(names) == 2 and all(names):
            states.update(dict.fromkeys(names[0], names[1]))
    return states


GROUP_STATES = read_group_states()


def check_group_state(plate: SupervisedPlate) -> None:
    """Require that the group has a state of the page's table once nothing is under way."""
    group = plate.controller.group
    assert GROUP_STATES.keys() == {*DaemonState}
    if not plate.supervisor.tasks and not group.members.disarming:
        assert group.state.name in GROUP_STATES[plate.state]


def check_nothing_is_missing(plate: SupervisedPlate, rows: Rows) -> None:
    """Require that every amplifier that plays, or is armed, is said to."""
    for far_end in plate.far_ends:
        if far_end.state == "OPERATION_ENABLED" or any(far_end.levels):
            assert rows[far_end.name]["silence"] == MAY_PLAY, (far_end.name, far_end.state)


async def check_stop(plate: SupervisedPlate) -> None:
    """Stop, and require that the status says of each amplifier what the outcome of the stop says.

    Where the stop has confirmed silence, the status may know less.
    """
    outcomes = await plate.supervisor.stop("a test")
    now = threads.now()
    stopped = {name: silence_rows(outcome, now) for name, outcome in outcomes.items()}
    status = rows_of_status(plate)
    for name, row in stopped.items():
        if row["silence"] == SILENT:
            assert status[name]["silence"] != MAY_PLAY, name
        else:
            expected = [row[key] for key in SILENCE_KEYS]
            assert [status[name][key] for key in SILENCE_KEYS] == expected, name
    check_nothing_is_missing(plate, stopped)


@pytest.mark.parametrize("wire", ["serial", "modbus-tcp"])
@pytest.mark.parametrize("seed", shortly(range(60), range(6)))
def test_stop_and_status_agree_and_say_enough(wire: str, seed: int) -> None:
    """Whatever happens at random to two amplifiers, one of which may not be reached at first."""
    rng = random.Random(seed)
    is_unplugged = seed % 3 == 0

    async def play() -> None:
        options = {"wire": wire, "breaks": "plate", "is_unplugged": is_unplugged}
        async with supervised("a", "b", **options) as plate:
            for _ in range(8):
                happen = rng.choice(HAPPENINGS)
                await happen(plate)
                await asyncio.sleep(rng.choice(PAUSES) * rng.random())
                check_nothing_is_missing(plate, rows_of_status(plate))
                check_group_state(plate)
                if rng.random() >= 0.5:
                    await check_stop(plate)
            plate.repair()
            await asyncio.sleep(8)  # all are reached again, however long the last pause
            check_group_state(plate)

    run_virtual(play(), rng=rng)


REACH = (RECOVER, pause(1))
LOSE = (UNPLUG, pause(0.01))
CASES: Mapping[str, tuple[Sequence[Happening], str, float | None]] = {
    "never reached": ([], MAY_PLAY, None),
    "never reached, another answers": ([ANOTHER, RECOVER, pause(3)], MAY_PLAY, None),
    "lost while disarmed": ([*REACH, *LOSE], ELAPSED, 0.0),
    "lost while armed": ([*REACH, ARMING, *LOSE], ELAPSED, 0.0),
    # Not during the first heartbeat, whose reply a stop awaits.
    "mute while armed": ([*REACH, ARMING, pause(0.01), MUTE], ELAPSED, 0.0),
    "lost, and opened anew in vain": ([*REACH, ARMING, MUTE, pause(20)], ELAPSED, 0.0),
    "lost, another answers": (
        [*REACH, ARMING, UNPLUG, ANOTHER, RECOVER, pause(3)],
        ELAPSED,
        0.0,
    ),
    "shows a level": ([*REACH, ARMING, LOUD], MAY_PLAY, None),
    "shows a level, then lost": ([*REACH, LOUD, pause(1), MUTE], MAY_PLAY, None),
    "silent": ([*REACH, ARMING], SILENT, None),
    "silent, then shows a level": ([*REACH, ARMING, STOPPING, LOUD], MAY_PLAY, None),
    "silent, then lost": ([*REACH, ARMING, STOPPING, *LOSE], ELAPSED, 0.0),
    "exchanged while stopped": ([*REACH, ARMING, STOPPING, ANOTHER, CLEARING], ELAPSED, 0.0),
}
"""What happens to an amplifier that is not reached at first, what a stop says, and for how long."""


@pytest.mark.parametrize("case", CASES)
@in_virtual_time
async def test_stop_says_what_is_known(case: str) -> None:
    """The status says the same of the amplifier, and the stop does not wait for a lost one."""
    happenings, silence, may_play_for = CASES[case]
    serial_numbers = {"main": "SIM-main"}
    async with supervised(
        is_unplugged=True, breaks="plate", serial_numbers=serial_numbers
    ) as plate:
        for happen in happenings:
            await happen(plate)
        stopped_from = threads.now()

        outcomes = await plate.supervisor.stop("a test")

        now = threads.now()
        assert now - stopped_from < (0.65 if "lost" in case else 0.33)
        row = silence_rows(outcomes["main"], now)
        assert [row[key] for key in SILENCE_KEYS] == [silence, may_play_for]
        status = rows_of_status(plate)["main"]
        assert silence in (SILENT, status["silence"])
        if "another answers" in case:
            operation = plate.supervisor.operation
            assert "ANOTHER" in operation.cause
            assert "cable" not in (operation.remedy or "")
        plate.repair()
        await asyncio.sleep(8)


modbus_plate = partial(supervised, wire="modbus-tcp")
"""On a network that may deliver what was sent for 1 s; the watchdog expires after 0.25 s more."""


async def lose_and_reopen(plate: SupervisedPlate) -> None:
    """Lose an armed amplifier, which is opened again before its watchdog must have expired."""
    await plate.handle(ARM)
    plate.forget_requests()
    plate.lose_replies()
    losing = await plate.begin(LINK_LOST)
    await asyncio.sleep(0.4)
    plate.far_end.recover()
    await losing
    await asyncio.sleep(0.1)
    assert (plate.state, plate.links) == (LOST, ["reopened"])


@in_virtual_time
async def test_reopened_amplifier_may_play_until_its_watchdog_must_have_expired() -> None:
    """Meanwhile it counts as energised, and the loss stays latched afterwards."""
    async with modbus_plate() as plate:
        await lose_and_reopen(plate)
        assert plate.is_energised_in(0)

        await asyncio.sleep(1)

        assert (plate.state, plate.links) == (FAULT, ["reopened"])


@in_virtual_time
async def test_stop_while_a_reopened_amplifier_is_awaited_opens_no_line_again() -> None:
    """It reaches the amplifier, and is latched."""
    async with modbus_plate() as plate:
        await lose_and_reopen(plate)

        assert await plate.stop() == {"main": True}

        await asyncio.sleep(1)
        assert (plate.state, plate.links) == (FAULT, ["reopened"])


@in_virtual_time
async def test_loss_while_a_reopened_amplifier_is_awaited_opens_it_again() -> None:
    """The first loss stays latched."""
    async with modbus_plate() as plate:
        await lose_and_reopen(plate)

        await plate.handle(LINK_LOST)

        await asyncio.sleep(1)
        assert (plate.state, plate.links) == (FAULT, ["reopened", "reopened"])


@in_virtual_time
async def test_lost_amplifier_that_has_confirmed_a_stop_is_silent() -> None:
    """A loss that a command finds stops the amplifier, which still replies."""
    async with supervised() as plate:
        await plate.handle(ARM)

        await plate.handle(LINK_LOST)

        assert not plate.is_energised_in(0)


@in_virtual_time
async def test_lost_amplifier_may_play_for_as_long_as_a_network_delivers() -> None:
    """Replies stop 80 ms before the connection ends; 1.25 s after that it must be silent."""
    async with modbus_plate() as plate:
        await plate.handle(ARM)
        plate.put(FINGER)
        await asyncio.sleep(0.1)
        plate.lose_replies()
        await asyncio.sleep(0.08)
        plate.far_end.fault("unplug")
        await asyncio.sleep(0.5)

        assert plate.state is LOST
        assert plate.is_energised_in(0.62)
        assert not plate.is_energised_in(1.02)


@in_virtual_time
async def test_stop_reaches_an_amplifier_whose_line_is_opened_again_and_again() -> None:
    """Its replies are lost, so that nothing is confirmed; what it is sent arrives."""
    async with supervised() as plate:
        await plate.handle(ARM)
        plate.lose_replies()
        await asyncio.sleep(0.9)
        assert plate.state is LOST
        assert plate.far_end.is_open
        plate.forget_requests()

        assert await plate.stop() == {"main": False}

        assert plate.count("Stop") >= 3


@in_virtual_time
async def test_stop_opens_a_line_at_once_that_was_to_be_opened_after_a_pause() -> None:
    """After 13.5 s without the amplifier, attempts to open its line are seconds apart."""
    async with supervised() as plate:
        await plate.handle(ARM)
        plate.far_end.fault("unplug")
        await asyncio.sleep(13.5)
        assert plate.state is LOST
        assert not plate.far_end.is_open
        plate.forget_requests()
        plate.far_end.recover()

        assert await plate.stop() == {"main": True}

        assert plate.count("Stop") >= 2


@in_virtual_time
async def test_amplifier_that_was_loud_while_its_watchdog_was_awaited_is_read_again() -> None:
    """Once it reports silence, the loss is over."""
    async with modbus_plate(breaks="plate") as plate:
        await plate.handle(ARM)
        plate.far_end.fault("unplug")
        await asyncio.sleep(0.01)
        plate.far_end.recover()
        await asyncio.sleep(1.1)
        assert (plate.state, plate.far_end.state) == (LOST, "FAULT")
        show_level(plate)
        assert await plate.stop() == {"main": False}

        plate.repair()
        await asyncio.sleep(3)

        assert plate.state is FAULT


@in_virtual_time
async def test_stop_reaches_an_amplifier_that_was_closed_because_another_is_lost() -> None:
    """It confirms silence; the lost one does not, but is silent by its watchdog."""
    async with supervised("a", "b") as plate:
        await plate.handle(ARM)
        plate.far_end.fault("unplug")
        await asyncio.sleep(7)
        assert plate.state is LOST

        assert await plate.stop() == {"a": False, "b": True}

        assert not plate.is_energised_in(0)


@in_virtual_time
async def test_amplifier_whose_line_is_opened_again_is_disarmed_at_the_end() -> None:
    """Its watchdog may not have silenced it by then, for what was sent may arrive late."""
    async with modbus_plate() as plate:
        await plate.handle(ARM)
        plate.far_end.fault("unplug", lasts=0.05)
        plate.lose_replies()
        await asyncio.sleep(0.3)
        assert plate.state is LOST
        plate.forget_requests()

        await plate.supervisor.close("end")

        assert plate.count("Disarm") >= 1
        assert plate.count("Stop") >= 1
