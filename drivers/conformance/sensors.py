"""Checks of sensors: what they are, when a reading is complete, and what it reads."""

import cmath
import math
from collections.abc import Awaitable, Callable, Sequence

from drivers import clock
from drivers.command import CommandSet, DriveCommand
from drivers.conformance.bench import Bench
from drivers.conformance.check import driving, reading
from drivers.conformance.findings import NotApplicable, expect
from drivers.guard import SafeCommandSet
from drivers.guard.channel_state import Interval
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Feature, Reading, ReadingState, Sensor

_PLACE = "wire-protocol.md#sensors"
_WINDOW = 0.15  # s; periods of 110 Hz and of differences to it are no whole numbers
_SETTLING = 3.0  # s; longest
_SETTLED = 0.005  # of the largest amplitude; from one window to the next
_ALIKE = 0.02  # of the largest amplitude; of readings that must be equal
_RAW = 0.05  # of raw samples and the reading, without a fit
_MIN_KEPT = 256  # raw samples
_FLOOR = 1e-4  # of the range; a plate that vibrates less is none
_SLACK = 0.002  # s; of times in milliseconds


@reading("wire-protocol.md#getsensors")
async def sensor_descriptions(bench: Bench) -> None:
    """It describes its sensors consistently, the same again, from any of them on."""
    found = await _sensors(bench)
    channels = bench.can.channels
    for number, one in enumerate(found):
        what = f"sensor {number}"
        is_known = one.unit in PROTOCOL.sensor_units.values() or one.unit >= PROTOCOL.vendor_numbers
        expect(is_known, f"{what}: unit", expected="one of the table", seen=int(one.unit))
        has_channel = one.channel is None or one.channel < channels
        expect(has_channel, f"{what}: channel", expected=f"below {channels}", seen=one.channel)
        expect(one.range > 0, f"{what}: range", expected="above 0", seen=one.range)
        above = one.frequency_max
        expect(above > 0, f"{what}: frequency_max", expected="above 0", seen=above)
        has_step = (one.count_step > 0) == (one.sample_rate > 0)
        expect(has_step, f"{what}: count_step", expected="with a sample_rate", seen=one.count_step)
        expect(
            not one.sample_rate or 2 * one.frequency_max < one.sample_rate,
            f"{what}: frequency_max",
            expected="below half its sample_rate",
            seen=one.frequency_max,
        )
    places = [(one.unit, one.channel, one.x, one.y) for one in found]
    expect(len({*places}) == len(places), "sensors", expected="each elsewhere", seen=places)
    for first in (0, 1, len(found)):
        listed = await bench.amplifier.sensors(first)
        what = f"sensors from {first} on"
        expect(listed == found[first:], what, expected=found[first:], seen=listed)


@reading(_PLACE)
async def readings(bench: Bench) -> None:
    """It completes a reading when its window ends; refuses tones that it cannot tell apart."""
    found, amplifier = await _sensors(bench), bench.amplifier
    tone = _tone(bench, found)
    started, since = await bench.timed(amplifier.start_reading([tone], _WINDOW))
    running = ReadingState.RUNNING
    expect(started.state is running, "state", expected=running.name, seen=started.state.name)
    _expect_left(started, _WINDOW)
    before, now = since.earliest, started
    while now.state is running:
        now, when = await bench.timed(amplifier.reading(PROTOCOL.quantities.sensor.maximum))
        if now.state is not running:
            break
        _expect_left(now, _WINDOW - (when.earliest - since.latest))
        expect(not now.sensors, "sensors before its end", expected="none", seen=len(now.sensors))
        before = when.earliest
        late = clock.now() - since.latest - _WINDOW
        expect(late < 1, "state", expected="complete after the window", seen=now.state.name)
        await bench.pause_until(clock.now() + min(0.005, now.left))
    ended = Interval(before - since.latest, when.latest - since.earliest)
    bench.expect_time("end of the window", ended, low=_WINDOW, high=_WINDOW, coarse=0.01)
    whole = await amplifier.finish_reading(started)
    _expect_state(whole, ReadingState.COMPLETE, after="nothing has changed")
    expect(
        len(whole.sensors) == len(found) and all(len(one.tones) == 1 for one in whole.sensors),
        "sensors and tones",
        expected=(len(found), 1),
        seen=(len(whole.sensors), whole.tone_count),
    )
    token = (await amplifier.status()).token
    expect(whole.token == token, "token", expected=token, seen=whole.token)
    too_high = min(_highest(found) + 1, PROTOCOL.quantities.frequency.high)
    refused = {
        "a tone of less than a period": [0.8 / _WINDOW],
        "tones that the window does not tell apart": [tone, tone + 0.8 / _WINDOW],
        "the same tone twice": [tone, tone],
        **({"a tone above frequency_max": [too_high]} if too_high > _highest(found) else {}),
    }
    for what, tones in refused.items():
        await bench.refused(amplifier.start_reading(tones, _WINDOW), what=what)
    kept = await amplifier.reading()
    expect(
        kept.number == started.number,
        "reading after a refused Measure",
        expected=started.number,
        seen=kept.number,
    )


@driving(_PLACE)
async def readings_change_nothing(bench: Bench) -> None:
    """It neither feeds its watchdog nor changes what plays because it measures."""
    tone = _tone(bench, await _sensors(bench))
    await bench.arm()
    played = bench.tones(1.0)
    await bench.apply(played)
    amplifier = bench.amplifier
    calls: dict[str, Callable[[], Awaitable[object]]] = {
        "GetSensors": amplifier.sensors,
        "Measure": lambda: amplifier.start_reading([tone], _WINDOW),
        "GetReading": amplifier.reading,
    }
    for name, call in calls.items():
        await bench.pause_until(bench.fed.latest + 0.05)
        await call()
        sample = await bench.sample()
        if bench.has(Feature.WATCHDOG):
            bench.expect_not_fed(sample, by=name)
        await bench.expect_levels(1.0, why=f"after {name}")
        seen = (sample.status.state.name, sample.status.token)
        expected = ("OPERATION_ENABLED", played.token)
        expect(seen == expected, f"state and token after {name}", expected=expected, seen=seen)
        await bench.beat()


@driving(_PLACE)
async def disturbed_readings(bench: Bench) -> None:
    """It calls a reading disturbed if what plays changed within its window, only then."""
    tone, amplifier = _tone(bench, await _sensors(bench)), bench.amplifier
    await bench.arm()
    played = bench.tones(1.0)
    committed = await bench.apply(played)
    await bench.wait(0.05)  # so that t differs from 0
    started, when = await bench.timed(amplifier.start_reading([tone], _WINDOW))
    await bench.apply(played)  # again: it is played once
    whole = await _finished(bench, started)
    _expect_state(whole, ReadingState.COMPLETE, after="a repeated Apply")
    expect(whole.token == played.token, "token", expected=played.token, seen=whole.token)
    low, high = when.earliest - committed.latest, when.latest - committed.earliest
    expect(
        low - _SLACK <= whole.start <= high + _SLACK,
        "window_start",
        expected=f"{low:.4f} to {high:.4f} s",
        seen=f"{whole.start:.4f} s",
    )
    started = await amplifier.start_reading([tone], _WINDOW)
    await bench.apply(bench.tones(0.5))
    whole = await _finished(bench, started)
    _expect_state(whole, ReadingState.DISTURBED, after="a set was committed")
    expect(whole.token == played.token, "token", expected=played.token, seen=whole.token)
    started = await amplifier.start_reading([tone], _WINDOW)
    await amplifier.stop(0.0)
    whole = await amplifier.finish_reading(started)
    _expect_state(whole, ReadingState.DISTURBED, after="a Stop")


@driving(_PLACE)
async def readings_of_tones(bench: Bench) -> None:
    """It reads the same tone alike again, half of half the level, and two at once as each alone."""
    found = await _sensors(bench)
    tone = _tone(bench, found)
    beside = bench.guard.limits.frequency_max, _highest(found)
    other = _on_step(bench, min(1.27 * tone, *beside) if bench.can.channels > 1 else tone / 1.27)
    await bench.arm()
    await bench.play(1.0)
    tones = [tone, other, _on_step(bench, tone / 2)]
    full = await _settled(bench, tones)
    largest, *others = (_largest(full, at) for at in range(len(tones)))
    if max(largest, *others) < _FLOOR * min(one.range for one in found):
        raise NotApplicable("nothing vibrates: its actuators carry no plate")
    expect(
        largest > max(others),
        f"largest amplitudes at {tone:g} Hz, which plays, and at {tones[1:]}, which do not",
        expected="the first above the others",
        seen=(f"{largest:.4g}", *(f"{one:.4g}" for one in others)),
    )
    _expect_alike(await _measured(bench, tones), full, what="the same again")
    await bench.play(0.5)
    half = await _settled(bench, [tone])
    _expect_alike(half, full, what="half the level", factor=0.5)
    if bench.can.channels < 2:
        return
    alone = bench.tones(1.0, first=1, frequency=other)
    await bench.apply(alone)
    second = await _settled(bench, [other])
    await bench.apply(_both(bench, tone, other))
    together = await _settled(bench, [tone, other])
    _expect_alike(together, full, what="the first of two tones at once")
    _expect_alike(together, second, what="the second of two tones at once", at=1)


@driving("wire-protocol.md#getblock")
async def raw_samples(bench: Bench) -> None:
    """It keeps raw samples of the window, of which its readings are made."""
    found, amplifier = await _sensors(bench), bench.amplifier
    sampled = [number for number, one in enumerate(found) if one.sample_rate]
    if not sampled:
        raise NotApplicable("it states no sample_rate")
    tone = _tone(bench, found)
    await bench.arm()
    await bench.play(1.0)
    whole = await _settled(bench, [tone])
    number = max(sampled, key=lambda one: whole.sensors[one].tones[0].amplitude / found[one].range)
    sensor, read = found[number], whole.sensors[number].tones[0]
    block = await amplifier.raw_samples(number)
    first, counts = block.first, list(block.samples)
    while block.samples and first + len(counts) < block.end:
        block = await amplifier.raw_samples(number, first + len(counts))
        await bench.beat()
        seen = (block.number, block.first)
        expected = (whole.number, first + len(counts))
        expect(seen == expected, "reading and first sample", expected=expected, seen=seen)
        counts += block.samples
    end = round(_WINDOW * sensor.sample_rate)
    expect(abs(block.end - end) <= 1, "number of samples", expected=end, seen=block.end)
    least = min(_MIN_KEPT, end)
    expect(len(counts) >= least, "samples kept", expected=f"{least} at least", seen=len(counts))
    amplitude = 2 * abs(_correlation(counts, tone / sensor.sample_rate)) * sensor.count_step
    if read.amplitude < _FLOOR * sensor.range:
        raise NotApplicable("nothing vibrates: its actuators carry no plate")
    allowed = _RAW * read.amplitude + sensor.count_step
    expect(
        abs(amplitude - read.amplitude) <= allowed,
        "amplitude of the raw samples",
        expected=f"{read.amplitude:.4g}, as the reading",
        seen=f"{amplitude:.4g}",
    )


async def _sensors(bench: Bench) -> tuple[Sensor, ...]:
    bench.require(Feature.SENSORS)
    found = await bench.amplifier.sensors()
    expect(bool(found), "sensors", expected="at least one, with the feature", seen="none")
    return found


def _highest(found: Sequence[Sensor]) -> float:
    return min(one.frequency_max for one in found)


def _tone(bench: Bench, found: Sequence[Sensor]) -> float:
    """The frequency under test [Hz], as it is played and sent."""
    if bench.frequency > _highest(found):
        raise NotApplicable(f"its sensors measure below {bench.frequency:g} Hz only")
    return _on_step(bench, bench.frequency)


def _on_step(bench: Bench, frequency: float) -> float:
    step = max(bench.can.frequency_step, PROTOCOL.quantities.frequency.step)
    return round(frequency / step) * step


def _both(bench: Bench, tone: float, other: float) -> SafeCommandSet:
    """A set of two tones [Hz] at once, on the first two channels."""
    commands = (DriveCommand(0, tone, bench.level), DriveCommand(1, other, bench.level))
    token = bench.amplifier.next_token()
    return bench.guard.check(CommandSet(token, commands, ramp=0.0, valid_for=0.0))


async def _measured(bench: Bench, frequencies: Sequence[float]) -> Reading:
    """A reading while the watchdog is fed."""
    return await _finished(bench, await bench.amplifier.start_reading(frequencies, _WINDOW))


async def _finished(bench: Bench, started: Reading) -> Reading:
    await bench.wait(started.left)
    return await bench.amplifier.finish_reading(started)


async def _settled(bench: Bench, frequencies: Sequence[float]) -> Reading:
    """A reading that equals the one before: the plate has settled, as it must."""
    tones = range(len(frequencies))
    began = clock.now()
    before, end = await _measured(bench, frequencies), began + _SETTLING
    while True:
        now = await _measured(bench, frequencies)
        change = max(_difference(now, before, at=at, to=at) for at in tones)
        allowed = _SETTLED * max(_largest(now, at) for at in tones)
        if change <= allowed:
            return now
        expect(
            clock.now() < end,
            f"change of a reading after {_SETTLING:g} s of the same tones",
            expected=f"at most {allowed:.3g}",
            seen=f"{change:.3g}",
            is_certain=bench.delayed_since(began) < _SETTLING / 10,
        )
        before = now


def _difference(
    one: Reading, other: Reading, *, at: int = 0, to: int = 0, factor: float = 1.0
) -> float:
    """The largest difference of a tone of a reading to one of another, by their places."""
    pairs = zip(one.sensors, other.sensors, strict=True)
    return max(abs(a.tones[at].phasor - factor * b.tones[to].phasor) for a, b in pairs)


def _largest(one: Reading, at: int) -> float:
    return max(sensor.tones[at].amplitude for sensor in one.sensors)


def _expect_alike(
    seen: Reading, expected: Reading, *, what: str, at: int = 0, factor: float = 1.0
) -> None:
    allowed = _ALIKE * factor * _largest(expected, 0)
    difference = _difference(seen, expected, at=at, factor=factor)
    expect(
        difference <= allowed,
        f"difference of readings ({what})",
        expected=f"at most {allowed:.3g}",
        seen=f"{difference:.3g}",
    )


def _expect_state(whole: Reading, state: ReadingState, *, after: str) -> None:
    seen = whole.state.name
    expect(whole.state is state, f"state after {after}", expected=state.name, seen=seen)


def _expect_left(now: Reading, highest: float) -> None:
    expect(
        0 <= now.left <= highest + _SLACK,
        "window_left",
        expected=f"0 to {highest * 1e3:.0f} ms",
        seen=f"{now.left * 1e3:.0f} ms",
    )


def _correlation(counts: Sequence[int], cycles: float) -> complex:
    """Mean of counts without their mean, times a phase factor of so many cycles a sample."""
    mean = sum(counts) / len(counts)
    turned = (
        (count - mean) * cmath.exp(-2j * math.pi * cycles * number)
        for number, count in enumerate(counts)
    )
    return sum(turned) / len(counts)
