"""When loading envelopes is paused, and when it is retried."""

from controller.loop.loading_times import FIRST_PAUSE, MAX_PAUSE, LoadingTimes

SLOW, FAST = 0.031, 0.030


def pause_after(times: LoadingTimes, now: float) -> float:
    """Duration [s] of the pause from a time on, to half a second."""
    return next(
        half / 2 for half in range(10_000) if times.ramp_only_reason(now + half / 2) is None
    )


def test_three_slow_loadings_in_a_row_pause_loading() -> None:
    """One in time between them resets the count; exactly the allowed time is in time."""
    times = LoadingTimes(FAST)
    for duration in (SLOW, SLOW, FAST, SLOW, SLOW):
        times.note(duration, now=5.0)
        assert times.ramp_only_reason(5.0) is None
    times.note(SLOW, now=5.0)
    assert times.ramp_only_reason(5.0) is not None
    assert "took 31 ms" in str(times.ramp_only_reason(5.0))
    assert pause_after(times, 5.0) == FIRST_PAUSE


def test_pauses_double_up_to_the_maximum() -> None:
    """Each attempt costs one slow loading only: 30, 60, 120, 240, 480, 480 s."""
    times, now, pauses = LoadingTimes(FAST), 0.0, []
    times.note(SLOW, now=now)
    times.note(SLOW, now=now)
    for _ in range(6):
        times.note(SLOW, now=now)
        pauses.append(pause_after(times, now))
        now += pauses[-1]
    assert pauses == [30.0, 60.0, 120.0, 240.0, MAX_PAUSE, MAX_PAUSE]


def test_three_loadings_in_time_reset_the_pause() -> None:
    """The next pause needs three slow ones again, and is the first."""
    times = LoadingTimes(FAST)
    for _ in range(3):
        times.note(SLOW, now=0.0)
    for duration in (FAST, FAST, FAST, SLOW, SLOW):
        times.note(duration, now=FIRST_PAUSE)
        assert times.ramp_only_reason(FIRST_PAUSE) is None
    times.note(SLOW, now=FIRST_PAUSE)
    assert pause_after(times, FIRST_PAUSE) == FIRST_PAUSE


def test_two_loadings_in_time_keep_the_pause() -> None:
    """The next slow loading pauses for twice as long."""
    times = LoadingTimes(FAST)
    for _ in range(3):
        times.note(SLOW, now=0.0)
    for duration in (FAST, FAST, SLOW):
        times.note(duration, now=FIRST_PAUSE)
    assert pause_after(times, FIRST_PAUSE) == 2 * FIRST_PAUSE
