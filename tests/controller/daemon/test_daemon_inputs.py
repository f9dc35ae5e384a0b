"""Touch sources of a daemon: whose frames arrive under which name, and what ends with whom."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from controller.api.methods import TouchParams
from controller.api.schema import TouchPoint
from controller.daemon.config import TouchInput
from controller.daemon.touch_inputs import MAX_SOURCES_PER_CLIENT, ApiTouches, TouchInputs
from controller.sources.calibration import TouchCalibration
from controller.sources.touch import Touch, TouchFrame, TouchSource
from model.errors import InputError
from model.structure.plate import Material, Plate

PLATE = Plate(0.4, 0.2, 0.0015, Material("aluminium", 70e9, 2700.0, 0.33))


def said(source: str, *places: tuple[float, float]) -> TouchParams:
    """A frame as a client sends it."""
    touches = [TouchPoint(id=id, x_m=x, y_m=y) for id, (x, y) in enumerate(places)]
    return TouchParams(source=source, touches=touches)


async def test_metres_become_what_touch_sources_say() -> None:
    """x to the right, y downwards, 0..1 over the plate; the time is that of the arrival."""
    frames: list[TouchFrame] = []
    touches = ApiTouches(PLATE, frames.append)
    touches.add("client", said("me", (0.1, 0.05), (9.0, 0.0)), client_name="7", now=12.5)
    assert frames == []
    await asyncio.sleep(0)
    assert frames == [TouchFrame("api:7:me", 12.5, (Touch(0, 0.25, 0.75), Touch(1, 22.5, 1.0)))]


async def test_of_many_frames_in_a_turn_the_newest_counts() -> None:
    """One frame of each source is delivered, however many came."""
    frames: list[TouchFrame] = []
    touches = ApiTouches(PLATE, frames.append)
    for number in range(1000):
        touches.add("client", said("me", (0.0004 * number, 0.0)), client_name="1", now=number)
        touches.add("client", said("you", (0.1, 0.0)), client_name="1", now=number)
    await asyncio.sleep(0)
    assert [(frame.source, frame.time) for frame in frames] == [
        ("api:1:me", 999),
        ("api:1:you", 999),
    ]
    assert frames[0].touches[0].x == pytest.approx(0.999)


async def test_a_client_that_leaves_lifts_its_fingers_and_no_others() -> None:
    """An empty frame for each of its sources that has fingers down, at once."""
    frames: list[TouchFrame] = []
    touches = ApiTouches(PLATE, frames.append)
    touches.add("a", said("me", (0.1, 0.1)), client_name="1", now=1)
    touches.add("a", said("lifted", (0.1, 0.1)), client_name="1", now=1)
    touches.add("a", said("lifted"), client_name="1", now=1)
    touches.add("b", said("me", (0.1, 0.1)), client_name="2", now=1)
    await asyncio.sleep(0)
    frames.clear()
    touches.lift_all("a", now=2)
    touches.lift_all("nobody", now=2)
    await asyncio.sleep(0)
    assert frames == [TouchFrame("api:1:me", 2, ())]


def test_sources_of_a_client_are_bounded() -> None:
    """64 with fingers down; one that lifts them makes room."""

    async def scenario() -> None:
        touches = ApiTouches(PLATE, lambda frame: None)
        for number in range(MAX_SOURCES_PER_CLIENT):
            touches.add("a", said(str(number), (0.1, 0.1)), client_name="1", now=1)
        with pytest.raises(InputError, match="at most 64"):
            touches.add("a", said("more", (0.1, 0.1)), client_name="1", now=1)
        touches.add("a", said("0"), client_name="1", now=1)
        touches.add("a", said("more", (0.1, 0.1)), client_name="1", now=1)

    asyncio.run(scenario())


@dataclass
class Panel(TouchSource):
    """Delivers one frame, then goes on or fails."""

    name: str
    error: Exception | None = None
    ended: list[str] = field(default_factory=list)

    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """As a source."""
        deliver(TouchFrame(self.name, 0.0, ()))
        if self.error is not None:
            raise self.error
        try:
            await asyncio.Event().wait()
        finally:
            self.ended.append(self.name)


async def test_sources_run_under_their_names_and_are_exchanged(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One that fails is told and disturbs no other; exchanging leaves those alone that stay."""
    panels = {
        "a:": Panel("x\x1b[2J"),
        "b:": Panel("y", OSError("unplugged")),
        "c:": Panel("z"),
    }
    monkeypatch.setattr("controller.daemon.config.open_source", panels.__getitem__)
    frames: list[str] = []
    failed: list[tuple[str, str]] = []
    inputs = TouchInputs(
        lambda frame: frames.append(frame.source),
        failed=lambda name, error: failed.append((name, str(error))),
    )
    one, two, three = (
        TouchInput(name, url, TouchCalibration())
        for name, url in (("left", "a:"), ("right", "b:"), ("table", "c:"))
    )
    await inputs.replace([one, two])
    await asyncio.sleep(0.01)
    assert frames == ["left:'x\\x1b[2J'", "right:y"]
    assert failed == [("right", "unplugged")]
    await inputs.replace([one, three])
    await asyncio.sleep(0.01)
    assert frames[2:] == ["table:z"]
    assert panels["a:"].ended == []
    await inputs.close()
    assert (panels["a:"].ended, panels["c:"].ended) == (["x\x1b[2J"], ["z"])


async def test_a_source_that_fails_is_begun_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a pause that grows, until it works; one that has come to its end is not."""
    errors: list[Exception | None] = [InputError("not plugged in"), OSError("gone"), None]
    runs: list[str] = []

    class Late(TouchSource):
        async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
            runs.append("run")
            error = errors.pop(0)
            if error is not None:
                raise error

    paused: list[float] = []
    sleep = asyncio.sleep

    async def pause(seconds: float) -> None:
        paused.append(seconds)
        await sleep(0)

    monkeypatch.setattr("controller.daemon.config.open_source", lambda url: Late())
    monkeypatch.setattr("controller.daemon.touch_inputs.asyncio.sleep", pause)
    failed: list[str] = []
    inputs = TouchInputs(
        lambda frame: None, failed=lambda name, error: failed.append(f"{name}: {error}")
    )
    await inputs.replace([TouchInput("left", "a:", TouchCalibration())])
    for _ in range(20):
        await sleep(0)
    assert failed == ["left: not plugged in", "left: gone"]
    assert (len(runs), paused) == (3, [1.0, 2.0])
    await inputs.close()
