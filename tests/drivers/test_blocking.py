"""The synchronous amplifier over a simulated one."""

import threading

import pytest

from drivers.blocking import BlockingAmplifier
from drivers.command import DriveCommand, Envelope, Knot
from drivers.errors import CommandError, CommandRefused
from drivers.guard import GuardLimits
from drivers.protocol.messages import AmplifierState
from model.rig.file import example_rig_path

LIMITS = GuardLimits(40.0, 500.0, 0.5)
URL = f"sim://{example_rig_path()}"


def loop_threads() -> list[str]:
    """Names of the running event loop threads."""
    names = [thread.name for thread in threading.enumerate()]
    return [name for name in names if name.startswith("amplifier ")]


def test_blocking_amplifier_plays_and_ends_disarmed() -> None:
    """Arm, play, envelopes, stop and clear; nothing is left running, thread or vibration."""
    with BlockingAmplifier(URL, limits=LIMITS) as amplifier:
        assert amplifier.identity.serial_number == "SIM-main"
        assert amplifier.arm(2.0).state is AmplifierState.OPERATION_ENABLED
        achieved = amplifier.play([DriveCommand(0, 110.004, 0.2)], duration=0.03, ramp=0.0)
        assert achieved.commands[0].frequency == 110.0
        amplifier.load_envelope(Envelope(1, 0.005, (Knot(0.1, 0.0),)))
        amplifier.apply([DriveCommand(1, 110.0, 0.3, onset=1)])
        assert amplifier.status().token == achieved.token % 65535 + 1
        assert amplifier.stop().state is AmplifierState.QUICK_STOP_ACTIVE
        with pytest.raises(CommandRefused):
            amplifier.apply([DriveCommand(1, 110.0, 0.3)])
        assert amplifier.heartbeat().state is AmplifierState.QUICK_STOP_ACTIVE
        while any(amplifier.status().levels):
            pass
        assert amplifier.clear().state is AmplifierState.SWITCH_ON_DISABLED
        assert amplifier.faults() == ()
    assert loop_threads() == []


def test_blocking_amplifier_refuses_what_exceeds_its_limits() -> None:
    """The guard refuses before anything is sent."""
    with BlockingAmplifier(URL, limits=LIMITS) as amplifier:
        amplifier.arm()
        with pytest.raises(CommandRefused, match="level"):
            amplifier.apply([DriveCommand(0, 110.0, 0.51)])
        assert amplifier.disarm().state is AmplifierState.SWITCH_ON_DISABLED


def test_blocking_amplifier_measures_while_it_feeds_the_watchdog() -> None:
    """Over a window longer than the watchdog; the ERA that plays moves its own foot most."""
    with BlockingAmplifier(URL, limits=LIMITS) as amplifier:
        amplifier.arm(0.1)
        amplifier.apply([DriveCommand(2, 110.0, 0.2)], ramp=0.0)
        reading = amplifier.measure([110.0], 0.3)
        assert amplifier.status().state is AmplifierState.OPERATION_ENABLED
        sensors = amplifier.sensors()
        loudest = max(range(len(sensors)), key=lambda n: reading.sensors[n].tones[0].amplitude)
        assert sensors[loudest].channel == 2


def test_play_raises_when_the_watchdog_has_tripped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The error names state, fault and remedy."""
    monkeypatch.setattr("drivers.blocking.HEARTBEAT", 0.15)
    with BlockingAmplifier(URL, limits=LIMITS) as amplifier:
        amplifier.arm(0.1)
        with pytest.raises(CommandRefused, match=r"FAULT.* WATCHDOG.*clear"):
            amplifier.play([DriveCommand(0, 110.0, 0.2)], duration=1.0)


def test_blocking_amplifier_ends_its_thread_when_opening_fails() -> None:
    """The error reaches the script, and the loop's thread has ended."""
    with pytest.raises(CommandError), BlockingAmplifier("sim://no-such-rig.yaml", limits=LIMITS):
        pass
    assert loop_threads() == []
