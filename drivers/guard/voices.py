"""When the voices of a channel have ended: an amplifier plays only so many (`FADING`).

A voice is what one set plays on a channel, until it has faded. Its end is known as an upper bound:
commits are as late as they can be.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from operator import itemgetter
from typing import NamedTuple

from drivers.command import DriveCommand
from drivers.guard.channel_state import Interval

_END = itemgetter(0)
LAG = 0.002
"""Longest time [s] by which playback lags behind a commit, by the protocol."""


class Voice(NamedTuple):
    """A voice without further sets: latest ends [s], each minus infinity if it is not so.

    lasts_until: of its full amplitude, and lasting: of the fade after that; fading: of the fade
    that it may be in already.
    """

    lasts_until: float = -math.inf
    lasting: float = -math.inf
    fading: float = -math.inf

    @property
    def end(self) -> float:
        """Its latest end [s]."""
        return max(self.lasting, self.fading)


@dataclass(frozen=True, slots=True)
class Voices:
    """The voices of a channel, that with the last end first.

    ending [s]: longest envelope that the newest command may end along, 0 for none.
    """

    voices: tuple[Voice, ...] = ()
    ending: float = 0.0

    def room_from(self, max_voices: int) -> float:
        """When [s] another has room, of so many at most."""
        has_room = len(self.voices) < max_voices
        return -math.inf if has_room else self.voices[max_voices - 1].end + LAG

    def after(
        self,
        command: DriveCommand,
        commit: Interval,
        *,
        ramp: float,
        valid_for: float,
        onset: float,
        ending: float,
    ) -> "Voices":
        """The voices after a command.

        ramp, valid_for: of its set, onset, ending: duration of its envelopes, 0 for none [s].
        """
        is_driven = command.level > 0 or command.onset > 0
        has_ending = self.ending > 0 and not (is_driven or command.skip_ending)
        faded = commit.latest + (max(ramp, self.ending) if has_ending else ramp)
        left: list[tuple[float, Voice]] = []
        for lasts_until, lasting, fading in self.voices:
            under_way = max(fading, lasting) if lasts_until <= commit.latest else fading
            # No ending cuts a fade short.
            end = under_way if has_ending else min(under_way, faded)
            if lasts_until > commit.earliest:
                end = max(end, faded)
            if end > commit.latest:
                left.append((end, Voice(fading=end)))
        if is_driven:
            lasts_until = commit.latest + (valid_for or math.inf)
            onset_end = commit.latest + onset if command.level == 0 else -math.inf
            voice = Voice(lasts_until, lasts_until + max(ramp, ending), onset_end)
            if voice.end > commit.latest:
                left.append((voice.end, voice))
        if len(left) > 1:
            left.sort(key=_END, reverse=True)
        return Voices(tuple([voice for _, voice in left]), ending)


def latest_of(several: Sequence[Voices]) -> Voices:
    """Upper bounds of the voices that sound in any one of several cases."""
    ranks = zip_longest(*(one.voices for one in several), fillvalue=Voice())
    voices = tuple(Voice(*map(max, zip(*rank, strict=True))) for rank in ranks)
    return Voices(voices, max(one.ending for one in several))
