"""Layouts by name: what the next finger feels, what goes on, and the commands on a real daemon."""

import json
from pathlib import Path

import pytest

from controller.api.client import Client
from controller.api.jsonrpc import ErrorCode, RpcError
from controller.cli.main import BAD_INPUT, run
from daemons import holding, next_event, ready_daemon, until
from gateway_bench import real_daemon
from registry import threads
from virtual_lines import in_virtual_time

LAYOUTS = "layouts: {home: home.yaml, climate: climate.yaml}\n"
WEST, EAST = (0.08, 0.1), (0.22, 0.1)
TICK = 0.2  # s


def write_layouts(folder: Path) -> None:
    """At home the west hums and the east ticks; for the climate all of it hums low."""
    half = "{rectangle: {start: [%s m, 0 m], end: [%s m, 0.2 m]}, on_press: %s}"
    (folder / "home.yaml").write_text(
        f"effects: {{tick: {{kind: click, duration: {TICK} s}}, hum: {{kind: buzz, level: 14}}}}\n"
        f"regions: {{west: {half % (0, 0.15, 'hum')}, east: {half % (0.15, 0.3, 'tick')}}}\n",
        "utf-8",
    )
    low = "effects: {low: {kind: buzz, level: 10}}\nelsewhere: low\n"
    (folder / "climate.yaml").write_text(low, "utf-8")


@in_virtual_time
async def test_next_finger_feels_the_chosen_layout_and_a_tick_goes_on(tmp_path: Path) -> None:
    """Within 10 ms of the reply; at a finger that rests, what ends by itself plays to its end.

    An unknown name changes nothing, nor does that of the layout in use.
    """
    write_layouts(tmp_path)
    async with ready_daemon(tmp_path, LAYOUTS) as (bench, era):
        await era.arm("me", lease_s=60)
        view = bench.daemon._publisher.view

        def felt() -> list[str | None]:
            return [each.feels for each in view.contact_statuses()]

        status = await era.status()
        assert (status.layout, status.layouts) == ("home", ["home", "climate"])
        await era.subscribe("layout")
        assert (await next_event(era, "layout")).data["name"] == "home"
        async with holding(era, EAST):
            await until(lambda: felt() == ["tick"])
            began = threads.now()
            with pytest.raises(RpcError, match="did you mean climate") as caught:
                await era.layout("climat")
            assert caught.value.code is ErrorCode.INVALID_PARAMS
            assert (await era.layout("home")).layout == "home"
            assert (await era.layout("climate")).layout == "climate"
            assert threads.now() - began < 0.01
            await until(lambda: felt() == ["low"])
            assert threads.now() - began == pytest.approx(TICK, abs=0.02)
            assert (await next_event(era, "layout")).data["name"] == "climate"
            assert (await era.status()).layout == "climate"
        await era.touch([])
        for name, effect in (("home", "hum"), ("climate", "low")):
            await until(lambda: not any(bench.far.summary().levels))
            await era.layout(name)
            replied = threads.now()
            async with holding(era, WEST):
                await until(lambda effect=effect: felt() == [effect])
                assert any(bench.far.summary().levels)
                assert threads.now() - replied < 0.01
            await era.touch([])


@pytest.mark.real_time
def test_commands_choose_a_layout_and_reload(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a daemon's process, with what they print and refuse, in its log, too.

    For a layout that is removed while it is in use the first is.
    """
    write_layouts(tmp_path)

    def era(*line: str) -> tuple[int, str]:
        status = run([*line, "--socket", str(tmp_path / "era.sock")], ["controller.cli.commands"])
        return status, "".join(capsys.readouterr())

    with real_daemon(tmp_path, LAYOUTS) as socket, Client.connect(socket) as client:
        status, said = era("layout", "use", "climate", "--json")
        assert (status, json.loads(said)["layout"]) == (0, "climate")
        status, said = era("layout", "use", "climat")
        assert status == BAD_INPUT
        assert said.count("\n") == 1
        assert "did you mean climate" in said
        assert "\n  layout climate (of home, climate)\n" in era("status")[1]
        assert era("strength", "python", "-6") == era("strength") == (0, "python: -6 dB\n")
        config, home = tmp_path / "daemon.yaml", tmp_path / "home.yaml"
        text = config.read_text("utf-8")
        home.write_text("elsewhere: null\n", "utf-8")
        for keys, elsewhere, is_done, reasons in (
            (text, "buzz", True, ["layouts.home: changed"]),
            (text, "buzz", True, ["nothing has changed"]),
            (f"{text}mode: phased\n", "click", False, ["mode: ", "layouts.home: changed, but not"]),
            (text, "clik", False, [f"{config}:4: layouts.home", f"{home}:1: elsewhere: "]),
            (
                text.replace(", climate: climate.yaml", ""),
                "click",
                True,
                ["layouts.home: changed", "layouts.climate: removed", "layout in use: home"],
            ),
        ):
            config.write_text(keys, "utf-8")
            home.write_text(f"elsewhere: {elsewhere}\n", "utf-8")
            status, said = era("reload", "--json")
            assert (status, json.loads(said)["reloaded"]) == (1 - is_done, is_done)
            for found, expected in zip(json.loads(said)["reasons"], reasons, strict=True):
                assert found.startswith(expected)
            assert (client.status().layout == "climate") is ("climate" in keys)
    log = [json.loads(line) for line in (tmp_path / "daemon.log").read_text("utf-8").splitlines()]
    verdicts = [each["level"] for each in log if each["message"].startswith("config: reload")]
    assert verdicts == ["info", "info", "error", "error", "info"]
