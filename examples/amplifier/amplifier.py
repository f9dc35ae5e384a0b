"""An amplifier without its wire: states, watchdog, sets and fades of the wire protocol.

It imports nothing of era-haptics, and could be rewritten in C. Units are those of the wire:
frequency in 0.05 Hz, level in 1/10000 of full stroke, phase in 0.01 degrees, times in ms. Envelopes
are not supported. A waveform generator reads `levels`: each channel plays
level * sin(2 pi frequency t + phase) from the commit on.
"""

import math
import time
from collections import deque

DISARMED, SWITCHED_ON, ARMED, STOPPED, REACTING, FAULT = 1, 3, 4, 5, 6, 7
NO_FAULT, WATCHDOG = 0, 1
BAD_VALUE, BAD_CHANNEL, WRONG_STATE, BAD_TOKEN, NO_ENVELOPE = 3, 4, 5, 6, 9
WRONG_SESSION, WRONG_LATCH, FADING = 10, 11, 12

CHANNELS = 4
FREQUENCY = (400, 12000)  # range
MAX_RAMP = 1000
VOICES = 2  # of a channel at once
WATCHDOG_RANGE = (100, 2000)
SHORT_FADE = 5
STAGED_LIFE = 1000  # ms until a staged set is forgotten


class Refused(Exception):
    """A refused request: the code of its Nak, and the channel or None."""

    def __init__(self, code, channel=None):
        self.code, self.channel = code, channel


class Amplifier:
    """An amplifier; requests are its methods. Call `update` before each and regularly."""

    def __init__(self, clock=lambda: 1000 * time.monotonic()):
        self._clock = clock
        self.state, self.fault = DISARMED, NO_FAULT
        self.session = self.latch = 0
        self._faults = deque(maxlen=16)
        self._fades = [(0, 0, 0, clock())] * CHANNELS  # level before, after, ramp, begin
        self._voices = [[] for _ in range(CHANNELS)]  # when each has ended
        self._forget()

    def update(self):
        """Handle expired times: the watchdog, the end of a set or of a fade."""
        if self._ends_at is not None and self._clock() >= self._ends_at:
            self._fade_to([0] * CHANNELS, ramp=self._end_ramp, begin=self._ends_at)
            self._ends_at = None
        if self.state == ARMED and self._clock() >= self._expires_at:
            self._fade_to([0] * CHANNELS, ramp=SHORT_FADE, begin=self._expires_at)
            self._ends_at = self._staged = None
            self.state, self.fault = REACTING, WATCHDOG
            self._count_latch()
            self._faults.appendleft((WATCHDOG, self._expires_at))
        if self._is_silent():
            self.state = {SWITCHED_ON: DISARMED, REACTING: FAULT}.get(self.state, self.state)

    @property
    def levels(self):
        """Current level of each channel."""
        return self._levels_at(self._clock())

    @property
    def faults(self):
        """Faults with their ages, newest first."""
        return [(fault, round(self._clock() - since)) for fault, since in self._faults]

    @property
    def high_voltage(self):
        """Whether the high voltage is on."""
        return self.state in (SWITCHED_ON, ARMED, REACTING) or not self._is_silent()

    @property
    def watchdog_left(self):
        """Time until the watchdog expires, 0 while disarmed."""
        return max(0, round(self._expires_at - self._clock())) if self.state == ARMED else 0

    def _levels_at(self, moment):
        levels = []
        for before, after, ramp, begin in self._fades:
            share = min(max((moment - begin) / ramp, 0.0), 1.0) if ramp > 0 else 1.0
            rising = (1 - math.cos(math.pi * share)) / 2
            levels.append(round(before * (1 - rising) + after * rising))
        return levels

    def _fade_to(self, levels, *, ramp, begin=None):
        begin = self._clock() if begin is None else begin
        before = self._levels_at(begin)
        for channel, (_, after, its_ramp, since) in enumerate(self._fades):
            is_silent = not after and not levels[channel]
            if not (is_silent and since + its_ramp <= begin + ramp):  # silence never comes later
                self._fades[channel] = (before[channel], levels[channel], ramp, begin)
        for channel, level in enumerate(levels):
            self._voices[channel] = self._fading(channel, ramp, begin) + [math.inf] * (level > 0)

    def _fading(self, channel, ramp, begin):
        """When the voices of a channel end that a set leaves to fade."""
        ends = [min(end, begin + ramp) for end in self._voices[channel]]
        return [end for end in ends if end > begin]

    def _is_silent(self):
        now = self._clock()
        return all(not after and now >= begin + ramp for _, after, ramp, begin in self._fades)

    def _forget(self):
        self.token, self._staged, self._ends_at = 0, None, None
        self._playing, self._staged_at = None, 0

    def _count_latch(self):
        self.latch = self.latch % 255 + 1

    def ping(self, session):
        """Restart the watchdog; other requests with the session do, too."""
        if self.state == ARMED:
            if session != self.session:
                raise Refused(WRONG_SESSION)
            self._expires_at = self._clock() + self._watchdog

    def arm(self, watchdog, session):
        """Switch the high voltage on and enable all channels at level zero."""
        if not WATCHDOG_RANGE[0] <= watchdog <= WATCHDOG_RANGE[1] or not 1 <= session <= 65535:
            raise Refused(BAD_VALUE)
        if self.state not in (DISARMED, SWITCHED_ON, ARMED):
            raise Refused(WRONG_STATE)
        if (session == self.session) != (self.state == ARMED):  # another's, or one that has ended
            raise Refused(WRONG_SESSION)
        self._watchdog = watchdog
        if self.state != ARMED:
            self._silence(SHORT_FADE)
            self._forget()
            self.state, self.session = ARMED, session
        self.ping(session)

    def disarm(self, ramp):
        """Fade to silence, then switch the high voltage off; a latched state stays."""
        self._silence(ramp)
        if self.state == ARMED:
            self.state = SWITCHED_ON

    def stop(self, ramp):
        """Stop quickly and latch."""
        self._silence(ramp)
        self._count_latch()
        if self.state in (DISARMED, SWITCHED_ON, ARMED):
            self.state = STOPPED

    def clear(self, latch):
        """Leave a stop or a fault once silent; latch: its number."""
        if self.state in (STOPPED, FAULT) and latch != self.latch:
            raise Refused(WRONG_LATCH)
        if self.state == FAULT or (self.state == STOPPED and self._is_silent()):
            self.state, self.fault = DISARMED, NO_FAULT

    def stage(self, session, token, ramp, valid_for, commands):
        """Hold a set of (channel, flags, frequency, level, phase) until its commit; return it."""
        self._check(session, token, ramp, valid_for, commands)
        self._staged, self._staged_at = (token, ramp, valid_for, commands), self._clock()
        self.ping(session)
        return token, commands

    def commit(self, session, token):
        """Play the set staged under a token; repeat the reply for the one playing."""
        self._check_token(session, token)
        if token != self.token:
            is_old = self._clock() - self._staged_at > STAGED_LIFE
            if self._staged is None or token != self._staged[0] or is_old:
                raise Refused(BAD_TOKEN)
            self._play(self._staged)
        self.ping(session)
        return token, self._playing[3]

    def apply(self, session, token, ramp, valid_for, commands):
        """Play a set; repeat the reply for the same set again."""
        if token != self.token:
            self._check(session, token, ramp, valid_for, commands)
            self._play((token, ramp, valid_for, commands))
        elif self._playing != (token, ramp, valid_for, commands):
            self._check_token(session, token)
            raise Refused(BAD_TOKEN)
        return self.commit(session, token)

    def _play(self, wanted):
        """Play a checked set, if its channels have room for it."""
        token, ramp, valid_for, commands = wanted
        for channel, _, _, level, _ in commands:
            if level > 0 and len(self._fading(channel, ramp, self._clock())) > VOICES - 1:
                raise Refused(FADING, channel)
        self._playing, self._staged, self.token = wanted, None, token
        levels = [0] * CHANNELS  # channels without a command fall silent
        for channel, _, _, level, _ in commands:
            levels[channel] = level
        self._fade_to(levels, ramp=ramp)
        self._ends_at = self._clock() + valid_for if valid_for else None
        self._end_ramp = ramp

    def _silence(self, ramp):
        self._fade_to([0] * CHANNELS, ramp=min(max(ramp, 0), MAX_RAMP))
        self._staged, self._ends_at = None, None

    def _check_token(self, session, token):
        if self.state != ARMED:
            raise Refused(WRONG_STATE)
        if session != self.session:
            raise Refused(WRONG_SESSION)
        if not 1 <= token <= 65535:
            raise Refused(BAD_TOKEN)

    def _check(self, session, token, ramp, valid_for, commands):
        """Check a whole set; raise Refused."""
        self._check_token(session, token)
        if self.token and not 1 <= (token - self.token) % 65536 <= 32767:
            raise Refused(BAD_TOKEN)  # a late copy
        if not (0 <= ramp <= MAX_RAMP and 0 <= valid_for <= 60000):
            raise Refused(BAD_VALUE)
        seen = set()
        for channel, _, frequency, level, phase in commands:
            if not 0 <= channel < CHANNELS or channel in seen:
                raise Refused(BAD_CHANNEL, channel)
            seen.add(channel)
            in_range = FREQUENCY[0] <= frequency <= FREQUENCY[1] or level == 0
            if not (in_range and 0 <= level <= 10000 and -18000 <= phase <= 17999):
                raise Refused(BAD_VALUE, channel)
