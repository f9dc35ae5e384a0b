"""Sets and envelopes as the wire rounds them: ramps upward, so that no level rises faster."""

import math

from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.protocol.definition import PROTOCOL, WireQuantity

TOLERANCE = 1 + 1e-9
"""Factor by which a sum of floats may exceed a limit."""

_SLACK = 1e-6  # of a step; sums of floats
_Q = PROTOCOL.quantities


def rounded_set(command_set: CommandSet, *, idle_frequency: float, ramp_max: float) -> CommandSet:
    """Return a set that passed the rules as the wire carries it.

    A silent channel gets idle_frequency [Hz], which the amplifier accepts; ramp_max [s]: of the
    amplifier.
    """
    valid_for = float(command_set.valid_for)
    return CommandSet(
        token=int(command_set.token),
        commands=tuple(_rounded(command, idle_frequency) for command in command_set.commands),
        ramp=min(_rounded_up(command_set.ramp), ramp_max),
        # Must not be rounded to 0, which means without end.
        valid_for=max(_Q.valid_for.quantise(valid_for), _Q.valid_for.step) if valid_for else 0.0,
    )


def rounded_envelope(envelope: Envelope) -> Envelope:
    """Return an envelope that passed the rules as the wire carries it."""
    return Envelope(
        slot=int(envelope.slot),
        step=_Q.envelope_step.quantise(float(envelope.step)),
        knots=tuple(
            Knot(_Q.level.quantise(float(knot.level)), _Q.phase.quantise(float(knot.phase)))
            for knot in envelope.knots
        ),
    )


def rounded_down(value: float, quantity: WireQuantity) -> float:
    """Return a value rounded down to a step of the wire."""
    return math.floor(value * quantity.per_unit) / quantity.per_unit


def _rounded(command: DriveCommand, idle_frequency: float) -> DriveCommand:
    return DriveCommand(
        channel=int(command.channel),
        frequency=_Q.frequency.quantise(float(command.frequency))
        if command.level > 0 or command.onset
        else idle_frequency,
        level=_Q.level.quantise(float(command.level)),
        phase=_Q.phase.quantise(float(command.phase)),
        keep_phase=bool(command.keep_phase),
        onset=int(command.onset),
        ending=int(command.ending),
        skip_ending=bool(command.skip_ending),
    )


def _rounded_up(ramp: float) -> float:
    """Round a ramp [s] to the next step of the wire."""
    return math.ceil(float(ramp) * _Q.ramp.per_unit - _SLACK) / _Q.ramp.per_unit
