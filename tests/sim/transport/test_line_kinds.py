"""Delays of lines against the numbers of their standards and data sheets."""

import statistics

import pytest

from sim.transport.simulated_line import LINE_KINDS, Latency, LineKind

PROMPT = Latency()
FRAME_ERROR = 50e-6  # of a frame's length, relative


def test_usb_moves_bytes_in_the_next_frame() -> None:
    """Either way 0 to 1 ms later, 0.5 ms on average, at whole frames from each other."""
    delays = LineKind(PROMPT, PROMPT, frame=1e-3).delays(1)
    times = [number * 1.3717e-3 for number in range(2000)]
    for shift in (delays.leave, delays.arrive):
        moved = [shift(time, 10) for time in times]
        late = [after - before for after, before in zip(moved, times, strict=True)]
        assert min(late) >= 0
        assert max(late) <= 1e-3 * (1 + FRAME_ERROR)
        assert statistics.mean(late) == pytest.approx(0.5e-3, rel=0.05)
        frames = [(time - moved[0]) / 1e-3 for time in moved]
        assert all(abs(frame - round(frame)) <= FRAME_ERROR * frame + 1e-6 for frame in frames)


def test_bytes_take_their_time_on_usb() -> None:
    """1 500 bytes at 12 Mbit/s: 1 ms."""
    delays = LineKind(PROMPT, PROMPT, usb_byte=8 / 12e6).delays(1)
    assert delays.leave(2.0, 1500) == pytest.approx(2.001)
    assert delays.arrive(3.0, 1500) == pytest.approx(3.001)


def test_ftdi_holds_small_replies_until_its_timer_has_run() -> None:
    """10 bytes wait for 8 ms on average, at most 16; 62 go at once, and the timer begins anew."""
    delays = LineKind(PROMPT, PROMPT, latency_timer=16e-3).delays(1)
    times = [0.1 + number * 0.0371 for number in range(2000)]
    late = [delays.arrive(time, 10) - time for time in times]
    assert 0 < min(late) <= max(late) <= 16e-3
    assert statistics.mean(late) == pytest.approx(8e-3, rel=0.05)
    assert delays.arrive(100.0, 62) == 100.0
    assert delays.arrive(100.001, 10) == pytest.approx(100.016)
    assert delays.arrive(100.002, 10) == pytest.approx(100.016)  # in the same packet
    assert delays.arrive(200.0, 100) == pytest.approx(200.016)  # all but the first 62


def test_latency_has_its_least_and_median_and_stalls() -> None:
    """Half of 20 000 draws lie below 10 + 20 us; 2 % have 1 ms more on average."""
    rng = LINE_KINDS["native"].delays(1)._rng
    drawn = [Latency(10e-6, 20e-6, 0.5).draw(rng) for _ in range(20_000)]
    assert min(drawn) > 10e-6
    assert statistics.median(drawn) == pytest.approx(30e-6, rel=0.03)
    stalled = [Latency(stalls=0.02, stall=1e-3).draw(rng) for _ in range(50_000)]
    assert sum(each > 0 for each in stalled) / 50_000 == pytest.approx(0.02, rel=0.1)
    assert statistics.mean(each for each in stalled if each) == pytest.approx(1e-3, rel=0.1)
    assert max(stalled) <= 5e-3


@pytest.mark.parametrize("name", LINE_KINDS)
def test_delays_keep_the_order_and_are_those_of_their_seed(name: str) -> None:
    """What is written first leaves first, each way, none too late; another seed, other delays."""

    def drawn(seed: object) -> list[float]:
        delays = LINE_KINDS[name].delays(seed)
        return [delays.leave(n * 1e-4, 30) for n in range(300)] + [
            delays.arrive(n * 1e-4, 30) for n in range(300)
        ]

    times = drawn(("line", 1))
    spent = [time - n % 300 * 1e-4 for n, time in enumerate(times)]
    assert max(spent[:300]) + max(spent[300:]) <= LINE_KINDS[name].max_delay + 1e-3
    assert times[:300] == sorted(times[:300])
    assert times[300:] == sorted(times[300:])
    assert times == drawn(("line", 1)) != drawn(("line", 2))
