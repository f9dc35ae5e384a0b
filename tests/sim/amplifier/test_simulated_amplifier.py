"""The simulated amplifier of protocol 4 against decision 0088, and its clock against sums by hand.

2^32 steps in 20 s are 214 748 364.8 a second; a step of the high word is 20 s / 65536 = 305.18 us.
"""

import math
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest

from courses import Step, Taken, courses, fits, follow
from drivers.protocol.definition import FAULTS, READING_STATES, STATES
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import Command, LayerSet, pack_layers, parts
from plates import make_paper_rig
from real_wires import on_amplifiers
from sim.amplifier.readings import AmplifierClock, Crystal
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.bench.bench import Bench

PER_SECOND = 214_748_364.8


def test_clock_goes_round_in_20_s() -> None:
    """A clock without errors shows a quarter of its span after 5 s, and again after 25.

    So a high word of 0x4000 comes at 5 s, behind the end of a turn at 25 s, and at 5 s at once.
    """
    clock = AmplifierClock()
    assert [clock.reading(time) for time in (0.0, 5.0, 20.0, 25.0)] == [0, 1 << 30, 0, 1 << 30]
    assert clock.seconds(25.0) == 25.0
    moments = [clock.reaches(0x4000, time) for time in (0.0, 6.0, 5.0)]
    assert moments == pytest.approx([5.0, 25.0, 5.0], abs=1e-11)


def test_crystal_and_rate_multiply() -> None:
    """At +40 ppm the clock gains 40 us in a second; a rate of -400 words leaves 1.6 ns of them."""
    clock = AmplifierClock(Crystal(error=40e-6), since=100.0)
    assert clock.seconds(101.0) - 101.0 == pytest.approx(40e-6, abs=1e-10)
    clock.steer(-400, 101.0)
    # (1 + 4e-5) (1 - 4e-5) = 1 - 1.6e-9
    assert clock.seconds(111.0) - 111.0 == pytest.approx(40e-6 - 16e-9, abs=1e-10)
    assert clock.reading(111.0) == round((11.0 + 40e-6 - 16e-9) * PER_SECOND) % (1 << 32)


def test_warm_up_settles() -> None:
    """A warm-up of 1 ppm/s makes a crystal 10 (1 - 1/e) ppm fast after 10 s, 10 ppm in the end."""
    crystal = Crystal(warm_up=1e-6)
    clock = AmplifierClock(crystal)
    assert clock.straight(0.0).pace == 1.0
    assert clock.straight(10.0).pace - 1 == pytest.approx(10e-6 * (1 - math.exp(-1)), rel=1e-9)
    assert clock.straight(1000.0).pace - 1 == pytest.approx(10e-6, rel=1e-9)
    # The integral of 10 (1 - exp(-t / 10)) ppm over 10 s is 100 / e us.
    assert clock.seconds(10.0) - 10 == pytest.approx(100e-6 / math.e, abs=1e-11)


def test_steering_for_an_hour_adds_no_rounding() -> None:
    """Rates that change every 50 ms for an hour add up to the exact sum of fractions."""
    clock = AmplifierClock()
    rates = [(number * 7919) % 65535 - 32767 for number in range(72_000)]
    exact = Fraction(0)
    for number, rate in enumerate(rates):
        since, until = Fraction(number / 20), Fraction((number + 1) / 20)
        clock.steer(rate, number / 20)
        exact += (until - since) * (1 + Fraction(rate, 10_000_000))
    assert abs(Fraction(clock.seconds(3600.0)) - exact) < Fraction(1, 10**11)


def test_shift_moves_the_high_word_on() -> None:
    """A shift of 3 moves the clock on by 3 steps of its high word, over its end too."""
    clock = AmplifierClock()
    clock.shift(3)
    assert clock.reading(0.0) == 0x0003_0000
    clock.shift(65_534)
    assert clock.reading(0.0) == 0x0001_0000


def test_clock_starts_again_with_its_supply() -> None:
    """After a restart the clock shows 0 and runs as fast as its crystal, which stays warm."""
    clock = AmplifierClock(Crystal(error=20e-6, warm_up=1e-6, ahead=7.0))
    assert clock.reading(0.0) == round(7 * PER_SECOND)
    clock.steer(1000, 1.0)
    clock.restart(500.0)
    assert clock.reading(500.0) == clock.rate == 0
    assert clock.seconds(501.0) == pytest.approx(1 + 30e-6, abs=1e-9)


@pytest.mark.parametrize("rate", [0, 500, -32768])
def test_moment_of_a_high_word(rate: int) -> None:
    """The clock has a high word from its moment on, and the one before just until then."""
    clock = AmplifierClock(Crystal(error=-50e-6, warm_up=1e-6, ahead=3.3), since=1e5)
    clock.steer(rate, 1e5 + 2)
    now = 1e5 + 2.5
    high = ((clock.reading(now) >> 16) + 1638) % 65536
    moment = clock.reaches(high, now)
    assert clock.reading(moment) >> 16 == high
    assert clock.reading(moment - 10e-9) >> 16 == high - 1
    # 1637 to 1638 steps of 20 s / 65536, by a clock that is at most 3.4 per mille fast or slow.
    assert 1637 * 20 / 65536 * 0.996 < moment - now < 1638 * 20 / 65536 * 1.004


ARM = {"session": 7, "watchdog": 250, "shift": 0}


def armed(*, channels: int = 2) -> SimulatedAmplifier:
    """An amplifier armed by session 7 at time 0, watchdog 0.25 s."""
    amplifier = SimulatedAmplifier("a", channels=channels)
    amplifier.handle("Arm", ARM, 0.0)
    return amplifier


def tone(channel: int = 0, frequency: int = 2000, level: int = 5000, **other: object) -> Command:
    """A tone of 100 Hz at half level unless told otherwise."""
    return Command(channel, frequency, level, 0, **other)  # type: ignore[arg-type]


def part_of(token: int, *layers: LayerSet, now: bool = True) -> Values:
    """The only part of a set of session 7."""
    (part,) = parts(pack_layers(layers), session=7, token=token, now=now)
    return part


def play(
    amplifier: SimulatedAmplifier, token: int, at: float, *commands: Command, **layer: int
) -> Values:
    """Play commands in a layer at once, with a ramp of 20 ms."""
    number = layer.pop("layer", 0)
    one = LayerSet(number, layer.pop("ramp", 20), layer.pop("valid_for", 0), commands)
    return amplifier.handle("Set", part_of(token, one), at)


def levels(amplifier: SimulatedAmplifier, at: float) -> list[int]:
    """Levels of the status at a time, in 1e-4."""
    return list(amplifier.handle("GetStatus", {}, at)["levels"])


@dataclass(kw_only=True)
class Handled(Taken):
    """An amplifier that handles requests; reply: the last one, at a time [s].

    handle: of the name of an amplifier, for several; events: the name of the state, the latch and
    the time of each.
    """

    amplifier: SimulatedAmplifier
    handle: Callable[[str, str, Values, float], Values]
    reply: Values = field(default_factory=dict)
    at: float = 0.0
    events: list[tuple[str, int, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Note all events."""
        self.amplifier.listeners.append(
            lambda event, at: self.events.append((_named("state", event), event["latch"], at))
        )

    @property
    def ahead(self) -> int:
        """By how much the clock of the last reply is ahead of one without errors [2^-32 turns]."""
        return int(self.reply["clock"]) - round(self.at * PER_SECOND)

    def asks(self, name: str, at: float, of: str = "", **values: Any) -> None:
        """Handle a request at a time."""
        self.at, self.reply = at, self.handle(of, name, values, at)

    def plays(
        self, token: int, at: float, tone: Sequence[int], layer: int = 0, valid_for: int = 0
    ) -> None:
        """Handle a set that plays a tone at once: channel, frequency and level."""
        one = LayerSet(layer, 0, valid_for, (Command(*tone, 0),))
        self.reply = self.handle("", "Set", part_of(token, one), at)

    def renews(self, token: int, at: float, valid_for: int) -> None:
        """Handle a set that renews the first layer."""
        self.handle("", "Set", part_of(token, LayerSet(0, 0, valid_for, renew=True)), at)

    async def is_refused(self, code: str, step: Step) -> None:
        """Require that a step is refused with a code."""
        with pytest.raises(Refusal) as caught:
            await self.take(step)
        assert caught.value.code == code

    def replies(self, **expected: Any) -> None:
        """Require values of the last reply, states and faults by name."""
        found = {what: _named(what, self.reply) for what in expected}
        assert fits(found, expected), found


def _named(what: str, values: Values) -> Any:
    """A value, a state or fault by its name."""
    states = READING_STATES if "window_left" in values else STATES
    names = {"state": states, "fault": FAULTS}.get(what, {})
    return next((name for name, code in names.items() if code == values[what]), values[what])


@asynccontextmanager
async def handled(*names: str, is_armed: bool = True) -> AsyncIterator[Handled]:
    """An amplifier of two channels, armed by session 7 at time 0 with a watchdog of 0.25 s.

    names: those of amplifiers at the paper's plate instead.
    """
    if not names:
        one = armed() if is_armed else SimulatedAmplifier("a", channels=2)
        yield Handled(amplifier=one, handle=lambda _, *request: one.handle(*request))
        return
    bench = Bench(on_amplifiers(make_paper_rig(12, 9), names), now=0.0)
    yield Handled(
        amplifier=bench.amplifiers[names[0]],
        handle=lambda of, name, values, at: bench.exchange(of or names[0], name, values, now=at),
    )


COURSES = courses(Path(__file__).with_name("courses.yaml"))


@pytest.mark.parametrize("name", COURSES)
def test_amplifier_keeps_to_its_course(name: str) -> None:
    """Every step is as it is in the file."""
    follow(COURSES[name], handled)


def test_temperature_follows_the_mean_square_level() -> None:
    """Half level on both channels: a quarter of 30 K, 1 - 1/e of it after 120 s."""
    amplifier = SimulatedAmplifier("a", channels=2)
    amplifier.handle("Arm", {"session": 7, "watchdog": 2000, "shift": 0}, 0.0)
    play(amplifier, 1, 0.0, tone(0), tone(1), ramp=0)
    for second in range(1, 121):
        status = amplifier.handle("Ping", {"session": 7, "rate": 0}, float(second))
    assert status["temperature"] == pytest.approx(250 + 75 * (1 - 1 / math.e), abs=1)


def play_from(
    amplifier: SimulatedAmplifier, token: int, level: int, at: float, moment: int
) -> None:
    """Stage a set of channel 0 at a time [s], and commit it for a high word of the clock."""
    one = LayerSet(0, 0, 0, (tone(level=level),))
    amplifier.handle("Set", part_of(token, one, now=False), at)
    amplifier.handle("Commit", {"session": 7, "token": token, "at": moment % 65536}, at)


@pytest.mark.parametrize(
    ("moment", "waits"), [(99, False), (100, False), (101, True), (1738, True), (1739, False)]
)
def test_moments_beyond_half_a_second_are_now(moment: int, waits: bool) -> None:
    """The present high word, one that has passed, or one more than 1638 steps ahead: at once."""
    amplifier, at = armed(), 100.5 * 20 / 65536
    play_from(amplifier, 1, 5000, at, moment)
    assert (levels(amplifier, at) == [0, 0]) is waits


def test_ping_in_the_very_moment_does_not_put_it_off_by_a_turn() -> None:
    """In the last floating-point number before each of 50 moments, by a rate for each."""
    amplifier = SimulatedAmplifier("a", channels=2)
    amplifier.handle("Arm", {**ARM, "watchdog": 2000}, 0.0)
    amplifier.clock = AmplifierClock(Crystal(error=4e-5, warm_up=1e-6))
    for number in range(1, 51):
        at = number / 2
        play_from(amplifier, number, 100 * number, at, (amplifier.clock.reading(at) >> 16) + 300)
        moment = math.nextafter(amplifier.next_event, 0.0)
        amplifier.handle("Ping", {"session": 7, "rate": 600 * number}, moment)
        assert levels(amplifier, moment + 0.001) == [100 * number, 0]
