"""A surface layout in the daemon: effects of touches, and the events of clients."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from controller.api.jsonrpc import ErrorCode
from controller.api.methods import PlayParams
from controller.daemon.active_layout import ActiveLayout
from controller.effects.buzz import Buzz
from controller.effects.layout import SurfaceLayout
from controller.effects.region import Region
from controller.effects.shapes import Circle
from controller.sources.contacts import Contact, ContactKey
from daemon_bench import error_code, holding, next_event, ready_daemon, until

LAYOUT = """\
effects:
  hum: {kind: buzz, level: 14}
  alert: {kind: buzz, duration: 10 s, level: 18}
regions:
  pad: {rectangle: {start: [0, 0], end: [0.15, 0.15]}, on_press: hum}
  quiet: {rectangle: {start: [0.16, 0], end: [0.3, 0.15]}}
elsewhere: null
"""
ON_PAD, ON_QUIET = (0.1, 0.1), (0.25, 0.1)


@pytest.fixture
def resting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fingers that stay until they lift: a busy machine may repeat their frames too late."""
    monkeypatch.setattr("controller.sources.contacts.CONTACT_TIMEOUT", 60.0)


@pytest.mark.usefixtures("resting")
async def test_daemon_plays_effects_by_region_and_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A region's effect plays at its own level; a request needs a finger and at most that level."""
    (tmp_path / "layout.yaml").write_text(LAYOUT, encoding="utf-8")
    async with ready_daemon(tmp_path, "layout: layout.yaml\n") as (bench, era):
        view = bench.daemon._publisher.view

        async def level_of(effect: str) -> float | None:
            await until(lambda: [each.effect for each in view.contact_statuses()] == [effect])
            await until(lambda: view.applied is not None)
            return view.contact_statuses()[0].level_db_sl

        layout = (await era.hello("test")).layout
        assert layout is not None
        assert [region["name"] for region in layout["regions"]] == ["pad", "quiet"]
        assert layout["regions"][0] | {"x_m": 0.0, "width_m": 0.15} == layout["regions"][0]
        listed = {each.name: each for each in (await era.effects()).effects}
        assert listed.keys() == {"alert", "buzz", "click", "hum"}
        assert (listed["alert"].kind, listed["alert"].parameters["duration"]) == ("buzz", 10.0)
        assert await error_code(era.play("alert", ON_QUIET)) is ErrorCode.WRONG_STATE
        await era.arm("me", lease_s=60)
        async with holding(era, ON_PAD):
            assert await level_of("hum") == pytest.approx(17, abs=3)
        await era.touch([])
        async with holding(era, ON_QUIET):
            await until(lambda: [each.effect for each in view.contact_statuses()] == [None])
            await until(lambda: not any(bench.far.summary().levels))
            assert (await era.status()).silence_reason
            for effect, place, level in (
                ("alert", ON_PAD, None),  # no finger there
                ("unknown", ON_QUIET, None),
                ("alert", ON_QUIET, 18.1),
            ):
                refused = era.play(effect, place, level_db_sl=level)
                assert await error_code(refused) is ErrorCode.REFUSED
            decided: list[bool] = []
            request_update = bench.daemon._controller.request_update
            monkeypatch.setattr(
                bench.daemon._controller,
                "request_update",
                lambda: (decided.append(True), request_update()),
            )
            await era.play("alert", ON_QUIET, level_db_sl=12)
            assert decided  # not with the next heartbeat
            assert await level_of("alert") == pytest.approx(12, abs=0.5)
            assert (await era.status()).silence_reason is None


async def test_daemon_publishes_layouts_and_rejects_invalid_ones(tmp_path: Path) -> None:
    """Subscribers get the current one, then each replacement, as hello does from then on."""
    path = tmp_path / "layout.yaml"
    path.write_text(LAYOUT, encoding="utf-8")
    async with ready_daemon(tmp_path, "layout: layout.yaml\n") as (bench, era):
        await era.subscribe("layout")

        async def published() -> dict[str, object]:
            return dict((await next_event(era, "layout")).data["layout"])

        assert await published() == (await era.hello("test")).layout
        path.write_text(LAYOUT.replace("level: 14", "level: loud"), encoding="utf-8")
        await bench.daemon.reload()
        path.write_text(LAYOUT.replace("pad:", "field:"), encoding="utf-8")
        await bench.daemon.reload()
        layout = await published()
        assert [region["name"] for region in layout["regions"]] == ["field", "quiet"]
        assert (await era.hello("test")).layout == layout


@pytest.mark.parametrize(
    ("most", "second", "is_held_back"),
    [(2, "high", True), (2, "wide", False), (2, "any", False), (1, "high", False)],
)
def test_play_is_held_back_while_another_frequency_plays(
    most: int, second: str, is_held_back: bool
) -> None:
    """The reply to the second of two requests at two fingers; alone it plays its own."""
    effects = {
        "low": Buzz(frequency=80.0),
        "high": Buzz(frequency=250.0),
        "wide": Buzz(band=(70.0, 300.0)),
        "any": Buzz(),
    }
    active = ActiveLayout(SurfaceLayout(effects=effects, elsewhere=None, most_at_once=most))
    fingers = [Contact(ContactKey("a", n), 0.1 * n, 0.1, since=0.0) for n in (1, 2)]
    active.intent(fingers, 0.0)
    held_back = [
        active.play_nearest(
            PlayParams(effect=name, x_m=finger.x, y_m=finger.y, level_db_sl=None),
            fingers,
            frequencies=np.array([80.0, 120.0, 250.0]),
            now=0.1,
        ).held_back
        for name, finger in zip(("low", second), fingers, strict=True)
    ]
    assert [each is not None for each in held_back] == [False, is_held_back]
    assert len(active.intent(fingers, 0.2).targets) == most


def test_layout_warns_of_effects_that_cannot_sound_together() -> None:
    """Requested ones, and those of regions of one priority, if several fingers may be driven."""
    effects = {"low": Buzz(frequency=80.0), "any": Buzz()}
    regions = [
        Region("a", Circle(0.1, 0.1, 0.02), on_press="any", priority=priority, band=band)
        for priority, band in [(0, (70.0, 100.0)), (0, (200.0, 250.0)), (1, (300.0, 400.0))]
    ]
    layout = SurfaceLayout(effects=effects, elsewhere="low", regions=tuple(regions))
    assert layout.warnings() == []
    assert len(replace(layout, most_at_once=2).warnings()) == 2  # low and 200 Hz; 70 and 200 Hz
    effects["high"] = Buzz(frequency=250.0)
    requested = SurfaceLayout(effects=effects, elsewhere=None, most_at_once=2)
    assert len(requested.warnings()) == 1
