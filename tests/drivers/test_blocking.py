"""The synchronous face, over a simulated amplifier."""

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
    """The threads of this face that live."""
    names = [thread.name for thread in threading.enumerate()]
    return [name for name in names if name.startswith("amplifier ")]


def test_a_script_plays_and_leaves_it_disarmed() -> None:
    """Arm, play, envelopes, stop and clear; nothing is left running, thread or vibration."""
    with BlockingAmplifier(URL, limits=LIMITS) as amplifier:
        assert amplifier.identity.serial_number == "SIM-main"
        assert amplifier.arm(2.0).state is AmplifierState.OPERATION_ENABLED
        achieved = amplifier.play([DriveCommand(0, 110.004, 0.2)], duration=0.03, ramp=0.0)
        assert achieved.commands[0].frequency == 110.0
        amplifier.load_envelope(Envelope(1, 0.005, (Knot(0.1, 0.0),)))
        amplifier.apply([DriveCommand(1, 110.0, 0.3, onset=1)])
        assert amplifier.status().token == 2
        assert amplifier.stop().state is AmplifierState.QUICK_STOP_ACTIVE
        with pytest.raises(CommandRefused):
            amplifier.apply([DriveCommand(1, 110.0, 0.3)])
        assert amplifier.heartbeat().state is AmplifierState.QUICK_STOP_ACTIVE
        while any(amplifier.status().levels):
            pass
        assert amplifier.clear().state is AmplifierState.SWITCH_ON_DISABLED
        assert amplifier.faults() == ()
    assert loop_threads() == []


def test_its_limits_hold() -> None:
    """What is beyond the limits is refused before it is sent."""
    with BlockingAmplifier(URL, limits=LIMITS) as amplifier:
        amplifier.arm()
        with pytest.raises(CommandRefused, match="level"):
            amplifier.apply([DriveCommand(0, 110.0, 0.51)])
        assert amplifier.disarm().state is AmplifierState.SWITCH_ON_DISABLED


def test_a_script_that_is_held_up_is_told_that_the_amplifier_stopped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its watchdog has passed meanwhile: which state and fault, and how to go on."""
    monkeypatch.setattr("drivers.blocking.HEARTBEAT", 0.15)
    with BlockingAmplifier(URL, limits=LIMITS) as amplifier:
        amplifier.arm(0.1)
        with pytest.raises(CommandRefused, match=r"is in FAULT.*, fault WATCHDOG; .*clear\(\) it"):
            amplifier.play([DriveCommand(0, 110.0, 0.2)], duration=1.0)


def test_what_cannot_be_opened_leaves_no_thread() -> None:
    """The error reaches the script, and the loop's thread has ended."""
    with pytest.raises(CommandError), BlockingAmplifier("sim://no-such-rig.yaml", limits=LIMITS):
        pass
    assert loop_threads() == []
