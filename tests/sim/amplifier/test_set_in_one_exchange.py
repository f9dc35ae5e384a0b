"""Parts of a set, and Commit at a moment, against the rule of docs/decisions/0088 step by step."""

import math
import random

import pytest

from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import Command, LayerSet, pack_layers, parts
from drivers.protocol.table import STATES
from sim.amplifier.clock import AmplifierClock, Crystal
from sim.amplifier.contract import Amplifier

SESSION = 7
STEP = 20 / 65536  # s; of the high word of the clock
HALF, FULL = 5000, 10000


def armed(at: float = 0.0) -> Amplifier:
    """An amplifier of two channels, armed, watchdog 2 s; its clock shows 0 at time 0."""
    amplifier = Amplifier("a", channels=2)
    amplifier.handle("Arm", {"session": SESSION, "watchdog": 2000, "shift": 0}, at)
    return amplifier


def cut(token: int, level: int = HALF, *, count: int = 3, now: int = 0) -> list[Values]:
    """The parts of a set that plays 100 Hz at once on channel 0."""
    stream = pack_layers([LayerSet(0, 0, 0, (Command(0, 2000, level, 0),))])
    width = -(-len(stream) // count)
    return parts(stream, session=SESSION, token=token, now=bool(now), max_words=width)


def send(amplifier: Amplifier, part: Values, at: float = 0.1, **changed: object) -> str:
    """What is said of a part: nothing, a refusal, or what Taken says."""
    try:
        taken = amplifier.handle("Set", {**part, **changed}, at)
    except Refusal as refusal:
        return refusal.code
    if not taken:
        return ""
    assert not (taken["exact"] and not (taken["staged"] or taken["played"]))
    words = ("staged",) * taken["staged"] + ("played",) * taken["played"]
    return " ".join(words) or f"missing {taken['missing']}"


def commit(amplifier: Amplifier, token: int, at: float, moment: int | None = None) -> str:
    """What is said of a commit at once, or at a high word of the clock."""
    values = {"session": SESSION, "token": token, "at": moment or 0}
    try:
        return f"token {amplifier.handle('Commit', values, at)['token']}"
    except Refusal as refusal:
        return refusal.code


def level(amplifier: Amplifier, at: float) -> int:
    """The level of channel 0."""
    return int(amplifier.handle("GetStatus", {}, at)["levels"][0])


def test_last_part_alone_is_replied_to() -> None:
    """In any order of the others and again; the last before them is not kept, and says what lacks.

    A repeated last part is confirmed, whatever its stream, and plays where it says `now`.
    """
    amplifier = armed()
    first, second, last = cut(1)
    said = [send(amplifier, each) for each in (last, second, last)]
    assert said == ["missing 0", "", "missing 0"]
    assert [send(amplifier, each) for each in (first, second, last)] == ["", "", "staged"]
    assert send(amplifier, last, stream=[1, 2, 3]) == "staged"
    assert level(amplifier, 0.1) == 0
    assert send(amplifier, last, now=1) == "played"
    assert send(amplifier, last, stream=[]) == "played"
    assert level(amplifier, 0.1) == HALF


def test_part_that_is_dropped_changes_nothing_and_says_nothing() -> None:
    """Of another session, a token that is not newer, `parts` other than before, or disarmed."""
    amplifier = armed()
    assert send(amplifier, cut(5, count=1)[0], now=1) == "played"
    first, second, last = cut(7)
    assert send(amplifier, first) == ""
    for other in (
        {"session": 8},
        {"token": 5},
        {"token": 4},
        {"token": 6},
        {"parts": 4},
        {"token": 5 + 0x8000},
    ):
        assert send(amplifier, second, **other) == ""
    assert send(amplifier, last) == "missing 1"
    assert send(amplifier, second, stream=[0, 0, 0]) == ""
    assert send(amplifier, second) == ""  # in place of the other content
    assert send(amplifier, last) == "staged"
    amplifier.handle("Stop", {"ramp": 0}, 0.1)
    assert (send(amplifier, first), send(amplifier, last)) == ("", "WRONG_STATE")


def test_kept_part_feeds_and_dropped_one_does_not() -> None:
    """The watchdog of 2 s counts from the last part that was kept."""
    amplifier = armed()
    first, second, _ = cut(1)
    send(amplifier, first, 0.5)
    send(amplifier, second, 1.0, session=8)
    send(amplifier, second, 1.0, parts=4)
    assert amplifier.handle("GetStatus", {}, 1.0)["watchdog_left"] == 1500
    send(amplifier, second, 1.0)
    assert amplifier.handle("GetStatus", {}, 1.0)["watchdog_left"] == 2000


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"token": 5}, "played"),  # 1: even of another index, and a stream of nonsense
        ({"token": 5, "stream": [9]}, "played"),
        ({"token": 4}, "BAD_TOKEN"),  # 2
        ({"token": 6}, "BAD_TOKEN"),  # older than that collected
        ({"index": 3}, "BAD_VALUE"),
        ({"token": 8, "index": 3}, "BAD_VALUE"),
        ({"parts": 2}, "BAD_VALUE"),
        ({"token": 8}, "missing 0"),  # 3
        ({}, "missing 1"),
        ({"session": 8}, "WRONG_SESSION"),
    ],
)
def test_last_part_that_is_not_kept_changes_nothing(changed: Values, said: str) -> None:
    """Each step in its order; then the set that was collected is completed as it was."""
    amplifier = armed()
    send(amplifier, cut(5, count=1)[0], now=1)
    first, second, last = cut(7, FULL)
    send(amplifier, first)
    assert send(amplifier, last, **changed) == said
    assert [send(amplifier, second), send(amplifier, last)] == ["", "staged"]
    assert (commit(amplifier, 7, 0.1), level(amplifier, 0.1)) == ("token 7", FULL)


def test_refused_set_drops_its_own_parts_alone() -> None:
    """A whole set that is flawed; a newer single part that is refused leaves what is staged."""
    amplifier = armed()
    first, second, last = cut(1)
    flawed = pack_layers([LayerSet(0, 0, 0, (Command(2, 2000, HALF, 0),))])
    assert send(amplifier, last) == "missing 0"
    for part in (first, second):
        send(amplifier, part, stream=flawed)
    assert send(amplifier, last, stream=[]) == "BAD_CHANNEL"
    assert send(amplifier, last) == "missing 0"
    assert [send(amplifier, each) for each in (first, second, last)] == ["", "", "staged"]
    assert send(amplifier, cut(2, count=1)[0], stream=flawed) == "BAD_CHANNEL"
    assert send(amplifier, cut(2)[2]) == "missing 0"
    assert send(amplifier, last) == "staged"
    send(amplifier, cut(2)[0])  # a part that is kept
    assert send(amplifier, last) == "BAD_TOKEN"
    assert commit(amplifier, 1, 0.1) == "BAD_TOKEN"
    assert commit(amplifier, 2, 0.1) == "INCOMPLETE"


def test_set_is_gone_a_second_after_its_first_part() -> None:
    """Collected or staged, whenever its other parts came; one without words is a set."""
    amplifier = armed()
    first, second, last = cut(1)
    send(amplifier, first, 0.0)
    send(amplifier, second, 0.9)
    assert send(amplifier, last, 0.99) == "staged"
    assert commit(amplifier, 1, 1.01) == "BAD_TOKEN"
    assert send(amplifier, last, 1.02) == "missing 0"
    assert send(amplifier, cut(1, count=1)[0], 1.03, stream=[]) == "staged"
    assert commit(amplifier, 1, 1.04) == "token 1"


def test_commit_names_a_moment() -> None:
    """From 1 to 1638 steps ahead the set waits, counts as committed, and starts to the moment."""
    amplifier = armed()
    (part,) = cut(1, count=1)
    at = 100.5 * STEP
    send(amplifier, part, at)
    assert commit(amplifier, 1, at, 164) == "token 1"
    assert amplifier.next_event == pytest.approx(164 * STEP, abs=1e-12)
    assert level(amplifier, 164 * STEP - 1e-6) == 0
    assert commit(amplifier, 1, at + STEP, 0) == "token 1"  # again: confirmed, changes nothing
    assert level(amplifier, 164 * STEP - 1e-7) == 0
    assert send(amplifier, part, 164 * STEP - 1e-7) == "played"
    assert level(amplifier, 164 * STEP + 1e-9) == HALF


@pytest.mark.parametrize(
    ("moment", "waits"), [(99, False), (100, False), (101, True), (1738, True), (1739, False)]
)
def test_moments_beyond_half_a_second_are_now(moment: int, waits: bool) -> None:
    """The present high word, one that has passed, or one more than 1638 steps ahead: at once."""
    amplifier = armed()
    send(amplifier, cut(1, count=1)[0], 100.5 * STEP)
    commit(amplifier, 1, 100.5 * STEP, moment)
    assert (level(amplifier, 100.5 * STEP) == 0) is waits


def test_moment_over_the_end_of_the_clock() -> None:
    """The clock goes round after 20 s: high word 3 is four steps ahead of 65535."""
    amplifier = armed()
    for second in range(1, 20):
        amplifier.handle("Ping", {"session": SESSION, "rate": 0}, float(second))
    at = 20 - STEP / 2
    send(amplifier, cut(1, count=1)[0], at)
    commit(amplifier, 1, at, 3)
    assert level(amplifier, 20 + 3 * STEP - 1e-6) == 0
    assert level(amplifier, 20 + 3 * STEP + 1e-6) == HALF


def test_ping_in_the_very_moment_does_not_put_it_off_by_a_turn() -> None:
    """In the last floating-point number before each of 50 moments, by a rate for each."""
    amplifier = armed()
    amplifier.clock = AmplifierClock(Crystal(error=4e-5, warm_up=1e-6))
    for number in range(1, 51):
        at = number / 2
        send(amplifier, cut(number, 100 * number, count=1)[0], at)
        commit(amplifier, number, at, ((amplifier.clock.reading(at) >> 16) + 300) % 65536)
        moment = math.nextafter(amplifier.next_event, 0.0)
        amplifier.handle("Ping", {"session": SESSION, "rate": 600 * number}, moment)
        assert level(amplifier, moment + 0.001) == 100 * number


@pytest.mark.parametrize("is_now", [False, True])
def test_newer_set_starts_the_one_that_waits_first(is_now: bool) -> None:
    """A newer Commit, or `now`, starts what waits, then its own: on another channel both play."""
    amplifier = armed()
    send(amplifier, cut(1, count=1)[0])
    commit(amplifier, 1, 0.1, 500)
    other = pack_layers([LayerSet(1, 0, 0, (Command(1, 2000, FULL, 0),))])
    (part,) = parts(other, session=SESSION, token=2, now=is_now)
    send(amplifier, part, 0.11)
    assert level(amplifier, 0.11) == (HALF if is_now else 0)
    if not is_now:
        commit(amplifier, 2, 0.12, 900)
    status = amplifier.handle("GetStatus", {}, 0.12)
    assert status["levels"] == [HALF, FULL if is_now else 0]
    assert status["token"] == 2


@pytest.mark.parametrize("name", ["Silence", "Stop", "Disarm", "watchdog", "fault"])
def test_what_silences_drops_what_waits(name: str) -> None:
    """Nothing begins to play at the moment that was named."""
    amplifier = armed()
    send(amplifier, cut(1, count=1)[0], 1.9)
    amplifier.handle("Arm", {"session": SESSION, "watchdog": 100, "shift": 0}, 1.9)
    commit(amplifier, 1, 1.9, int(2.1 / STEP))
    match name:
        case "Silence":
            amplifier.handle(name, {"session": SESSION, "ramp": 0}, 1.95)
        case "Stop" | "Disarm":
            amplifier.handle(name, {"ramp": 0}, 1.95)
        case "fault":
            amplifier.trip("ARC", 1.95)
    if name == "Silence":
        amplifier.handle("Ping", {"session": SESSION, "rate": 0}, 2.04)
    assert level(amplifier, 2.12) == 0
    state = amplifier.handle("GetStatus", {}, 2.12)["state"]
    assert (state == STATES["OPERATION_ENABLED"]) is (name == "Silence")


def test_mark_is_shown_by_the_next_status_alone() -> None:
    """1 s is 2^32 / 20 of the clock, which a later status shows in place of its own, once."""
    amplifier = armed()
    per_second = 2**32 / 20
    assert amplifier.handle("Mark", {}, 1.0)["clock"] == round(per_second)
    assert amplifier.handle("GetStatus", {}, 1.5)["clock"] == round(1.5 * per_second)


def test_random_parts_never_play_in_part() -> None:
    """Parts of three tokens in any order: what plays is a whole set as one host has cut it."""
    chance, amplifier, at = random.Random(5), armed(), 0.0
    played = {0}
    for _ in range(3_000):
        at += chance.choice((0.001, 0.3))
        token = max(played) + chance.choice((0, 1, 1, 1, 2))
        several = cut(max(token, 1), 10 * token, count=1 + token % 4, now=1)
        part = chance.choice(several)
        said = send(amplifier, part, at)
        assert bool(said) is (part is several[-1])
        status = amplifier.handle("Ping", {"session": SESSION, "rate": 0}, at)
        assert status["levels"][0] == 10 * status["token"]
        played.add(status["token"])
    assert len(played) > 100
