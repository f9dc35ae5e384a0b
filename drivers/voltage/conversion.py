"""Drive commands of motion as commands of voltage, and back, by the law of the actuator.

With the response R at the frequency f of motion, and a complex level L in full strokes:

    linear                   u = L / R sin(2 pi f t)
    quadratic with bias b    u = b + L / (2 b R) sin(2 pi f t); the part at 2 f is a harmonic
    quadratic without bias   u = U sin(pi f t + theta), whose square is
                             U^2 / 2 + U^2 / 2 sin(2 pi f t + 2 theta - 90 degrees)
"""

import cmath
import math
from collections.abc import Mapping
from dataclasses import replace

from drivers.command import DriveCommand, Knot
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import MEASURING_ERROR, Capabilities, Feature
from registry.voltage import VoltageDrive

_Q = PROTOCOL.quantities
_DIGITS = 9  # of degrees; beyond them there are sums of floats


def to_voltage(
    command: DriveCommand, drive: VoltageDrive, before: DriveCommand | None = None
) -> DriveCommand:
    """Convert a command of motion; its limits are not checked.

    before: what the channel played last, in voltage. Two phases of a halved frequency give the
    same motion; a tone that continues takes that next to the one before, so that it does not pass
    through zero.
    """
    response = _response(drive, command.frequency)
    force = command.level / abs(response)
    phase = command.phase - math.degrees(cmath.phase(response))
    frequency = command.frequency
    if drive.is_halved:
        frequency, phase = _Q.frequency.quantise(frequency / 2), _wrapped(phase + 90.0) / 2
        if before is not None and command.keep_phase:
            turns = round((before.phase - phase) / 180.0)
            phase += 180.0 * turns
    return replace(
        command,
        frequency=frequency,
        level=drive.voltage_amplitude(force),
        phase=_wrapped(phase),
    )


def knot_in_voltage(knot: Knot, drive: VoltageDrive, frequency: float) -> Knot:
    """Convert a knot of motion at a frequency [Hz], where voltage and motion are proportional."""
    command = to_voltage(DriveCommand(0, frequency, knot.level, knot.phase), drive)
    return Knot(command.level, command.phase)


def to_motion(
    command: DriveCommand, drive: VoltageDrive, requested: float | None = None
) -> DriveCommand:
    """Convert a command of voltage.

    requested [Hz]: of the motion that it was converted from, for what an amplifier achieved of it.
    At another frequency level and phase would differ by the response, beyond the amplifier's steps.
    """
    frequency = 2 * command.frequency if drive.is_halved else command.frequency
    phase = 2 * command.phase - 90.0 if drive.is_halved else command.phase
    at = frequency if requested is None else requested
    response = _response(drive, at)
    return replace(
        command,
        frequency=frequency,
        level=motion_level(command.level, drive, at),
        phase=_wrapped(round(phase + math.degrees(cmath.phase(response)), _DIGITS)),
    )


def motion_level(voltage: float, drive: VoltageDrive, frequency: float) -> float:
    """Level by the amplitude of the voltage, at a frequency [Hz] of motion."""
    return abs(_response(drive, frequency)) * drive.drive_amplitude(voltage)


def capabilities_in_motion(
    capabilities: Capabilities, drives: Mapping[int, VoltageDrive]
) -> Capabilities:
    """Convert the capabilities of an amplifier of voltage; drives: by channel.

    Its highest level is that which voltage and stroke allow at every frequency that is played.
    Without a bias there are neither cross-fades nor envelopes.
    """
    limits = capabilities.limits_of_channels
    reached, steps = [1.0], [capabilities.level_step]
    frequencies = [(0.0, math.inf)]
    for channel, drive in drives.items():
        if channel >= len(limits):
            continue
        factor = 2 if drive.is_halved else 1
        of = limits[channel]
        frequencies.append((factor * of.frequency_min, factor * of.frequency_max))
        swing = min(drive.swing, of.level_max)
        held = replace(drive, maximum=drive.bias + swing)
        _, high = held.reach()
        reached.append(held.level_max())
        # Steepest at the highest voltage; that of the square is twice its share.
        step = max(capabilities.level_step, _Q.level.step)
        if Feature.LEVELS_MEASURED in capabilities.features:
            step += MEASURING_ERROR / 2  # levels are compared within two steps
        steps.append((2 if drive.is_halved else 1) * high / swing * step if swing else step)
    is_halved = any(drive.is_halved for drive in drives.values())
    if is_halved:
        capabilities = replace(
            capabilities,
            envelope_knots=0,
            envelope_slots=0,
            envelope_step_min=0.0,
            envelope_step_max=0.0,
            has_cross_fades=False,
        )
    return replace(
        capabilities,
        frequency_min=max(low for low, _ in frequencies),
        frequency_max=min(high for _, high in frequencies),
        frequency_step=capabilities.frequency_step * (2 if is_halved else 1),
        level_max=min(reached),
        level_step=max(steps),
        phase_step=capabilities.phase_step * (2 if is_halved else 1),
        channel_limits=(),
        features=capabilities.features & ~Feature.VOLTAGE,
        has_exact_fades=False,
    )


def _response(drive: VoltageDrive, frequency: float) -> complex:
    """Response at a frequency [Hz] of motion; at twice the half that the wire carries."""
    return drive.at(2 * _Q.frequency.quantise(frequency / 2) if drive.is_halved else frequency)


def _wrapped(degrees: float) -> float:
    """Wrap a phase into (-180, 180] degrees."""
    wrapped = math.remainder(degrees, 360.0)
    return 180.0 if wrapped == -180.0 else wrapped
