"""A surface layout in the daemon: effects of touches, and the events of clients."""

from pathlib import Path

import pytest

from controller.api.jsonrpc import ErrorCode
from daemon_bench import error_code, holding, ready_daemon, until

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
