"""The synchronous amplifier over one simulated in the same process."""

import threading

import pytest

from drivers.by_hand.blocking import BlockingAmplifier
from drivers.contents import Tone
from drivers.errors import CommandError, CommandRefused, LinkError
from model.rig.file import example_rig_path
from registry.limits import GuardLimits

LIMITS = GuardLimits(40.0, 500.0, 0.5)
URL = f"sim://{example_rig_path()}"


def loop_threads() -> list[str]:
    """Names of the running event loop threads."""
    names = [thread.name for thread in threading.enumerate()]
    return [name for name in names if name.startswith("amplifier ")]


def test_blocking_amplifier_plays_and_ends_disarmed() -> None:
    """Arm, play, stop and clear; nothing is left running, thread or vibration."""
    with BlockingAmplifier(URL, limits=LIMITS) as amplifier:
        assert amplifier.identity["serial_number"] == "SIM-main"
        assert amplifier.capabilities["channels"] == 4
        assert amplifier.arm(2.0)["state"] == "OPERATION_ENABLED"
        played = amplifier.play([Tone(0, 110.004, 0.2)], duration=0.03, ramp=0.0)
        assert played.layers[0].commands[0].frequency == 2200  # in 1/20 Hz
        later = amplifier.apply([Tone(1, 110.0, 0.3)], ramp=0.0)
        status = amplifier.status()
        assert (status["token"], status["levels"]) == (later.token, [0.0, 0.3, 0.0, 0.0])
        amplifier.stop()
        assert amplifier.status()["state"] == "QUICK_STOP_ACTIVE"
        with pytest.raises(CommandRefused):
            amplifier.apply([Tone(1, 110.0, 0.3)])
        with pytest.raises(CommandRefused):
            amplifier.heartbeat()
        assert amplifier.clear()["state"] == "SWITCH_ON_DISABLED"
        assert amplifier.faults() == []
    assert loop_threads() == []


def test_blocking_amplifier_refuses_what_exceeds_its_limits() -> None:
    """The ledger refuses before anything is sent, and what is no tone."""
    with BlockingAmplifier(URL, limits=LIMITS) as amplifier:
        amplifier.arm()
        with pytest.raises(CommandRefused, match="level"):
            amplifier.apply([Tone(0, 110.0, 0.51)])
        with pytest.raises(CommandError, match="list of Tone"):
            amplifier.apply("tones")  # type: ignore[arg-type]
        amplifier.disarm()
        assert amplifier.status()["state"] == "SWITCH_ON_DISABLED"


def test_blocking_amplifier_measures_while_it_feeds_the_watchdog() -> None:
    """Over a window longer than the watchdog; the ERA that plays moves its own foot most."""
    with BlockingAmplifier(URL, limits=LIMITS) as amplifier:
        amplifier.arm(1.0)
        amplifier.apply([Tone(2, 110.0, 0.2)], ramp=0.0)
        reading = amplifier.measure([110.0], 1.2)
        assert amplifier.status()["state"] == "OPERATION_ENABLED"
        sensors = amplifier.sensors()
        loudest = max(range(len(sensors)), key=lambda n: reading.sensors[n].tones[0][0])
        assert sensors[loudest].channel == 2


def test_play_raises_when_the_watchdog_has_tripped(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error names fault and remedy."""
    monkeypatch.setattr("drivers.by_hand.blocking.HEARTBEAT", 0.15)
    with BlockingAmplifier(URL, limits=LIMITS) as amplifier:
        amplifier.arm(0.1)
        with pytest.raises(CommandRefused, match=r"WATCHDOG.*clear"):
            amplifier.play([Tone(0, 110.0, 0.2)], duration=1.0)


def test_amplifier_of_another_full_level_is_refused() -> None:
    """A rig says which one it has: the simulated one is of motion."""
    with pytest.raises(LinkError, match="full level"):
        BlockingAmplifier(URL, limits=LIMITS, is_output=True).__enter__()
    with BlockingAmplifier(URL, limits=LIMITS, is_output=False):
        pass


def test_blocking_amplifier_ends_its_thread_when_opening_fails() -> None:
    """The error reaches the script, and the loop's thread has ended."""
    with pytest.raises(CommandError), BlockingAmplifier("sim://no-such-rig.yaml", limits=LIMITS):
        pass
    assert loop_threads() == []
