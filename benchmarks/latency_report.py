"""The cases of the latency benchmark, and their figures as a page of the documentation."""

import platform
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.latency_picture import draw
from benchmarks.latency_run import FLOOD_RATE, NICE, WORKERS, Case, Found
from benchmarks.latency_touches import SLIDE, Work
from controller.selection import MOVE_TOLERANCE

DOCS = Path(__file__).parent.parent / "docs"
PICTURE = "pictures/latency.png"
TARGETS = (2.0, 5.0, 10.0)  # ms: median, 99th percentile, 99.9th

FAST, CALM = 1000.0, 100.0  # Hz

HEAD = (
    "| case | touches | commands | no touch's | median | 99th | 99.9th | most | jitter | "
    "longest waiting: median | 99th | 99.9th | daemon: median | 99th | 99.9th | computing |\n"
    "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|"
)

INTRODUCTION = """# How long a touch takes to the wire

Printed by `make bench-latency`, which runs `python -m benchmarks.latency --report`{options} on a
machine that does nothing else (two cores). {machine}

**What is measured.** A panel sends TUIO datagrams over UDP. The daemon reads them, asks the table
who feels what, lets the guard check it and writes the set to a serial line, here a pseudo-terminal.
At its far end a program notes when the last byte of each set has arrived. Both ends read
CLOCK_MONOTONIC, the panel just before it sends. Which touch a set answers is found from outside
too: the table is asked again, offline, what it answers for the touches that were sent, and a set
that plays that answers it. Sets that answer none would be counted under *no touch's*.

- **Taps**: every frame is another finger somewhere else, a thousand times a second, beside one that
  stays and is to feel nothing. Each asks the table anew, and each answer is another set.
- **Slide**: one finger wanders at {slide:g} m/s. What plays stays while no finger has moved by more
  than {tolerance:g} mm since it was chosen, so about every ninth frame asks for a set; frames that
  ask for none have no latency and are not counted.
- **Faster than sets**: only one set is on its way at a time, since the next one depends on what the
  amplifier made of it. Touches that come meanwhile are taken together, and the next set answers the
  newest; the fingers of those before are gone by then. The latency counts from the newest, the one
  that is answered. *Longest waiting* counts from the oldest of those that were taken together, and
  that is what the daemon counts for itself: in `era status`, the topic `latency` and Prometheus,
  from when the system received the datagram until the last byte was written.
- **Loaded**: another client sends {flood} touches a second to the API, each of them news, and
  {workers} other programs compute all the time. Daemon and far end run at nice {nice}, as the unit
  does that `era systemd install` prints.
- **Beside it** *plain asyncio*: python-osc reads the same datagrams, the place chooses among sets
  that were encoded beforehand, and out they go, over the same pseudo-terminal to the same far end.
  No table, no guard, nobody kept quiet, no answer waited for.

Jitter is the standard deviation. *Computing* is the processor time of the daemon for each set, all
else that it does meanwhile included. All times in milliseconds.

"""

WITHOUT = "No figures yet: the command writes them here, with the histogram.\n"

END = """
**Shaped onsets.** With `touch_wait: 30 ms`, the default of the [daemon](daemon.md), a touch that
starts from rest waits until its [shaped onset](transients.md) is found and loaded: four envelopes,
each with an answer of its own. With `touch_wait: 0 ms` it starts along a plain ramp, at once. That
costs contrast while it starts, not afterwards: over the first 100 ms 19 dB in place of 28 to one
quiet finger, 12 in place of 16 to two ([measured](transients.md)). A finger that slides waits in
neither case, for what plays already needs no onset.

**A pseudo-terminal is not free.** Bytes go through it by a thread of the kernel, which has to get a
core as well; a real port has its own way and its own time, by arithmetic
([wires](wire-protocol.md)). And where the system shares the cores among sessions first (autogroup,
see sched(7)), nice counts within a session only: daemon and far end have sessions of their own
here, as urgent as themselves.
"""


def cases(touches: int, seed: int) -> list[Case]:
    """What is measured, the target first; most others with a fifth of the touches or so."""
    fifth = touches // 5
    fast = Work("taps", touches, FAST, seed)
    some = Work("taps", fifth, FAST, seed)
    calm = Work("taps", max(1, fifth // 10), CALM, seed)
    return [
        Case("taps, loaded", fast, True, 0.0),
        Case("plain asyncio, loaded", fast, True, None),
        Case("taps", some, False, 0.0),
        Case("plain asyncio", some, False, None),
        Case("slide, loaded", Work("slide", fifth, FAST, seed), True, 0.0),
        Case("taps at 100 Hz, loaded", calm, True, 0.0),
        Case("taps at 100 Hz, loaded, shaped onsets", calm, True, 30.0),
    ]


def check_case(touches: int, seed: int) -> Case:
    """What tests look at."""
    return Case("taps at 100 Hz", Work("taps", touches, CALM, seed), False, 0.0)


def as_json(found: Found) -> dict[str, object]:
    """What was measured, command by command, in milliseconds, and what the daemon says itself."""
    matched = found.matched
    return {
        "sent": found.sent,
        "unmatched": matched.unmatched,
        "touch": matched.touch.tolist(),
        "newest_ms": (1e3 * matched.newest).tolist(),
        "oldest_ms": (1e3 * matched.oldest).tolist(),
        "own": None if found.own is None else found.own.model_dump(),
    }


def lines(found: Sequence[Found], *, first: bool) -> str:
    """Rows of the table, with its head if they are the first."""
    return "\n".join([*([HEAD] if first else []), *map(_row, found)])


def write_report(found: Sequence[Found], *, touches: int, seed: int) -> None:
    """The page and its picture; without any figures the page that is to be filled."""
    options = "" if (touches, seed) == (100_000, 1) else f" with --touches {touches} --seed {seed}"
    machine = ""
    if found:
        machine = f"Python {platform.python_version()}, {platform.system()} {platform.machine()}."
    text = INTRODUCTION.format(
        options=options,
        machine=machine,
        slide=SLIDE,
        tolerance=1e3 * MOVE_TOLERANCE,
        flood=f"{FLOOD_RATE:_}".replace("_", " "),
        workers=WORKERS,
        nice=NICE,
    )
    text = text.replace("two cores). \n", "two cores).\n")
    if found:
        draw(found, DOCS / PICTURE, targets=TARGETS)
        text += f"{lines(found, first=True)}\n\n{_verdict(found)}\n\n![Histogram]({PICTURE})\n"
    else:
        text += WITHOUT
    page = DOCS / "latency.md"
    page.write_text(text + END, encoding="utf-8")
    print(f"wrote {page}")


def _row(found: Found) -> str:
    matched = found.matched
    cells = [
        found.case.name + ("" if found.is_urgent else " (nice not allowed)"),
        str(found.sent),
        str(len(matched.touch)),
        str(matched.unmatched),
        *_quantiles(matched.newest),
        _ms(matched.newest.max(initial=0.0)),
        _ms(float(np.std(matched.newest)) if len(matched.newest) else 0.0),
        *_quantiles(matched.oldest),
    ]
    own = found.own
    cells += ["", "", ""] if own is None else [_own(own.median), _own(own.p99), _own(own.p999)]
    computing = found.computed / max(1, len(matched.touch))
    return f"| {' | '.join([*cells, _ms(computing)])} |"


def _quantiles(times: np.ndarray) -> list[str]:
    if len(times) == 0:
        return ["", "", ""]
    return [_ms(value) for value in np.quantile(times, [0.5, 0.99, 0.999], method="inverted_cdf")]


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.2f}"


def _own(milliseconds: float | None) -> str:
    return "" if milliseconds is None else f"{milliseconds:.2f}"


def _verdict(found: Sequence[Found]) -> str:
    """Whether the first case is within the targets, and how it stands to the plain exchange."""
    ours, plain = (
        1e3 * np.quantile(one.matched.newest, [0.5, 0.99, 0.999], method="inverted_cdf")
        for one in found[:2]
    )
    limits = ", ".join(
        f"{name} {value:.2f} of {limit:g} ms ({'met' if value <= limit else '**missed**'})"
        for name, value, limit in zip(_NAMES, ours, TARGETS, strict=True)
    )
    ratios = ", ".join(
        f"{name} {value:.1f}" for name, value in zip(_NAMES, ours / plain, strict=True)
    )
    more = 1e3 * (np.median(found[0].matched.newest) - np.median(found[1].matched.newest))
    return (
        f"Targets, loaded: {limits}. Times the plain exchange in the same run: {ratios}; the "
        f"table, the guard and the rest cost {more:.2f} ms of the median."
    )


_NAMES = ("median", "99th percentile", "99.9th")
