"""What a stop and the status say an amplifier may play: the same, and never too little."""

import random
from collections.abc import Mapping, Sequence
from contextlib import suppress

import pytest

from controller.daemon.messages import amplifier_statuses
from courses import Step
from drivers.errors import DriverError
from long_form import shortly
from registry import threads
from several_fingers import Watched, watched
from virtual_lines import in_virtual_time, run_virtual

STEPS: Sequence[Step] = (
    *("ARM", "ARM", "DISARM", "CLEAR", "STOP", {"touch": ["finger"]}),
    *("obey", "obey", {"fault": {"kind": "unplug"}}, {"fault": {"kind": "drop"}}),
    {"fault": {"kind": "drop", "toward": "host"}},
    {"fault": {"kind": "drop", "share": 0.7}},
    *({"becomes": "ANOTHER"}, {"becomes": "SIM-a"}),
    {"answers": {"to": ["Stop", "GetStatus"], "levels": [1000, 0, 0]}},
)
"""What happens to a plate and its amplifiers, at random: reached, lost, exchanged, loud or mute."""
PAUSES = (0.0, 0.003, 0.02, 0.1, 0.3, 1.2)
SILENT = "confirmed_silent"


def said_by_status(daemon: Watched) -> Mapping[str, Mapping[str, object]]:
    """What the status says of each amplifier, and what else is known of one that replies."""
    supervisor, controller = daemon.supervisor, daemon.controller
    shown = amplifier_statuses(
        controller.amplifiers,
        controller.urls,
        are_open=controller.group.is_open,
        lost=supervisor.operation.lost,
        what_may_play=supervisor.what_may_play,
        clock_errors=controller.group.clock_errors,
    )
    now = threads.now()
    said = {name: supervisor.what_may_play(name).rows(now) for name in controller.urls}
    for each in shown:
        assert (each.silence is None) == (each.state is not None and not each.degraded)
        assert each.silence is None or each.silence.model_dump() == said[each.name]
    may_play = supervisor.operation.lost is not None and any(
        each["silence"] == "may_play" for each in said.values()
    )
    assert supervisor.assume_energised(now) is may_play
    return said


def check_enough(daemon: Watched, said: Mapping[str, Mapping[str, object]]) -> None:
    """Require that what plays, or is armed, is said to."""
    for each in daemon.far_ends:
        is_alive = each.state == "OPERATION_ENABLED" or any(each.levels)
        assert not is_alive or said[each.name]["silence"] == "may_play", (each.state, said)


@pytest.mark.parametrize("wire", ["serial", "modbus-tcp"])
@pytest.mark.parametrize("seed", shortly(range(60), range(6)))
def test_stop_and_status_agree_and_say_enough(wire: str, seed: int) -> None:
    """At any moment of any course, and after it: never reached, lost, exchanged, opened anew."""
    rng = random.Random(seed)

    async def course() -> None:

        async with watched("a", "b", wire=wire, breaks="plate", unplugged=seed % 3 == 0) as daemon:
            for _ in range(8):
                with suppress(DriverError):
                    await daemon.take(rng.choice(STEPS))
                await daemon.waits(rng.choice(PAUSES) * rng.random())
                check_enough(daemon, said_by_status(daemon))
                if rng.random() < 0.5:
                    continue
                stopped = await daemon.supervisor.stop("a test")
                now = threads.now()
                words = {name: each.rows(now) for name, each in stopped.items()}
                known = said_by_status(daemon)
                for name, said in words.items():
                    if said["silence"] == SILENT:
                        assert known[name]["silence"] != "may_play"
                    else:
                        keys = "silence", "may_play_for_s"
                        assert [said[key] for key in keys] == [known[name][key] for key in keys]
                check_enough(daemon, words)
            daemon.obey()
            await daemon.waits(8)  # all are reached again, however long the last pause

    run_virtual(course(), rng=rng)


REACHED: Sequence[Step] = ("recovers", {"waits": 1})
MAY_PLAY, ELAPSED = "may_play", "watchdog_elapsed"
UNPLUG, MUTE = ({"fault": {"kind": kind}} for kind in ("unplug", "drop"))
LOST = (UNPLUG, {"waits": 0.01})
ANOTHER = {"becomes": "ANOTHER"}
LOUD = {"answers": {"to": ["Stop", "GetStatus"], "levels": [1000, 0, 0]}}
STATES: Mapping[str, tuple[Sequence[Step], str, float | None]] = {
    "never reached": ([], MAY_PLAY, None),
    "never reached, another answers": (*([ANOTHER, "recovers", {"waits": 3}], MAY_PLAY, None),),
    "lost while disarmed": ([*REACHED, *LOST], ELAPSED, 0.0),
    "lost while armed": ([*REACHED, "ARM", *LOST], ELAPSED, 0.0),
    "mute while armed": ([*REACHED, "ARM", MUTE], ELAPSED, 0.0),
    "lost, and opened anew in vain": ([*REACHED, "ARM", MUTE, {"waits": 20}], ELAPSED, 0.0),
    "lost, another answers": (
        [*REACHED, "ARM", UNPLUG, ANOTHER, "recovers", {"waits": 3}],
        *(ELAPSED, 0.0),
    ),
    "shows a level": ([*REACHED, "ARM", LOUD], MAY_PLAY, None),
    "shows a level, then lost": ([*REACHED, LOUD, {"waits": 1}, MUTE], MAY_PLAY, None),
    "silent": ([*REACHED, "ARM"], SILENT, None),
    "silent, then shows a level": ([*REACHED, "ARM", "STOP", LOUD], MAY_PLAY, None),
    "silent, then lost": ([*REACHED, "ARM", "STOP", *LOST], ELAPSED, 0.0),
    "exchanged while stopped": ([*REACHED, "ARM", "STOP", ANOTHER, "CLEAR"], ELAPSED, 0.0),
}
"""Steps of an amplifier that is not reached at first, then what a stop says, and for how long."""


@pytest.mark.parametrize("state", STATES)
@in_virtual_time
async def test_stop_says_what_is_known(state: str) -> None:
    """By name of the state; the status says the same, and what an event says of it too."""
    steps, silence, left = STATES[state]
    serial_numbers = {"main": "SIM-main"}
    async with watched(unplugged=True, breaks="plate", serial_numbers=serial_numbers) as daemon:
        for step in steps:
            with suppress(DriverError):
                await daemon.take(step)
        began = threads.now()
        (stopped,) = (await daemon.supervisor.stop("a test")).values()
        assert threads.now() - began < (0.65 if "lost" in state else 0.33)
        said = stopped.rows(threads.now())
        assert (said["silence"], said["may_play_for_s"]) == (silence, left)
        (known,) = said_by_status(daemon).values()
        assert silence == SILENT or known["silence"] == silence
        if "another answers" in state:
            operation = daemon.supervisor.operation
            assert "ANOTHER" in operation.cause
            assert "cable" not in (operation.remedy or "")
        daemon.obey()
        await daemon.waits(8)


@pytest.mark.parametrize("amid", ["DISARM", {"waits": 0.1}])
@in_virtual_time
async def test_end_does_not_wait_for_a_mute_amplifier(amid: Step) -> None:
    """Armed, on a network that may deliver for 1 s: it is stopped, and all ends within a second."""
    async with watched(wire="modbus-tcp", breaks="plate") as daemon:
        await daemon.does("ARM")
        await daemon.take(MUTE)
        await daemon.begins(amid)
        await daemon.waits(0.1)
        began = threads.now()
        await daemon.supervisor.close("the end")
        assert threads.now() - began < 0.9
        await daemon.ends_anyhow(amid)
        daemon.recovers()
