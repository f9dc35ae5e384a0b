"""Sets and envelopes of voltage: made only of ones that passed, and doing the same as they."""

from dataclasses import replace

import pytest

from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.errors import CommandRefused
from drivers.guard import Guard, safe_voltage_envelope, safe_voltages
from drivers.protocol.messages import ChannelLimits
from registry.limits import GuardLimits
from vendor_pages import CAPABILITIES

GUARD = Guard(GuardLimits(40.0, 500.0, 1.0), CAPABILITIES)
LIMITS = (ChannelLimits(10.0, 600.0, 0.9),) * CAPABILITIES.channels
SILENT, TONE = DriveCommand(0, 110.0, 0.0), DriveCommand(1, 110.0, 0.5, keep_phase=True)
SAFE = GUARD.check(CommandSet(7, (SILENT, TONE), ramp=0.02, valid_for=0.0))
ENVELOPE = GUARD.check_envelope(Envelope(3, 0.01, (Knot(0.0, 0.0), Knot(1.0, 30.0))))


def test_another_level_frequency_and_phase_are_let_through() -> None:
    """What conversion changes; a level may become 0, where its voltage is below a step."""
    tone = replace(TONE, frequency=55.0, level=0.8, phase=-20.0)
    assert safe_voltages(SAFE, [SILENT, tone], LIMITS).commands[1] == tone
    assert safe_voltages(SAFE, [SILENT, replace(TONE, level=0.0)], LIMITS).is_silent
    knots = [Knot(0.0, 0.0), Knot(0.7, -10.0)]
    assert list(safe_voltage_envelope(ENVELOPE, knots, LIMITS[0]).knots) == knots


@pytest.mark.parametrize(
    ("channel", "changed"),
    [
        (0, {"level": 0.1}),
        (0, {"onset": 1}),
        (1, {"onset": 1}),
        (1, {"ending": 1}),
        (1, {"keep_phase": False}),
        (1, {"skip_ending": True}),
    ],
)
def test_what_the_guard_has_not_seen_is_refused(channel: int, changed: dict[str, object]) -> None:
    """A tone where there was silence, and other envelopes or phases than those that passed."""
    commands = [SILENT, TONE]
    commands[channel] = replace(commands[channel], **changed)
    with pytest.raises(CommandRefused) as refused:
        safe_voltages(SAFE, commands, LIMITS)
    assert refused.value.channel == channel


def test_envelope_that_begins_loud_is_refused() -> None:
    """A knot of silence stays silent."""
    with pytest.raises(CommandRefused):
        safe_voltage_envelope(ENVELOPE, [Knot(0.1, 0.0), Knot(0.7, 0.0)], LIMITS[0])
