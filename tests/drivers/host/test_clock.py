"""One clock as its host sees it: readings of a counter made by hand, in a time of its own.

Courses of single clocks in YAML, each by the sentence that it proves.
"""

import math
import random
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from courses import Taken, courses, follow
from drivers.host.clock import HeldClock

ARMED, OFF = 4, 1
STEP = 20 / 65536  # s; of shift: the clock goes round in 20 s
START = 1000.0  # s


@dataclass
class Counter:
    """A clock that counts seconds on a crystal, and obeys shift and rate."""

    crystal: float = 0.0
    shown: float = 0.0  # s, at a time
    at: float = START
    rate: float = 0.0
    is_deaf: bool = False

    def go(self, time: float) -> None:
        """Count to a time."""
        self.shown += (time - self.at) * (1 + self.crystal) * (1 + self.rate)
        self.at = time

    @property
    def word(self) -> int:
        """What a Status shows."""
        return int(self.shown % 20 / 20 * 2**32)

    @property
    def lead(self) -> float:
        """By how much it is ahead of the host's clock [s], by less than half a turn."""
        return math.remainder(self.shown - self.at, 20)


@dataclass
class Chance(Counter):
    """A clock that shows any number once its crystal is not what it was."""

    rng: random.Random = field(default_factory=lambda: random.Random(8))

    @property
    def word(self) -> int:
        """What a Status shows."""
        return self.rng.randrange(1 << 32) if self.crystal else super().word


@dataclass
class Exchanges(Taken):
    """Exchanges of a host with a counter; delay: draws how long a request takes beside its bits.

    takes: s that bits of a request really take, None for all of them; back: draws those of a reply.
    """

    counter: Counter = field(default_factory=Counter)
    delay: Callable[[], float] = lambda: 0.0
    bits: float = 0.0  # s; of a request
    takes: float | None = None
    back: Callable[[], float] = lambda: 2e-3
    stated: int = 10  # clock_error, 0.1 us
    now: float = START
    state: int = OFF
    lost: Callable[[], bool] = lambda: False
    is_playing: bool = True
    shift: int = 0
    held: HeldClock = field(default_factory=HeldClock)
    leads: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Identify it."""
        self.held.identified(self.stated, bits=1e-3)
        self.held.is_alone = False

    def send(self, name: str, **values: int) -> None:
        """Send a request, and take the reply."""
        counter, sent = self.counter, self.now
        self.held.sent(name, values, sent, sent + self.bits)
        if self.lost():
            return
        counter.go(sent + (self.bits if self.takes is None else self.takes) + self.delay())
        if not counter.is_deaf:
            if name == "Arm":
                counter.shown += values["shift"] * STEP
            elif name == "Ping" and self.state == ARMED:
                counter.rate = values["rate"] * 1e-7
        if name == "Arm":
            self.state = ARMED
        status = {"state": self.state, "clock": counter.word}
        self.held.replied(name, values, status, counter.at + self.back())

    def arm(self, duration: float = 1.0) -> None:
        """Read it for some time, then arm, with the shift that it needs."""
        self.run(duration)
        self.shift = self.held.shift(self.now)
        self.send("Arm", shift=self.shift)

    def run(self, duration: float) -> None:
        """Exchange for some time: Pings each 50 ms while armed, else statuses."""
        for _ in range(round(duration / 0.05)):
            self.now += 0.05
            if self.state == ARMED:
                rate = self.held.rate(self.now, is_playing=self.is_playing)
                self.send("Ping", rate=rate)
                self.leads.append(self.counter.lead)
            else:
                self.send("GetStatus")

    @property
    def known_error(self) -> float:
        """The error that the host knows of [s]."""
        return self.held.error(self.now)

    @property
    def said_share(self) -> float:
        """That error as a share of the lead."""
        return self.known_error / abs(self.counter.lead)

    @property
    def scatter(self) -> float:
        """How exactly the host knows the lead [s]."""
        return self.held.scatter(self.now)

    @property
    def misread(self) -> float:
        """By how much the host takes the lead for more than it is [s]."""
        return math.remainder(self.held.lead(self.now) - self.counter.lead, 20)

    @property
    def problem(self) -> str | None:
        """What the host says of the clock."""
        return self.held.problem(self.now)

    def is_late(self, least: float, most: float) -> None:
        """Let requests take a random time beside their bits [s]."""
        self.delay = uniform(1, least, most)

    def replies_in(self, least: float, most: float) -> None:
        """Let replies take a random time [s]."""
        self.back = uniform(1, least, most)

    def is_busy(self) -> None:
        """Let requests and replies take the times of a busy machine."""
        self.delay, self.back = busy(3), busy(4)

    def loses_replies(self, is_lost: bool) -> None:
        """Let no reply come, or all."""
        self.lost = lambda: is_lost

    def pauses(self, seconds: float) -> None:
        """Let time pass without an exchange."""
        self.now += seconds

    def jumps(self, seconds: float) -> None:
        """Move the clock on."""
        self.counter.shown += seconds

    def is_shifted(self) -> None:
        """Move the clock by the shift that was sent."""
        self.jumps(self.shift * STEP)


def uniform(seed: int, least: float, most: float) -> Callable[[], float]:
    """Random delays [s]; from 0 on they are those until the next frame of USB."""
    return partial(random.Random(seed).uniform, least, most)


@asynccontextmanager
async def exchanging(
    *, clock: str = "Counter", counter: Mapping[str, float], **options: Any
) -> AsyncIterator[Exchanges]:
    """Exchanges with a kind of counter."""
    made = {"Counter": Counter, "Chance": Chance}[clock](**{"shown": START, **counter})
    yield Exchanges(made, **options)


COURSES = courses(Path(__file__).with_name("clocks.yaml"))


@pytest.mark.parametrize("name", COURSES)
def test_clock_keeps_to_its_course(name: str) -> None:
    """Every step is as it is in the file."""
    follow({"counter": {}, **COURSES[name]}, exchanging)


def rms(values: list[float]) -> float:
    """Root of the mean square."""
    return math.sqrt(sum(each * each for each in values) / len(values))


@pytest.mark.parametrize(
    ("frame", "bound"), [(125e-6, 10e-6), (1e-3, 60e-6)], ids=["high speed", "full speed"]
)
def test_frames_of_usb_only_add(frame: float, bound: float) -> None:
    """Uniform delays: the lowest tell, not their mean of half a frame, and their error is said."""
    leads, said = list[float](), list[float]()
    for seed in range(8):
        talk = Exchanges(
            Counter(-50e-6 + 14e-6 * seed, shown=START + seed), uniform(seed, 0.0, frame)
        )
        talk.arm()
        talk.run(15.0)
        leads += talk.leads[-100::10]
        said.append(talk.held.error(talk.now))
    assert rms(leads) < bound
    assert 0.5 * rms(leads) < rms(said) < 4 * rms(leads)


@pytest.mark.parametrize("is_playing", [False, True], ids=["silent", "playing"])
def test_lost_pings_make_it_swing_no_further(is_playing: bool) -> None:
    """Every second Ping lost, up to four in a row, as a watchdog lets pass: after 15 s 16 us rms.

    By hand, of frames of 125 us: the lowest of 2.5 readings is below 30 us in half of the cases, in
    the mean of these 14 us, with a standard deviation of 9. At the end of a parabola through 16 of
    them that is 9 x 3 / sqrt(16) = 7: 16 us together, and at most 14 + 5 x 7 = 49 us.
    """
    rng, leads, in_a_row = random.Random(3), list[float](), 0

    def is_lost() -> bool:
        nonlocal in_a_row
        in_a_row = in_a_row + 1 if in_a_row < 4 and rng.random() < 0.5 else 0
        return in_a_row > 0

    for seed in range(8):
        talk = Exchanges(Counter(50e-6), uniform(seed, 0.0, 125e-6), is_playing=is_playing)
        talk.arm()
        talk.lost = is_lost
        talk.run(15.0)
        talk.leads.clear()
        talk.run(30.0)
        leads += talk.leads
    assert rms(leads) < 16e-6
    assert max(map(abs, leads)) < 49e-6


def busy(seed: int) -> Callable[[], float]:
    """Delays of a machine that does more than it can [s]: most of 1 to 60 ms, a fifth none."""
    rng = random.Random(seed)
    late = partial(rng.lognormvariate, math.log(5e-3), 1.2)
    return lambda: 0.0 if rng.random() < 0.2 else min(late(), 0.06)


def test_busy_machine_accuses_no_clock() -> None:
    """Sound crystals, read on a machine that is quiet for 5 s, busy for 30, and quiet again.

    Nothing is said of them, and at nine of ten moments the lead is within three of what is said
    and 40 us, of which the lowest of five readings at USB of high speed are late by 21 on average.
    """
    within = list[bool]()
    for seed in range(8):
        talk = Exchanges(
            Counter(-50e-6 + 14e-6 * seed, shown=START + seed), uniform(seed, 0.0, 125e-6)
        )
        talk.arm()
        for duration, delay in ((5.0, talk.delay), (30.0, busy(seed)), (10.0, talk.delay)):
            talk.delay = delay
            for _ in range(round(duration / 0.05)):
                talk.run(0.05)
                assert talk.held.problem(talk.now) is None
                within.append(abs(talk.counter.lead) < 3 * talk.held.error(talk.now) + 40e-6)
        assert abs(talk.counter.lead) < 40e-6
    assert sum(within) >= 0.9 * len(within)


@dataclass
class TornCounter(Counter):
    """A clock whose high word is read before a carry, in 3 % of all statuses: a step low."""

    rng: random.Random = field(default_factory=lambda: random.Random(7))

    @property
    def word(self) -> int:
        """What a Status shows."""
        return (super().word - (self.rng.random() < 0.03) * 2**16) % 2**32


def test_clock_that_is_rarely_read_wrong_is_off_by_no_more_than_is_said() -> None:
    """A step low now and then, or most requests a step late: 305 us apart, half to the middle.

    Frames of USB at high speed are far less than that.
    """
    leads, said = list[float](), list[float]()
    for seed in range(8):
        talk = Exchanges(TornCounter(-50e-6 + 14e-6 * seed), uniform(seed, 0.0, 125e-6))
        talk.arm()
        talk.run(10.0)
        for _ in range(100):
            talk.run(0.1)
            said.append(talk.held.error(talk.now))
            leads.append(talk.counter.lead)
    assert rms(leads) < STEP / 2 < rms(said) < STEP


def test_requests_that_are_late_for_a_second_leave_a_clock_known() -> None:
    """Each 0.7 ms late, as its exchange shows, of a clock known to some microseconds before."""
    for seed in range(3):
        rng, late = random.Random(seed), [0.0]
        talk = Exchanges(Counter(20e-6), lambda rng=rng, late=late: rng.uniform(0, 5e-5) + late[0])
        talk.arm()
        talk.run(5.0)
        late[0], said = 0.7e-3, list[float]()
        for number in range(100):
            talk.now += 0.01
            if number % 5 == 4:
                talk.send("Ping", rate=talk.held.rate(talk.now, is_playing=True))
            else:
                talk.send("GetStatus")
            said.append(talk.held.error(talk.now))
        assert max(said) < 50e-6


def _prompt(rng: random.Random) -> float:
    """Draw how long a reply takes without bits [s]."""
    return rng.uniform(30e-6, 70e-6) + 0.2e-3 * (rng.random() < 0.1)


@pytest.mark.parametrize("takes", [0.0, 0.2e-3], ids=["all", "late at first"])
@pytest.mark.parametrize("bits", [0.3e-3, 0.6e-3], ids=["pty", "slcan over TCP"])
def test_bits_that_take_no_time_do_not_count(bits: float, takes: float) -> None:
    """921 600 baud on a pseudo-terminal, 500 kbit/s on TCP: 30 us and up to 40 more each way.

    One reply of ten takes 0.2 ms more, which makes no reading early.

    So two of +-40 ppm that are read alike differ by what is late in the lowest readings: 9 us rms,
    as over a network. Nothing is said of them, also where bits seemed to count at first.
    """
    leads = list[list[float]]()
    for seed, crystal in enumerate((40e-6, -40e-6)):
        rng = random.Random(seed)
        late = partial(rng.uniform, 30e-6, 70e-6)
        back = partial(_prompt, rng)
        talk = Exchanges(Counter(crystal), late, bits, takes=takes and bits, back=back)
        talk.held.identified(10, bits=2 * bits)
        if takes:
            talk.back = partial(rng.uniform, 2 * bits, 3 * bits)
        talk.run(0.2)
        talk.back, talk.takes = back, 0.0
        talk.arm()
        for _ in range(60):
            talk.run(0.5)
            assert talk.held.problem(talk.now) is None
        assert talk.counter.rate == pytest.approx(-crystal, abs=3e-6)
        leads.append(talk.leads[-400:])
    assert rms([one - other for one, other in zip(*leads, strict=True)]) < 9e-6


def show(talk: Exchanges, clock: int) -> None:
    """Have a status show a clock."""
    talk.held.sent("GetStatus", {}, talk.now, talk.now)
    status = {"state": talk.state, "clock": clock}
    talk.held.replied("GetStatus", {}, status, talk.now + 2e-3)


def mark(talks: list[Exchanges], count: int, late: Callable[[], float]) -> None:
    """Have clocks keep the same byte of Marks, each 54 ms, and show it."""
    for _ in range(count):
        after = late()
        for talk in talks:
            talk.send("GetStatus")
            talk.now += 0.05
            talk.held.sent("Mark", {}, talk.now, talk.now)
            talk.counter.go(talk.now + after)
            marked = talk.counter.word
            talk.now += 2e-3
            show(talk, marked)


def test_clocks_of_a_line_are_compared_by_marks() -> None:
    """Two behind one line: a Mark is as late for both, by 0.2 to 0.7 ms; other requests are not.

    After six Marks in 0.3 s their difference is known to what a clock shows, 5 ns, and rounds.
    """
    rng, other, talks = random.Random(5), random.Random(6), list[Exchanges]()
    for crystal in (40e-6, -30e-6):
        talk = Exchanges(Counter(crystal), lambda: other.uniform(0.0, 0.5e-3))
        talk.run(1.0)
        talks.append(talk)
    talks[1].held.compare(talks[0].held)
    mark(talks, 6, lambda: 0.2e-3 + rng.uniform(0.0, 0.5e-3))
    for talk in talks:
        talk.counter.go(talk.now)
    seen = talks[0].held.lead(talks[0].now) - talks[1].held.lead(talks[1].now)
    assert seen == pytest.approx(talks[0].counter.lead - talks[1].counter.lead, abs=0.1e-6)


def test_marks_that_are_no_longer_seen_do_not_count() -> None:
    """A crystal changes by 20 ppm, and no Mark comes for a minute: its own readings tell of it."""
    talks = [Exchanges(Counter(crystal)) for crystal in (40e-6, -30e-6)]
    for talk in talks:
        talk.run(1.0)
    talks[1].held.compare(talks[0].held)
    mark(talks, 6, lambda: 0.2e-3)
    talks[1].counter.crystal += 20e-6
    for talk in talks:
        talk.run(60.0)
        assert talk.held.lead(talk.now) == pytest.approx(talk.counter.lead, abs=20e-6)


@pytest.mark.parametrize("is_armed", [False, True], ids=["disarmed", "armed"])
def test_mark_that_comes_twice_moves_no_clock(is_armed: bool) -> None:
    """Once more 40 ms later: the second status behind it shows a clock of 10 ms ago.

    It is known by the next reading that the clock has not moved; before that it is to be read.
    """
    talk = Exchanges(Counter(20e-6, shown=START - 3.0), uniform(1, 0.0, 125e-6))
    if is_armed:
        talk.arm()
    talk.run(10.0)
    mark([talk], 1, lambda: 0.0)
    talk.counter.go(talk.now + 0.038)
    talk.now += 0.048
    show(talk, talk.counter.word)
    assert talk.held.scatter(talk.now) == math.inf
    talk.run(0.05)
    assert talk.held.problem(talk.now) is None
    assert talk.held.scatter(talk.now) < 20e-6
    assert talk.held.lead(talk.now) == pytest.approx(talk.counter.lead, abs=20e-6)


def test_a_status_that_may_show_either_of_two_marks_is_no_reading() -> None:
    """The second Mark is lost, twice in a row: the status shows the clock of 50 ms before."""
    talk = Exchanges(Counter(20e-6), uniform(1, 0.0, 125e-6))
    talk.arm()
    talk.run(5.0)
    for _ in range(2):
        heard = talk.now
        for at in (heard, heard + 0.05):
            talk.held.sent("Mark", {}, at, at)
        talk.counter.go(heard)
        word, talk.now = talk.counter.word, heard + 0.06
        show(talk, word)
    assert talk.held.problem(talk.now) is None
    assert talk.held.scatter(talk.now) < 50e-6


def test_no_rate_is_more_than_a_ping_can_say() -> None:
    """1.2 ms ahead of one that is 0.3 ms ahead, each 200 ppm fast: 3.5e-3 in all, 3.28e-3 go."""
    talks = [Exchanges(Counter(200e-6)) for _ in range(2)]
    for talk, ahead in zip(talks, (0.3e-3, 1.5e-3), strict=True):
        talk.counter.shown += ahead
        talk.run(1.0)
        talk.send("Arm", shift=0)
    talks[0].held.compare(None)
    talks[1].held.compare(talks[0].held)
    mark(talks, 4, lambda: 0.0)
    assert talks[1].held.is_compared
    assert -32768 <= talks[1].held.rate(talks[1].now, is_playing=False) < -25000


def test_clocks_are_compared_once_three_marks_agree() -> None:
    """One of which a Mark was not heard shows the present clock, 2 ms later: of two none tells."""
    talks = [Exchanges(Counter()) for _ in range(2)]
    for talk in talks:
        talk.run(1.0)
    talks[1].held.compare(talks[0].held)
    mark(talks, 1, lambda: 0.0)
    talks[1].counter.shown += 2e-3
    mark(talks, 1, lambda: 0.0)
    talks[1].counter.shown -= 2e-3
    assert not talks[1].held.is_compared
    mark(talks, 2, lambda: 0.0)
    assert talks[1].held.is_compared
    assert abs(talks[1].held.lead(talks[1].now)) < 1e-6
