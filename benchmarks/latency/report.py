"""The cases of the latency benchmark, and their figures as a page of the documentation."""

import platform
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.latency.picture import draw
from benchmarks.latency.programs import DEVICE_NICE
from benchmarks.latency.run import FLOOD_RATE, WORKERS, Case, Failed, Found
from benchmarks.latency.touches import SLIDE, Work
from controller.deploy.files import NICE
from controller.loop.selection import MOVE_TOLERANCE

DOCS = Path(__file__).parents[2] / "docs"
PICTURE = "pictures/latency.png"
TARGETS = (2.0, 5.0, 10.0)  # ms: median, 99th percentile, 99.9th

FAST, CALM = 1000.0, 100.0  # Hz
USUAL = 100.0  # s; a hundred thousand touches
SHORTER = 5  # so much shorter than the first are most cases
QUIET = 0.25  # processors; where others kept more of them busy, it is said

HEAD = (
    "| case | touches | commands | unmatched | median | 99th | 99.9th | maximum | jitter | "
    "oldest touch: median | 99th | 99.9th | daemon: median | 99th | 99.9th | CPU | "
    "other load |\n"
    "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|"
)

HEAD_CELLS = HEAD.split("\n")[1].count("---")

INTRODUCTION = """# Touch-to-wire latency

Printed by `make bench-latency`, which runs `python -m benchmarks.latency --report`{options} on an
otherwise idle machine (two cores); {lasts}.{machine}
`python -m benchmarks.latency --seconds 2` is a functional check of one minute.

**Method.** A panel sends TUIO datagrams over UDP. The daemon reads them, queries the table, checks
the set with the guard and writes it to a serial line. At the far end a program records the arrival
of the last byte of each set. Both ends read CLOCK_MONOTONIC, the panel just before it sends. Sets
are matched with touches from outside the daemon: the table is queried offline for the touches that
were sent, and a set that plays the resulting pattern belongs to that touch. Other sets would be
counted as *unmatched*.

- **The line** is a TCP connection over loopback, as to a serial server (`socket://`): what the
  daemon writes is at the far end when the system call returns. For comparison, the same over a
  **pseudo-terminal**: there a kernel thread of ordinary priority carries the bytes and
  needs a core, in both directions. A real port has no such thread; its transmission time can be
  calculated ([wires](../reference/wire-protocol.md)).
- **Devices**: an amplifier and a panel do not use the daemon's processors. The programs that
  represent them do, so they run at the highest priority (SCHED_RR, else nice {device}), and the
  daemon loses the processor time they use, unlike in a real setup.
- **Taps**: every frame has a new finger in another place, a thousand times per second, beside a
  quiet one that stays. Each is a new query of the table and a new set.
- **Slide**: one finger moves at {slide:g} m/s. The pattern stays until the finger has moved by more
  than {tolerance:g} mm, so about every ninth frame causes a set; the other frames
  have no latency and are not counted.
- **Faster than sets**: only one set is under way at a time, since the next one depends on the
  amplifier's reply. Touches that arrive meanwhile are combined, and the next set is for the newest;
  the earlier fingers have lifted by then. The latency counts from this newest touch. *Oldest touch*
  counts from the oldest of those combined. The daemon reports this latency itself, in `era status`,
  the topic `latency` and Prometheus, from the reception of the datagram by the system until the
  last byte was written.
- **Loaded**: another client sends {flood} touches per second to the API, each at a new place, and
  {workers} other programs compute continuously, all at ordinary priority. The daemon runs at
  nice {nice}, as in the unit that `era systemd install` prints.
- **Baseline** *plain asyncio*: python-osc reads the same datagrams, the position selects one of the
  pre-encoded sets, which is written over the same line to the same far end. No table, no guard, no
  quiet fingers, no wait for replies.

Jitter is the standard deviation. *CPU* is the processor time of the daemon per set, including all
other work of the daemon. All times in milliseconds. *Other load* is the number of processors
kept busy by unrelated programs and the kernel; it is close to zero on an idle machine.

"""

WITHOUT = "No figures yet: the command writes them here, with the histogram.\n"

END = """
**Shaped onsets.** With `touch_wait: 30 ms`, the default of the [daemon](../reference/daemon.md), a
touch that starts from rest waits until its [shaped onset](../concepts/transients.md) is computed
and loaded: four envelopes, each with its own reply. With `touch_wait: 0 ms` it starts along a
plain ramp at once, which costs contrast during the onset only: over the first 100 ms
19 dB instead of 28 to one quiet finger, 12 instead of 16 to two
([measured](../concepts/transients.md#measured)). A sliding finger waits in neither case,
since its continuing pattern needs no onset.

**Nice level and sessions.** Where the system shares the cores among sessions first (autogroup, see
sched(7)), nice applies within a session only; here the daemon has its own session.
The reasons against real-time scheduling are in a
[decision](../decisions/0019-nice-not-real-time.md).
"""


def cases(seconds: float, seed: int) -> list[Case]:
    """What is measured, the targets' case first, for so long [s], most others for a fifth of it."""
    shorter = seconds / SHORTER
    fast = Work("taps", _count(seconds, FAST), FAST, seed)
    some = Work("taps", _count(shorter, FAST), FAST, seed)
    slide = Work("slide", _count(shorter, FAST), FAST, seed)
    calm = Work("taps", _count(shorter, CALM), CALM, seed)
    return [
        Case("taps, loaded", fast, True, 0.0),
        Case("plain asyncio, loaded", fast, True, None),
        Case("taps", some, False, 0.0),
        Case("plain asyncio", some, False, None),
        Case("taps, loaded, pseudo-terminal", some, True, 0.0, wire="pty"),
        Case("slide, loaded", slide, True, 0.0),
        Case("taps at 100 Hz, loaded", calm, True, 0.0),
        Case("taps at 100 Hz, loaded, shaped onsets", calm, True, 30.0),
    ]


def check_case(wire: str, seconds: float, seed: int) -> Case:
    """What tests look at."""
    work = Work("taps", _count(seconds, CALM), CALM, seed)
    return Case("taps at 100 Hz", work, False, 0.0, wire=wire)


def _count(seconds: float, rate: float) -> int:
    return max(1, round(seconds * rate))


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


def lines(found: Sequence[Found | Failed], *, first: bool) -> str:
    """Rows of the table, with its head if they are the first."""
    return "\n".join([*([HEAD] if first else []), *map(_row, found)])


def write_report(
    found: Sequence[Found | Failed], *, seconds: float, seed: int, minutes: float, docs: Path = DOCS
) -> None:
    """The page and its picture below a folder; without any figures the page that is to be filled.

    minutes: how long it all took.
    """
    page = docs / "measured" / "latency.md"
    page.write_text(report(found, seconds=seconds, seed=seed, minutes=minutes), encoding="utf-8")
    measured = [one for one in found if isinstance(one, Found) and is_drawn(one.case)]
    if measured:
        draw(measured, docs / PICTURE, targets=TARGETS)
    print(f"wrote {page}")


def report(found: Sequence[Found | Failed], *, seconds: float, seed: int, minutes: float) -> str:
    """The text of the page."""
    options = "" if (seconds, seed) == (USUAL, 1) else f" with --seconds {seconds:g} --seed {seed}"
    machine = f" Python {platform.python_version()}, {platform.system()} {platform.machine()}."
    text = INTRODUCTION.format(
        options=options,
        machine=machine if found else "",
        lasts=f"it took {minutes:.0f} minutes" if found else "it takes about nine minutes",
        slide=SLIDE,
        tolerance=1e3 * MOVE_TOLERANCE,
        flood=f"{FLOOD_RATE:_}".replace("_", " "),
        workers=WORKERS,
        nice=NICE,
        device=DEVICE_NICE,
    )
    if not found:
        return text + WITHOUT + END
    parts = [lines(found, first=True), *filter(None, map(_disturbance, found))]
    first, second = found[:2]
    if isinstance(first, Found) and isinstance(second, Found):
        parts.append(_verdict(first, second))
    if any(isinstance(one, Found) and is_drawn(one.case) for one in found):
        parts.append(f"![Histogram](../{PICTURE})")
    return text + "\n\n".join(parts) + "\n" + END


def is_drawn(case: Case) -> bool:
    """Whether the picture shows a case."""
    return case.work.kind == "taps" and case.work.rate == FAST


def _disturbance(one: Found | Failed) -> str | None:
    """What disturbed a case, None where nothing did."""
    if isinstance(one, Failed):
        attempts = "; then: ".join(one.why)
        return f"**No figures of *{one.case.name}***: {attempts}."
    if one.others > QUIET:
        return (
            f"***{one.case.name}* was disturbed**: other programs kept {one.others:.1f} processors "
            "busy, so its figures are not those of an idle machine."
        )
    return None


def _row(found: Found | Failed) -> str:
    if isinstance(found, Failed):
        return f"| {' | '.join([found.case.name, 'no figures', *[''] * (HEAD_CELLS - 2)])} |"
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
    return f"| {' | '.join([*cells, _ms(computing), f'{found.others:.2f}'])} |"


def _quantiles(times: np.ndarray) -> list[str]:
    if len(times) == 0:
        return ["", "", ""]
    return [_ms(value) for value in np.quantile(times, [0.5, 0.99, 0.999], method="inverted_cdf")]


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.2f}"


def _own(milliseconds: float | None) -> str:
    return "" if milliseconds is None else f"{milliseconds:.2f}"


def _verdict(daemon: Found, exchange: Found) -> str:
    """Whether a case is within the targets, and how it stands to the plain exchange."""
    ours, plain = (
        1e3 * np.quantile(one.matched.newest, [0.5, 0.99, 0.999], method="inverted_cdf")
        for one in (daemon, exchange)
    )
    limits = ", ".join(
        f"{name} {value:.2f} of {limit:g} ms ({'met' if value <= limit else '**missed**'})"
        for name, value, limit in zip(_NAMES, ours, TARGETS, strict=True)
    )
    ratios = ", ".join(
        f"{name} {value:.1f}" for name, value in zip(_NAMES, ours / plain, strict=True)
    )
    more = ours[0] - plain[0]
    return (
        f"Targets, loaded: {limits}. Ratio to the baseline in the same run: {ratios}; the "
        f"table, the guard and the rest take {more:.2f} ms of the median."
    )


_NAMES = ("median", "99th percentile", "99.9th")
