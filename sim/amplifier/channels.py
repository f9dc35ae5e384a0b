"""Outputs of the channels of a simulated amplifier, and the transition between sets."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

from drivers.command import CommandSet, DriveCommand, Envelope
from drivers.protocol.messages import Achieved
from sim.waveform import Output, ShapedTone, end_along, fade_to, level_of, shape_to

_DERATING_RAMP = 0.02  # s; no click


@dataclass(frozen=True)
class PlayableSet:
    """A checked and rounded set with the envelopes it refers to, by channel; asked: as it came."""

    command_set: CommandSet
    asked: CommandSet
    onsets: Mapping[int, Envelope] = field(default_factory=dict)
    endings: Mapping[int, Envelope] = field(default_factory=dict)

    @property
    def token(self) -> int:
        """The set's token."""
        return self.command_set.token

    @property
    def commands(self) -> tuple[DriveCommand, ...]:
        """The set's commands."""
        return self.command_set.commands

    @property
    def achieved(self) -> Achieved:
        """The reply about it."""
        return Achieved(self.token, self.commands)

    def derated(self, factor: float) -> "PlayableSet":
        """The set with all levels scaled, knots included."""
        return replace(
            self,
            command_set=replace(
                self.command_set,
                commands=tuple(
                    replace(command, level=command.level * factor) for command in self.commands
                ),
            ),
            onsets=_derated(self.onsets, factor),
            endings=_derated(self.endings, factor),
        )


class Channels:
    """Outputs of the channels, at first silent, of so many voices; times [s] of any one clock."""

    def __init__(self, count: int, voices: int) -> None:
        self._voices = voices
        self._outputs: tuple[Output, ...] = ((),) * count
        self._endings: Mapping[int, Envelope] = {}
        self._ramp = 0.0  # of the active set

    @property
    def outputs(self) -> tuple[Output, ...]:
        """The output of each channel from now on; the same object until they change."""
        return self._outputs

    @property
    def load(self) -> float:
        """Mean squared settled level of the channels."""
        levels = [sum([abs(tone.settled_amplitude) for tone in output]) for output in self._outputs]
        return sum(level**2 for level in levels) / max(len(levels), 1)

    def levels(self, time: float) -> tuple[float, ...]:
        """Level 0..1 of each channel at a time."""
        # The sum of two fades may round to a little above 1.
        return tuple(min(level_of(output, time), 1.0) for output in self._outputs)

    def silent_from(self, time: float) -> float:
        """Time from which all are silent, not before `time`."""
        return max([time, *(tone.silent_from for output in self._outputs for tone in output)])

    def without_room(self, playable: PlayableSet, time: float) -> int | None:
        """The first channel on which a set would be a voice too many; None to play it."""
        if all(len(playing) < self._voices for playing in self._outputs):
            return None  # a set adds one at most
        after = self._outputs_after(playable, time)
        return next((channel for channel, output in after if len(output) > self._voices), None)

    def play(self, playable: PlayableSet, time: float) -> None:
        """Play a set; channels that it does not name are silenced."""
        self._outputs = tuple([output for _, output in self._outputs_after(playable, time)])
        self._endings = playable.endings
        self._ramp = playable.command_set.ramp

    def _outputs_after(self, playable: PlayableSet, time: float) -> Iterator[tuple[int, Output]]:
        """Each channel and its output once a set plays."""
        commands = {command.channel: command for command in playable.commands}
        ramp = playable.command_set.ramp
        for channel, playing in enumerate(self._outputs):
            command = commands.get(channel) or DriveCommand(channel, 0.0, 0.0)
            onset, ending = playable.onsets.get(channel), self._endings.get(channel)
            if onset is not None:
                output = _shaped(playing, time, command, onset, ramp)
            elif command.level == 0 and ending is not None and not command.skip_ending:
                output = _ended(playing, time, ending, ramp)
            else:
                output = fade_to(
                    playing,
                    time,
                    ramp=ramp,
                    frequency=command.frequency,
                    amplitude=command.phasor,
                    keep_phase=command.keep_phase,
                )
            yield channel, output

    def end(self, time: float) -> None:
        """End the vibration along its endings, or the ramp of its set."""
        self._outputs = tuple(
            _ended(playing, time, self._endings[channel], self._ramp)
            if channel in self._endings
            else fade_to(playing, time, ramp=self._ramp)
            for channel, playing in enumerate(self._outputs)
        )
        self._endings = {}

    def silence(self, time: float, *, ramp: float) -> None:
        """Silence all channels within the ramp, without endings."""
        self._outputs = tuple(fade_to(output, time, ramp=ramp) for output in self._outputs)
        self._endings = {}

    def derate(self, time: float, factor: float) -> None:
        """Scale the levels; phases continue."""
        self._outputs = tuple(_derated_output(output, time, factor) for output in self._outputs)
        self._endings = _derated(self._endings, factor)


def _derated_output(playing: Output, time: float, factor: float) -> Output:
    tone = next((tone for tone in playing if tone.is_lasting), None)
    if tone is None:
        return playing
    levels = (tone.amplitude(time), factor * tone.settled_amplitude)
    derated = ShapedTone(tone.frequency, tone.origin, time, _DERATING_RAMP, levels)
    fading = (one for one in playing if one is not tone and one.silent_from > time)
    return (*fading, derated)


def _derated(envelopes: Mapping[int, Envelope], factor: float) -> dict[int, Envelope]:
    return {
        channel: replace(
            envelope,
            knots=tuple(replace(knot, level=knot.level * factor) for knot in envelope.knots),
        )
        for channel, envelope in envelopes.items()
    }


def _shaped(
    playing: Output, time: float, command: DriveCommand, onset: Envelope, ramp: float
) -> Output:
    return shape_to(
        playing,
        time,
        ramp=ramp,
        step=onset.step,
        knots=_amplitudes(onset),
        frequency=command.frequency,
        amplitude=command.phasor,
        keep_phase=command.keep_phase,
    )


def _ended(playing: Output, time: float, ending: Envelope, ramp: float) -> Output:
    return end_along(playing, time, ramp=ramp, step=ending.step, knots=_amplitudes(ending))


def _amplitudes(envelope: Envelope) -> tuple[complex, ...]:
    return tuple(knot.phasor for knot in envelope.knots)
