"""The simulated amplifier of protocol 4 against decision 0088, and its clock against sums by hand.

2^32 steps in 20 s are 214 748 364.8 a second; a step of the high word is 20 s / 65536 = 305.18 us.
"""

import math
from fractions import Fraction

import pytest

from drivers.protocol.definition import FAULTS, STATES
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet, pack_layers, parts
from sim.amplifier.readings import AmplifierClock, Crystal
from sim.amplifier.simulated_amplifier import SimulatedAmplifier

PER_SECOND = 214_748_364.8


def test_clock_goes_round_in_20_s() -> None:
    """A clock without errors shows a quarter of its span after 5 s, and again after 25."""
    clock = AmplifierClock()
    assert [clock.reading(time) for time in (0.0, 5.0, 20.0, 25.0)] == [0, 1 << 30, 0, 1 << 30]
    assert clock.seconds(25.0) == 25.0


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


def test_moment_of_a_clock_without_errors() -> None:
    """A high word of 0x4000 comes at 5 s, behind the end of a turn at 25 s, and at 5 s at once."""
    clock = AmplifierClock()
    assert clock.reaches(0x4000, 0.0) == pytest.approx(5.0, abs=1e-12)
    assert clock.reaches(0x4000, 6.0) == pytest.approx(25.0, abs=1e-11)
    assert clock.reaches(0x4000, 5.0) == 5.0


ARM = {"session": 7, "watchdog": 250, "shift": 0}
OFF, *_, ENABLED = list(STATES)[1:5]
_, REACTION, FAULT = list(STATES)[5:]


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


def test_heat_derates_and_then_trips() -> None:
    """Above 70 °C half of every level, told as inexact; above 85 °C a fault until cool."""
    amplifier = armed()
    play(amplifier, 1, 0.0, tone(), ramp=0)
    amplifier.set_temperature(71.0, 0.1)
    assert levels(amplifier, 0.13) == [2500, 0]
    taken = play(amplifier, 2, 0.13, tone(1, 2000, 8000), layer=1, ramp=0)
    assert (taken["exact"], levels(amplifier, 0.14)) == (False, [2500, 4000])
    amplifier.set_temperature(86.0, 0.2)
    assert amplifier.handle("GetStatus", {}, 0.21)["fault"] == FAULTS["OVER_TEMPERATURE"]
    assert amplifier.handle("Clear", {"latch": 1}, 0.22)["state"] == STATES[FAULT]
    amplifier.set_temperature(60.0, 0.3)
    assert amplifier.handle("Clear", {"latch": 1}, 0.31)["state"] == STATES[OFF]


def test_temperature_follows_the_mean_square_level() -> None:
    """Half level on both channels: a quarter of 30 K, 1 - 1/e of it after 120 s."""
    amplifier = SimulatedAmplifier("a", channels=2)
    amplifier.handle("Arm", {"session": 7, "watchdog": 2000, "shift": 0}, 0.0)
    play(amplifier, 1, 0.0, tone(0), tone(1), ramp=0)
    for second in range(1, 121):
        status = amplifier.handle("Ping", {"session": 7, "rate": 0}, float(second))
    assert status["temperature"] == pytest.approx(250 + 75 * (1 - 1 / math.e), abs=1)


def test_interlock_trips_and_keeps_disarmed() -> None:
    """Neither cleared nor armed until it is closed; the event names state, fault and latch."""
    amplifier, events = armed(), []
    amplifier.listeners.append(lambda event, at: events.append((event["state"], event["latch"])))
    amplifier.set_interlock(0.1, is_open=True)
    amplifier.tick(0.2)
    assert events == [(STATES[REACTION], 1), (STATES[FAULT], 1)]
    assert amplifier.handle("Clear", {"latch": 1}, 0.2)["state"] == STATES[FAULT]
    amplifier.set_interlock(0.3, is_open=False)
    amplifier.handle("Clear", {"latch": 1}, 0.3)
    assert (
        amplifier.handle("Arm", {"session": 8, "watchdog": 250, "shift": 0}, 0.3)["state"]
        == STATES[ENABLED]
    )


def test_restart_forgets_all_but_its_faults() -> None:
    """Silent at once and disarmed, the next token may be any."""
    amplifier = armed()
    play(amplifier, 9, 0.0, tone())
    amplifier.trip("ARC", 0.1, channel=1)
    amplifier.restart(0.2)
    status = amplifier.handle("GetStatus", {}, 0.2)
    assert (status["state"], status["token"], status["levels"]) == (STATES[OFF], 0, [0, 0])
    faults = amplifier.handle("GetFaults", {}, 0.3)["faults"]
    assert faults == [{"fault": FAULTS["ARC"], "channel": 1, "age": 200}]


def test_high_voltage_is_on_while_armed_and_discharges() -> None:
    """1800 V; 1800/e after 20 ms without it, a current of 2 pi f/2 C U in a capacitor of 1 nF.

    None in one that is stopped and was never armed.
    """
    amplifier = armed()
    play(amplifier, 1, 0.0, tone(0, 2000, 10000), ramp=0)
    measured = amplifier.handle("GetMeasured", {}, 0.01)["channels"][0]
    voltage = 1800 / math.sqrt(2)
    assert measured["channel_voltage"] == pytest.approx(10 * voltage, abs=1)
    assert measured["channel_current"] == pytest.approx(math.pi * 100 * voltage * 1e-3, abs=1)
    amplifier.handle("Disarm", {"ramp": 0}, 0.1)
    assert amplifier.handle("GetStatus", {}, 0.12)["high_voltage"] == round(1800 / math.e)
    assert SimulatedAmplifier("b", channels=1).handle("Stop", {"ramp": 5}, 0.0)["high_voltage"] == 0


def test_rate_is_of_an_armed_session() -> None:
    """100 ppm for a second are 21 475 steps of 2^32 in 20 s; disarmed there is no rate."""
    amplifier = SimulatedAmplifier("a", channels=2)
    ping, shown = {"session": 7, "rate": 1000}, []
    amplifier.handle("Ping", ping, 0.0)
    amplifier.handle("Arm", {**ARM, "watchdog": 2000}, 1.0)
    for now in (1.0, 2.0):
        shown.append(amplifier.handle("Ping", ping, now)["clock"])
    amplifier.handle("Disarm", {"ramp": 0}, 2.0)
    shown += [amplifier.handle("GetStatus", {}, now)["clock"] for now in (3.0, 4.0)]
    fast = [clock - round(now * 2**32 / 20) for clock, now in zip(shown, (1, 2, 3, 4), strict=True)]
    assert fast == pytest.approx([0, 21_475, 21_475, 21_475], abs=1)


def test_watchdog_ends_the_rate_and_counts_real_time() -> None:
    """3276.7 ppm fast, it trips after 0.25 s, and its clock is as fast as its crystal again."""
    amplifier, events = armed(), []
    amplifier.listeners.append(lambda event, at: events.append(at))
    amplifier.handle("Ping", {"session": 7, "rate": 32767}, 0.0)
    amplifier.tick(1.0)
    assert events[0] == 0.25
    ahead = amplifier.handle("GetStatus", {}, 1.0)["clock"] - round(2**32 / 20)
    assert ahead == pytest.approx(0.25 * 3276.7e-6 * 2**32 / 20, abs=1)


def test_shift_is_of_a_new_session() -> None:
    """3 steps of the high word, once, though Arm is repeated; a restart shows 0."""
    amplifier = SimulatedAmplifier("a", channels=2)
    for now in (0.0, 0.1):
        status = amplifier.handle("Arm", {**ARM, "shift": 3}, now)
    assert status["clock"] == 3 * 65536 + round(0.1 * 2**32 / 20)
    amplifier.restart(5.0)
    assert amplifier.handle("GetStatus", {}, 5.0)["clock"] == 0


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
