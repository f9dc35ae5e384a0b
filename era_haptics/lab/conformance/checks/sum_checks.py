"""Checks of the sum of a channel: interference of phases, limited voices, full level."""

import asyncio
import math
from functools import partial

from drivers.protocol.definition import HIGH_TIME, HIGH_WORDS, MESSAGES, has_flag
from drivers.protocol.sets import Command, Envelope
from era_haptics.lab.conformance.check import driving
from era_haptics.lab.conformance.outcomes import expect_equal, require
from era_haptics.lab.conformance.request_rows import (
    FULL,
    SILENCE_NOW,
    RequestRows,
    Row,
    Wait,
    layer,
    play_now,
)
from era_haptics.lab.conformance.subject import Subject
from registry import threads

_SLOW = 400  # steps of frequency: 20 Hz, whose period is long compared with an exchange
_LONG = 1.0  # s; phase errors accumulate over this time
_MAX_VOICES = 24  # tried at most
_MOMENTS = 6  # sets during the first fade that start at a moment
_OTHER_SETS = 8  # sets during the first fade, in addition to fades and moments
_SHARES = 0.41, 0.1, 0.06  # test-level fractions of the voices that are cut short
_REMAINING = 0.0035, 0.0008  # s; remaining time of a fade that counts, and too short to count
_PEAK_TIME = 0.15  # s; a sum reaches its peak within this time
_UNTIL_PEAK = Wait(_PEAK_TIME)


@driving("protocol.md#the-clock")
async def phases(subject: Subject) -> None:
    """Two tones at the same frequency: they add by phase, whenever each began.

    Compute the angle as n times clock modulo 2^32 at every sample; do not start a phase at the
    commit, and do not accumulate rounded steps.
    """
    await subject.arm()
    await _require_interference(subject)
    first = layer(0, *(subject.tone(channel, 0.5, 30.0) for channel in subject.channels))
    for number in subject.layers[1:]:
        angle = 30.0 + 40.0 * number
        tones = [subject.tone(channel, 0.5, angle + 5.0 * channel) for channel in subject.channels]
        silent = [layer(other) for other in subject.layers[1:] if other != number]
        await subject.run([play_now(first, layer(number, *tones), *silent)])
    period = 20 / max(subject.lowest, _SLOW)
    for phase, periods in ((0.0, 0.25), (0.0, 0.5), (90.0, 0.75), (180.0, 0.5)):
        await subject.in_time(partial(_expect_same_sum, subject, phase, periods * period))
    await subject.in_time(partial(_expect_cancellation, subject))


async def _require_interference(subject: Subject) -> None:
    """Raise NotApplicable unless levels show that tones at the same frequency cancel."""
    opposite_tones = [
        layer(number, subject.tone(0, 0.5, phase)) for number, phase in enumerate((0.0, 180.0))
    ]
    await subject.play(*opposite_tones)
    level = (await subject.request("GetStatus"))["levels"][0]
    await subject.play(layer(0), layer(1))
    shows_interference = level <= 0.75 * subject.level * FULL  # phases may be rounded
    reason = "the levels do not show that tones at the same frequency interfere"
    require(shows_interference, reason)
    subject.judge.outputs.interferes = True


async def _expect_same_sum(subject: Subject, phase: float, time: float) -> None:
    """Play two slow tones a time [s] apart, the first renewed, then again, that time later."""
    await subject.arm()
    subject.judge.outputs.interferes = True
    frequency = max(subject.lowest, _SLOW)
    first = layer(0, subject.tone(0, 0.5, 0.0, frequency=frequency))
    second = layer(1, subject.tone(0, 0.5, phase, frequency=frequency))
    renewed = layer(0, renew=True)
    wait = Wait(time)
    await subject.run([first, wait, renewed, second, wait, first, wait, subject.status])


async def _expect_cancellation(subject: Subject) -> None:
    """Play the opposite of a tone that began a second earlier, before the clock wrapped."""
    await subject.status()
    remaining = HIGH_WORDS - subject.judge.clock.present
    shift = remaining - round(_LONG / 2 / HIGH_TIME)
    await subject.arm(shift=shift % HIGH_WORDS)
    subject.judge.outputs.interferes = True
    frequency = subject.close_frequency(1) | 1
    tone = layer(0, subject.tone(0, 0.5, 0.0, frequency=frequency))
    opposite = layer(1, subject.tone(0, 0.5, 180.0, frequency=frequency))
    await subject.run([tone, Wait(_LONG), opposite, subject.status])


@driving("protocol.md#voices")
def voices(subject: Subject) -> RequestRows:
    """More voices than `voices` on a channel: the oldest fades end within 2 ms, no refusal.

    Count only voices that last longer than 2 ms, keep a spare voice for each layer, and shorten
    released voices in the order in which their paths began.
    """
    plan = VoicePlan(subject)
    follow = partial(subject.follow, 0.015)
    silence = SILENCE_NOW
    cuts: list[Row] = []
    for number in range(plan.fades, plan.fades + len(_SHARES)):
        cuts += [partial(plan.play_at_moment, number), follow]
    # A full pool refuses neither another layer nor a layer's silence, nor a fade of all.
    extra_layer = layer(1, *plan.tones(plan.count + 1), ramp=plan.ramp)
    fade_all = play_now(*(layer(number, ramp=plan.ramp) for number in subject.layers[:3]))
    full: list[Row] = [extra_layer, fade_all, play_now(subject.layer_0()), silence]
    one_free = partial(plan.fade, plan.fades - 1)
    two_free = partial(plan.fade, plan.fades - 2)
    courses: list[Row] = [
        # The oldest tone fades last: the fade that began first is cut off.
        (plan.lasting, one_free, layer(1, ramp=plan.ramp), *cuts, *full),
    ]
    for remaining in _REMAINING:
        count = partial(plan.count_until, remaining)
        courses.append((plan.lasting, two_free, count, follow, silence))
    return courses


class VoicePlan:
    """Tones and fades that use all voices of two channels.

    count: number of voices to use. fades: number of fading voices, in all layers but the last.
    ramp: of fades [ms]. lasting: set with a lasting tone in every layer but layer 0.
    """

    def __init__(self, subject: Subject) -> None:
        self._subject = subject
        self._channels = sorted({0, subject.channels[-1]})
        last = subject.layers[-1]
        self.count: int = min(subject.can["voices"], _MAX_VOICES)
        self.fades: int = self.count - last
        self._bulk = subject.layers[1:-1]  # layers of the fades that are not cut
        self._jump = subject.envelope(0.0001)  # onset to the level
        self._pause = 0.004 + self._jump.step / 10_000  # s; until a tone is at its level
        self._quiet = (1 - sum(_SHARES)) / (self.count + 2)  # share of the other voices
        ramp_max = subject.ramp_max
        duration = self._sets() * (subject.timing.exchange_time + self._pause)
        self._lead = subject.lead(_MOMENTS, ramp_max / 1000 - duration)
        duration += _MOMENTS * self._lead
        subject.require_ramp(duration)
        self.ramp = min(max(math.ceil(2500 * duration), 200), ramp_max)
        self._ending = self._slow_ending()
        self.lasting = play_now(
            *(layer(number, *self.tones(self.count + number)) for number in subject.layers[1:])
        )

    def _sets(self) -> int:
        """Return the number of sets during the first fade, without those at a moment."""
        bulk_fades = self.fades - len(_SHARES)
        bulk_sets = max(math.ceil(bulk_fades / len(self._bulk)), 0)
        return len(_SHARES) + bulk_sets + _OTHER_SETS

    def _slow_ending(self) -> Envelope | None:
        """Return an ending that lasts longer than the ramp; None with too few knots."""
        ending = self._subject.envelope(0.1, *[_SHARES[1]] * 8)
        duration = ending.step * (len(ending.knots) + 1)
        return ending if duration >= 10 * self.ramp / 3 else None

    def tones(self, number: int, ending: Envelope | None = None) -> list[Command]:
        """Return a tone for each channel, with a frequency of its own."""
        share = _SHARES[number] if number < len(_SHARES) else self._quiet
        frequency = self._subject.close_frequency(number)
        tones = []
        for channel in self._channels:
            tone = self._subject.tone(
                channel, share, frequency=frequency, onset=self._jump, ending=ending
            )
            tones.append(tone)
        return tones

    async def fade(self, count: int) -> None:
        """Start fading tones, then lasting ones: the first fade is the longest, the next uses its
        ending.

        After the few that are cut, fades start together, in as many layers as there are.
        """
        subject = self._subject
        for number in range(min(count, len(_SHARES)) + 1):
            ending = self._ending if number == 1 else None
            tones = self.tones(number, ending)
            await subject.play(layer(0, *tones, ramp=self.ramp - number))
            await asyncio.sleep(self._pause)
            if ending is not None:
                await subject.play(layer(0))
        last = subject.layers[-1]
        for remaining in range(count - len(_SHARES), 0, -len(self._bulk)):
            layers = []
            for layer_number in self._bulk[:remaining]:
                tones = self.tones(last + self.count + remaining + layer_number)
                layers.append(layer(layer_number, *tones, ramp=self.ramp))
            await subject.play(*layers)
            await asyncio.sleep(self._pause)

    async def play_at_moment(self, number: int) -> None:
        """Begin a tone at a moment, which ends the one before."""
        content = layer(0, *self.tones(number), ramp=self.ramp)
        await self._subject.play_at_moment(content, lead=self._lead)

    async def count_until(self, remaining: float) -> None:
        """Begin a tone while the fade that began last has a time left [s]."""
        subject = self._subject
        ramp = math.ceil(2000 * self._lead)
        fading = layer(0, *self.tones(self.fades - 1), ramp=ramp)
        following = layer(0, *self.tones(self.fades), ramp=self.ramp)
        await subject.play_at_moment(fading, lead=self._lead)
        spacing = ramp / 1000 - remaining
        await subject.play_at_moment(following, lead=self._lead, spacing=spacing)


@driving("protocol.md#sum-of-a-channel")
async def limited(subject: Subject) -> None:
    """Sum above full level: cut off, and flagged once.

    Note every sample whose sum exceeds full level by more than a step of level, show the flag in
    the next Status, then clear it.
    """
    is_loud = subject.level * 2 > 1.0
    require(is_loud, "tested only above half of full level; see --level")
    if subject.client.has_broadcasts:
        await subject.client.look_around()
    difference = abs(subject.second_frequency - subject.frequency)
    has_two_frequencies = difference >= subject.can["frequency_step"]
    require(has_two_frequencies, "all tones have the same frequency and interfere")
    last = subject.channels[-1]
    above = layer(1, subject.tone(frequency=subject.second_frequency))
    at_full_level = layer(1, subject.tone(last, 1.0 / subject.level - 1.0))
    just_above = layer(1, subject.tone(last, 1.01 / subject.level - 1.0))
    sums: list[Row] = [_UNTIL_PEAK, above, _UNTIL_PEAK, layer(1), at_full_level, _UNTIL_PEAK]
    await subject.run(
        [
            subject.arm,
            subject.all_channels(),
            at_full_level,
            *sums,
            just_above,
            _UNTIL_PEAK,
            *sums,
        ]
    )
    await _expect_unseen_limit(subject, "Ping")
    opposite = layer(1, subject.tone(0, 1.0, 180.0))
    await subject.run([layer(1), play_now(subject.layer_0(), opposite), _UNTIL_PEAK])
    status = await subject.request("GetStatus")
    is_limited = has_flag(status.values, "limited")
    expect_equal(is_limited, False, "flag limited for tones that cancel")
    await _expect_unseen_limit(subject, "Stop", ramp=0)


async def _expect_unseen_limit(subject: Subject, name: str, **values: int) -> None:
    """Exceed full level during a fade that no earlier status shows, then read by a request."""
    above = layer(1, subject.tone(frequency=subject.second_frequency))
    fading = play_now(subject.all_channels(), layer(1, ramp=subject.ramp))
    await subject.send_all([play_now(layer(0), above), fading])
    await asyncio.sleep(_PEAK_TIME)
    await subject.request("GetAchieved", layer=0)
    client = subject.client
    if client.has_broadcasts and not client.neighbors:
        await _broadcast_commit(subject)
    reply = await subject.request(name, **values)
    is_limited = has_flag(reply.values, "limited")
    expect_equal(is_limited, True, "flag limited after a sum above full level")


async def _broadcast_commit(subject: Subject) -> None:
    """Broadcast the Commit of the last token again: without a Status, it must not clear a flag."""
    sent_at = threads.now()
    message = MESSAGES["Commit"]
    values = subject.filled({"token": subject.sets.token, "at": 0})
    data = subject.client.request(message.number, message.request.pack(values), to=0)
    await subject.client.expect_silence(data, "a broadcast Commit")
    subject.judge.granted("Commit", values, {}, subject.since(sent_at))
