"""A clock as its host reads and steers it, against a counter whose true time is known.

The counter and all delays are defined here, so that no other part of the project is involved.
"""

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import pytest

from drivers.host.clock import HeldClock

ARMED = 4
DISARMED = 1
TURN = 20.0
"""A clock wraps around after this time [s]."""
STEP = TURN / 65536
"""Step of a shift [s]."""
START = 1000.0
"""The first time [s]."""
NOT_STATED = 65535
"""The `clock_error` of an amplifier whose clock has no stated error."""


@dataclass
class Counter:
    """The clock of an amplifier, which obeys shift and rate."""

    crystal: float = 0.0
    """How much too fast its crystal is, as a share of its rate."""
    seconds: float = START
    """What it shows [s]."""
    updated: float = START
    """When it was last advanced [s]."""
    rate: float = 0.0
    """The rate to which it is steered, as a share."""
    is_deaf: bool = False
    """Whether it ignores shift and rate."""
    distort: Callable[[int], int] = lambda word: word
    """Changes the word that a status shows."""

    def advance(self, time: float) -> None:
        """Count until a time [s]."""
        self.seconds += (time - self.updated) * (1 + self.crystal) * (1 + self.rate)
        self.updated = time

    @property
    def word(self) -> int:
        """What a status shows."""
        word = int(self.seconds % TURN / TURN * 2**32)
        return self.distort(word) % 2**32

    @property
    def lead(self) -> float:
        """How far it is ahead of the host's clock [s], within half a turn."""
        return math.remainder(self.seconds - self.updated, TURN)


def no_delay() -> float:
    """Return no delay [s]."""
    return 0.0


def reply_delay() -> float:
    """Return the usual delay of a reply [s]."""
    return 2e-3


def uniform(seed: int, shortest: float, longest: float) -> Callable[[], float]:
    """Return a source of random delays [s]; from 0 on they are those of frames of USB."""
    return partial(random.Random(seed).uniform, shortest, longest)


def busy(seed: int) -> Callable[[], float]:
    """Return the delays of an overloaded machine [s]: most of 1 to 60 ms, a fifth none."""
    rng = random.Random(seed)

    def delay() -> float:
        if rng.random() < 0.2:
            return 0.0
        return min(rng.lognormvariate(math.log(5e-3), 1.2), 0.06)

    return delay


@dataclass
class PolledClock:
    """A counter, and the host that reads, arms and steers it."""

    counter: Counter = field(default_factory=Counter)
    request_delay: Callable[[], float] = no_delay
    """Draws the delay of a request in addition to its bits [s]."""
    reply_delay: Callable[[], float] = reply_delay
    """Draws the delay of a reply [s]."""
    stated_bits: float = 0.0
    """How long the bits of a request take at most, as the host is told [s]."""
    actual_bits: float | None = None
    """How long they really take [s]; None for as long as stated."""
    clock_error: int = 10
    """The stated error of the clock [0.1 us]."""
    is_playing: bool = True
    is_lost: Callable[[], bool] = lambda: False
    """Draws whether the next request gets no reply."""
    now: float = START
    state: int = DISARMED
    shift: int = 0
    """The shift of the last Arm [steps]."""
    leads: list[float] = field(default_factory=list)
    """True leads at each Ping [s]."""
    held: HeldClock = field(default_factory=HeldClock)
    """The clock as the host knows it."""

    def __post_init__(self) -> None:
        """Identify the amplifier."""
        self.held.identified(self.clock_error, bits=1e-3)
        self.held.is_alone = False

    def send(self, name: str, **values: int) -> None:
        """Send a request and handle its reply."""
        self.held.sent(name, values, self.now, self.now + self.stated_bits)
        if self.is_lost():
            return
        bits = self.stated_bits if self.actual_bits is None else self.actual_bits
        self.counter.advance(self.now + bits + self.request_delay())
        if name == "Arm":
            self.state = ARMED
        if not self.counter.is_deaf:
            if name == "Arm":
                self.counter.seconds += values["shift"] * STEP
            elif name == "Ping" and self.state == ARMED:
                self.counter.rate = values["rate"] * 1e-7
        status = {"state": self.state, "clock": self.counter.word}
        received = self.counter.updated + self.reply_delay()
        self.held.replied(name, values, status, received)

    def arm(self, duration: float = 1.0) -> None:
        """Read the clock for some time [s], then arm with the shift that it needs."""
        self.run(duration)
        self.shift = self.held.shift(self.now)
        self.send("Arm", shift=self.shift)

    def ping(self) -> None:
        """Send a Ping with the rate that the clock needs."""
        self.send("Ping", rate=self.held.rate(self.now, is_playing=self.is_playing))
        self.leads.append(self.counter.lead)

    def run(self, duration: float) -> None:
        """Send a Ping, or a GetStatus while disarmed, every 50 ms for some time [s]."""
        for _ in range(round(duration / 0.05)):
            self.now += 0.05
            if self.state == ARMED:
                self.ping()
            else:
                self.send("GetStatus")

    def restart(self) -> None:
        """Switch the amplifier off and on."""
        self.state = DISARMED
        self.counter.seconds = 0.0

    def send_mark(self) -> None:
        """Send a Mark."""
        self.held.sent("Mark", {}, self.now, self.now)

    def show_past_clock(self, age: float) -> None:
        """Reply to a GetStatus with the clock as it was some time ago [s]."""
        self.counter.advance(self.now - age)
        self.held.sent("GetStatus", {}, self.now, self.now)
        status = {"state": self.state, "clock": self.counter.word}
        self.held.replied("GetStatus", {}, status, self.now + 2e-3)

    @property
    def problem(self) -> str | None:
        """The problem of the clock that the host reports."""
        return self.held.problem(self.now)

    @property
    def error(self) -> float:
        """The error that the host reports [s]."""
        return self.held.error(self.now)

    @property
    def scatter(self) -> float:
        """The scatter of the readings as the host sees it [s]."""
        return self.held.scatter(self.now)

    @property
    def lead_error(self) -> float:
        """How much the host overestimates the lead [s]."""
        self.counter.advance(self.now)
        return math.remainder(self.held.lead(self.now) - self.counter.lead, TURN)


def rms(values: list[float]) -> float:
    """Return the root mean square."""
    return math.sqrt(sum(value**2 for value in values) / len(values))


# Arming and steering


def test_clock_is_shifted_by_the_nearest_step_and_its_rate_compensates_the_crystal() -> None:
    """A lead of 3.2001 s at 40 ppm takes 10486 steps back, and a rate of -40 ppm."""
    clock = PolledClock(Counter(40e-6, seconds=START + 3.20006))

    clock.arm()

    assert clock.shift == 65536 - 10486
    assert clock.counter.lead == pytest.approx(0, abs=153.6e-6)
    assert clock.scatter < 20e-6
    clock.run(10.0)
    assert clock.counter.rate == pytest.approx(-40e-6, abs=0.5e-6)
    assert clock.counter.lead == pytest.approx(0, abs=2e-6)


def test_clock_that_states_no_error_is_not_steered() -> None:
    """Neither by shift nor by rate; its error is infinite."""
    clock = PolledClock(Counter(40e-6, seconds=3.0), clock_error=NOT_STATED)

    clock.arm()
    clock.run(5.0)

    assert clock.shift == 0
    assert clock.counter.rate == 0
    assert clock.problem == "clock_not_steered"
    assert clock.error == math.inf


@pytest.mark.parametrize("is_shifted", [False, True], ids=["ignored", "obeyed"])
def test_clock_is_read_again_when_an_arm_gets_no_reply(is_shifted: bool) -> None:
    """The clock was a step behind; the amplifier may have obeyed the shift by one step."""
    clock = PolledClock(Counter(seconds=START - STEP))
    clock.run(1.0)
    clock.is_lost = lambda: True
    clock.arm(0.0)
    clock.is_lost = lambda: False

    if is_shifted:
        clock.counter.seconds += STEP
    clock.run(0.2)

    assert clock.lead_error == pytest.approx(0, abs=2e-6)


# Readings


def test_clock_error_stays_small_while_requests_are_late_for_a_second() -> None:
    """Each is late by 0.7 ms, as its exchange shows; the clock is known to some microseconds."""
    clock = PolledClock(Counter(20e-6), uniform(1, 0.0, 50e-6))
    clock.arm()
    clock.run(5.0)

    clock.request_delay = uniform(1, 0.7e-3, 0.75e-3)
    for _ in range(20):
        for _ in range(4):
            clock.now += 0.01
            clock.send("GetStatus")
            assert clock.error < 50e-6
        clock.now += 0.01
        clock.ping()
        assert clock.error < 50e-6


# Faulty clocks


def jump_forward(counter: Counter) -> None:
    """Jump by 10 ms."""
    counter.seconds += 0.01


def jump_back(counter: Counter) -> None:
    """Jump back by 10 ms."""
    counter.seconds -= 0.01


def stop(counter: Counter) -> None:
    """Stop counting."""
    counter.crystal = -1.0


def run_too_fast(counter: Counter) -> None:
    """Count 50 % too fast."""
    counter.crystal = 0.5


def run_backward(counter: Counter) -> None:
    """Count backward."""
    counter.crystal = -2.0


def show_random_words(counter: Counter) -> None:
    """Show random words until the crystal is right again."""
    rng = random.Random(8)
    counter.crystal = 0.5
    counter.distort = lambda word: rng.randrange(1 << 32) if counter.crystal else word


@pytest.mark.parametrize("fault", [jump_forward, jump_back, stop])
def test_clock_error_is_infinite_after_a_jump_until_the_clock_is_steered_back(
    fault: Callable[[Counter], None],
) -> None:
    """A clock that has stopped stays so; readings from before the Arm no longer count."""
    clock = PolledClock(Counter(20e-6), uniform(1, 0.0, 125e-6))
    clock.arm()
    clock.run(10.0)
    assert clock.error < 10e-6

    fault(clock.counter)
    clock.run(0.1)

    assert clock.problem == "clock_jumped"
    assert clock.error == math.inf
    clock.is_playing = False
    clock.run(15.0)
    if fault is stop:
        assert clock.problem == "clock_jumped"
        assert 4.8 <= clock.counter.lead <= 5.0
    else:
        assert clock.problem is None
        assert clock.counter.lead == pytest.approx(0, abs=10e-6)


@pytest.mark.parametrize(
    "fault", [jump_forward, jump_back, stop, run_too_fast, run_backward, show_random_words]
)
def test_clock_of_a_single_amplifier_is_reported_when_all_its_frequencies_are_wrong(
    fault: Callable[[Counter], None],
) -> None:
    """Within 3 s. A sound clock that wraps or restarts on a busy machine is not reported."""
    clock = PolledClock(request_delay=busy(3), reply_delay=busy(4), clock_error=NOT_STATED)
    clock.held.is_alone = True
    clock.send("Arm", shift=0)
    for _ in range(60):
        clock.run(0.5)
        assert clock.problem is None

    fault(clock.counter)
    clock.run(3.0)

    assert clock.problem == "clock_jumped"
    assert clock.counter.rate == 0
    clock.counter.crystal = 0.0
    clock.run(4.0)
    assert clock.problem is None
    clock.restart()
    clock.run(0.1)
    clock.send("Arm", shift=0)
    clock.run(0.5)
    clock.counter.seconds = 0.0  # it restarts and is armed before its status is read
    clock.send("Arm", shift=0)
    clock.run(0.5)
    assert clock.problem is None


@pytest.mark.parametrize(
    "counter",
    [Counter(400e-6), Counter(-400e-6), Counter(60e-6, is_deaf=True)],
    ids=["too fast", "too slow", "deaf"],
)
def test_clock_that_does_not_follow_is_reported_with_its_lead_as_its_error(
    counter: Counter,
) -> None:
    """Within 6 s, for a broken crystal and for a clock that ignores shift and rate."""
    clock = PolledClock(counter, uniform(1, 0.0, 125e-6))
    clock.arm()
    clock.run(6.0)

    for _ in range(20):
        clock.run(0.5)
        assert clock.problem is not None
        assert clock.problem.startswith("clock")
        assert clock.error >= 0.8 * abs(counter.lead)


# Several clocks on a line


def send_marks(
    clocks: list[PolledClock], count: int, shortest: float = 0.0, longest: float = 0.0
) -> None:
    """Send Marks every 54 ms to the clocks of a line, which show the time of the same byte.

    Each Mark is late by a random time [s], which is the same for all clocks.
    """
    mark_delay = uniform(5, shortest, longest)
    for _ in range(count):
        delay = mark_delay()
        for clock in clocks:
            clock.send("GetStatus")
            clock.now += 0.05
            clock.send_mark()
            clock.now += 2e-3
            clock.show_past_clock(2e-3 - delay)


def test_clocks_of_a_line_are_compared_by_marks_with_the_same_delay() -> None:
    """Six Marks within 0.3 s give their difference, although other requests are late by 0.5 ms.

    What remains is the resolution of a clock, 5 ns, and the rounding.
    """
    first = PolledClock(Counter(40e-6), uniform(6, 0.0, 0.5e-3))
    second = PolledClock(Counter(-30e-6), uniform(7, 0.0, 0.5e-3))
    first.run(1.0)
    second.run(1.0)

    second.held.compare(first.held)
    send_marks([first, second], 6, 0.2e-3, 0.7e-3)

    assert first.lead_error - second.lead_error == pytest.approx(0, abs=0.1e-6)


@pytest.mark.parametrize("is_armed", [False, True], ids=["disarmed", "armed"])
def test_clock_is_not_moved_by_a_mark_that_arrives_twice(is_armed: bool) -> None:
    """The status after the second one shows the clock of 10 ms ago, so it must be read again.

    The next reading tells that the clock has not moved.
    """
    clock = PolledClock(Counter(20e-6, seconds=997.0), uniform(1, 0.0, 125e-6))
    if is_armed:
        clock.arm()
    clock.run(10.0)
    send_marks([clock], 1)

    clock.now += 0.048
    clock.show_past_clock(0.01)

    assert clock.scatter == math.inf
    clock.run(0.05)
    assert clock.problem is None
    assert clock.scatter < 20e-6
    assert clock.lead_error == pytest.approx(0, abs=20e-6)


def test_clock_ignores_a_status_that_may_show_either_of_two_marks() -> None:
    """The second Mark is lost, twice in a row: the status shows the clock of 50 ms before."""
    clock = PolledClock(Counter(20e-6), uniform(1, 0.0, 125e-6))
    clock.arm()
    clock.run(5.0)

    for _ in range(2):
        clock.send_mark()
        clock.now += 0.05
        clock.send_mark()
        clock.now += 0.01
        clock.show_past_clock(0.06)

    assert clock.problem is None
    assert clock.scatter < 50e-6


def test_clock_rate_never_exceeds_the_range_of_a_ping() -> None:
    """A clock 1.5 ms ahead at 200 ppm needs 3.5e-3 in all; a Ping can state 3.28e-3."""
    first = PolledClock(Counter(200e-6, seconds=START + 0.3e-3))
    second = PolledClock(Counter(200e-6, seconds=START + 1.5e-3))
    for clock in (first, second):
        clock.run(1.0)
        clock.send("Arm", shift=0)

    first.held.compare(None)
    second.held.compare(first.held)
    send_marks([first, second], 4)

    assert second.held.is_compared
    assert -32768 <= second.held.rate(second.now, is_playing=False) <= -25001


# Random delays and readings


def armed_clock(seed: int, frame: float = 125e-6) -> PolledClock:
    """Return an armed clock with one of eight crystals, behind frames of USB [s]."""
    counter = Counter(-50e-6 + 14e-6 * seed, seconds=START + seed)
    clock = PolledClock(counter, uniform(seed, 0.0, frame))
    clock.arm()
    return clock


@pytest.mark.parametrize(
    ("frame", "bound"), [(125e-6, 10e-6), (1e-3, 60e-6)], ids=["high speed", "full speed"]
)
def test_clock_lead_is_that_of_the_shortest_delays_behind_frames_of_usb(
    frame: float, bound: float
) -> None:
    """USB adds uniform delays, with a mean of half a frame; the stated error fits the true one."""
    clocks = [armed_clock(seed, frame) for seed in range(8)]
    for clock in clocks:
        clock.run(15.0)

    leads = []
    for clock in clocks:
        leads += clock.leads[-100::10]
    assert rms(leads) < bound
    stated_error = rms([clock.error for clock in clocks])
    assert 0.5 * rms(leads) < stated_error < 4 * rms(leads)


@pytest.mark.parametrize("is_playing", [False, True], ids=["silent", "playing"])
def test_clock_swings_no_further_when_pings_are_lost(is_playing: bool) -> None:
    """Half of the Pings are lost, at most four in a row: after 15 s the lead is 16 us rms.

    By hand, with frames of 125 us: the lowest of 2.5 readings is below 30 us in half of the cases;
    the mean of these is 14 us, with a standard deviation of 9 us. At the end of a parabola through
    16 of them that is 9 x 3 / sqrt(16) = 7 us: 16 us in total, and at most 14 + 5 x 7 = 49 us.
    """
    rng = random.Random(3)
    lost_in_a_row = 0

    def is_lost() -> bool:
        nonlocal lost_in_a_row
        lost_in_a_row = lost_in_a_row + 1 if lost_in_a_row < 4 and rng.random() < 0.5 else 0
        return lost_in_a_row > 0

    leads = []
    for seed in range(8):
        clock = PolledClock(Counter(50e-6), uniform(seed, 0.0, 125e-6), is_playing=is_playing)
        clock.arm()
        clock.is_lost = is_lost
        clock.run(15.0)
        clock.leads.clear()
        clock.run(30.0)
        leads += clock.leads

    assert rms(leads) < 16e-6
    assert max(map(abs, leads)) < 49e-6


def test_clock_error_covers_rare_wrong_readings() -> None:
    """In 3 % of all statuses the high word is read before a carry, so the clock is a step low.

    A reading is then wrong by a step of 305 us, and the lead by at most half of it. Frames of USB
    at high speed are far shorter.
    """
    leads = []
    errors = []
    rng = random.Random(7)
    for seed in range(8):
        clock = armed_clock(seed)
        clock.counter.distort = lambda word: word - 2**16 if rng.random() < 0.03 else word
        clock.run(10.0)
        for _ in range(100):
            clock.run(0.1)
            errors.append(clock.error)
            leads.append(clock.counter.lead)

    assert rms(leads) < STEP / 2
    assert STEP / 2 < rms(errors) < STEP
