"""A surface layout in the daemon: what it means for touches, and what clients see of it."""

import asyncio
from pathlib import Path

import pytest

from controller.api.async_client import AsyncClient
from controller.api.jsonrpc import ErrorCode, RpcError
from daemon_bench import running_daemon, until, until_state

READY, ENABLED = "READY_TO_SWITCH_ON", "OPERATION_ENABLED"
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


async def keep_touching(era: AsyncClient, *places: tuple[float, float]) -> None:
    """Fingers that stay."""
    while True:
        await era.touch(places)
        await asyncio.sleep(0.04)


async def contacts_as(era: AsyncClient, *effects: str | None) -> list[float | None]:
    """Wait until the fingers have these effects; the levels that they are to feel."""
    async with asyncio.timeout(20):
        while True:
            contacts = (await era.status()).contacts
            if [contact.effect for contact in contacts] == list(effects) and contacts:
                played = [contact for contact in contacts if contact.role is not None]
                if played or effects == (None,):
                    return [contact.level_db_sl for contact in contacts]
            await asyncio.sleep(0.01)


async def test_regions_and_effects_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A region's effect plays at its level; where there is none, nothing, until one is asked for.

    Asking needs a finger, an effect that exists, and at most the effect's own level.
    """
    (tmp_path / "layout.yaml").write_text(LAYOUT, encoding="utf-8")
    async with (
        running_daemon(tmp_path, "layout: layout.yaml\n") as bench,
        await bench.client() as era,
    ):
        await until_state(era, READY)
        layout = (await era.hello("test")).layout
        assert layout is not None
        assert [region["name"] for region in layout["regions"]] == ["pad", "quiet"]
        assert layout["regions"][0] | {"x_m": 0.0, "width_m": 0.15} == layout["regions"][0]
        listed = {each.name: each for each in (await era.effects()).effects}
        assert listed.keys() == {"alert", "buzz", "click", "hum"}
        assert (listed["alert"].kind, listed["alert"].parameters["duration"]) == ("buzz", 10.0)
        with pytest.raises(RpcError) as caught:
            await era.play("alert", ON_QUIET)
        assert caught.value.code is ErrorCode.WRONG_STATE
        await era.arm("me", lease_s=60)

        touching = asyncio.create_task(keep_touching(era, ON_PAD))
        assert await contacts_as(era, "hum") == [pytest.approx(14, abs=0.5)]
        touching.cancel()
        touching = asyncio.create_task(keep_touching(era, ON_QUIET))
        assert await contacts_as(era, None) == [None]
        await until(lambda: not any(bench.far.device.status().levels))
        assert "no effect plays" in ((await era.status()).silent_because or "")

        for effect, place, level in (
            ("alert", ON_PAD, None),  # nobody is there
            ("tickle", ON_QUIET, None),
            ("alert", ON_QUIET, 18.1),
        ):
            with pytest.raises(RpcError) as caught:
                await era.play(effect, place, level_db_sl=level)
            assert caught.value.code is ErrorCode.REFUSED
        asked: list[str] = []
        reconsider = bench.daemon._controller.reconsider
        monkeypatch.setattr(
            bench.daemon._controller, "reconsider", lambda: (asked.append("now"), reconsider())
        )
        await era.play("alert", ON_QUIET, level_db_sl=12)
        assert asked == ["now"]  # not with the next heartbeat
        assert await contacts_as(era, "alert") == [pytest.approx(12, abs=0.5)]
        assert (await era.status()).silent_because is None
        touching.cancel()
        await asyncio.gather(touching, return_exceptions=True)


async def test_a_click_is_over_on_the_wire_while_its_finger_rests(tmp_path: Path) -> None:
    """The amplifier plays, then falls silent, though nothing has come from the finger but rest."""
    text = LAYOUT.replace("on_press: hum", "on_press: click")
    (tmp_path / "layout.yaml").write_text(text, encoding="utf-8")
    async with (
        running_daemon(tmp_path, "layout: layout.yaml\n") as bench,
        await bench.client() as era,
    ):
        await until_state(era, READY)
        await era.arm("me", lease_s=60)
        touching = asyncio.create_task(keep_touching(era, ON_PAD))
        await until(lambda: any(bench.far.device.status().levels))
        await until(lambda: not any(bench.far.device.status().levels))
        status = await era.status()
        assert (status.state, len(status.contacts), status.drive) == (ENABLED, 1, {})
        touching.cancel()
        await asyncio.gather(touching, return_exceptions=True)


async def test_clients_are_told_of_another_layout(tmp_path: Path) -> None:
    """At first what is so now, then every exchange; hello tells the same from then on."""
    path = tmp_path / "layout.yaml"
    path.write_text(LAYOUT, encoding="utf-8")
    async with (
        running_daemon(tmp_path, "layout: layout.yaml\n") as bench,
        await bench.client() as era,
    ):
        await until_state(era, READY)
        await era.subscribe("layout")
        events = era.events()

        async def told() -> dict[str, object]:
            async with asyncio.timeout(20):
                return dict((await anext(events)).data["layout"])

        assert await told() == (await era.hello("test")).layout
        path.write_text(LAYOUT.replace("pad:", "field:"), encoding="utf-8")
        await bench.daemon.reload()
        layout = await told()
        assert [region["name"] for region in layout["regions"]] == ["field", "quiet"]  # type: ignore[attr-defined]
        assert (await era.hello("test")).layout == layout


async def test_another_layout_while_it_runs(tmp_path: Path) -> None:
    """A weaker layout is taken over while armed, a stronger or broken one is not."""
    path = tmp_path / "layout.yaml"
    path.write_text(LAYOUT, encoding="utf-8")
    async with (
        running_daemon(tmp_path, "layout: layout.yaml\n") as bench,
        await bench.client() as era,
    ):
        await until_state(era, READY)
        await era.arm("me", lease_s=60)

        async def reloaded(old: str, new: str) -> dict[str, object]:
            path.write_text(LAYOUT.replace(old, new), encoding="utf-8")
            await bench.daemon.reload()
            effects = {each.name: each for each in (await era.effects()).effects}
            return dict(effects["hum"].parameters)

        assert (await reloaded("level: 14", "level: 10"))["level"] == 10.0
        assert (await reloaded("level: 14", "level: 26"))["level"] == 10.0
        assert (await reloaded("level: 14", "level: neighbours"))["level"] == 10.0
        assert (await reloaded("level: 14", "level: loud"))["level"] == 10.0
        await era.disarm()
        assert (await reloaded("level: 14", "level: 26"))["level"] == 26.0
