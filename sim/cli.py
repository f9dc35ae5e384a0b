"""`era sim`: simulated amplifiers on real wires over one plate."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drivers.errors import LinkError
from model.errors import InputError

if TYPE_CHECKING:
    from sim.bench import Bench

app = typer.Typer(pretty_exceptions_enable=False)

EXIT_STATUS: dict[type[BaseException], int] = {InputError: 2, LinkError: 3}
"""Exit status of the errors that this command raises on purpose."""


@app.command()
def sim(
    rig: Annotated[Path, typer.Argument(metavar="RIG", help="Rig file, e.g. RIG.yaml.")],
    serial: Annotated[
        bool, typer.Option("--serial", help="Put every amplifier on a pseudo-terminal.")
    ] = False,
    modbus_tcp: Annotated[
        int | None,
        typer.Option(
            metavar="PORT",
            help="Modbus TCP on this port of the loopback interface; 0: any.",
            min=0,
            max=65535,
        ),
    ] = None,
    modbus_rtu: Annotated[
        bool, typer.Option("--modbus-rtu", help="Modbus RTU, all on one pseudo-terminal.")
    ] = False,
    socketcand: Annotated[
        int | None,
        typer.Option(
            metavar="PORT",
            help="A CAN bus behind a socketcand server on this loopback port; 0: any.",
            min=0,
            max=65535,
        ),
    ] = None,
    slcan: Annotated[
        bool, typer.Option("--slcan", help="A CAN bus behind a serial adapter (slcan).")
    ] = False,
    shared: Annotated[
        bool, typer.Option("--shared", help="All amplifiers on one line, at addresses 1, 2, ...")
    ] = False,
    speed: Annotated[
        int | None,
        typer.Option(metavar="BIT/S", help="Let bytes take their time on the wire.", min=300),
    ] = None,
    faults: Annotated[
        Path | None, typer.Option(metavar="FILE", help="What shall go wrong, and when.")
    ] = None,
    finger: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y", help="A finger that rests here [m]; may be repeated."),
    ] = None,
    control: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Serve a control socket at this path.")
    ] = None,
    until_eof: Annotated[
        bool,
        typer.Option("--until-eof", help="End with standard input, as when its writer dies."),
    ] = False,
) -> None:
    """Simulate a rig behind real wires until SIGTERM or Ctrl-C; prints a URL per amplifier."""
    import asyncio

    from model.points import parse_point
    from model.rig_file import load_rig
    from sim.fault_file import FaultFile, load_faults
    from sim.process import run_far_end
    from sim.wires import Wire

    chosen = {
        "serial": serial,
        "modbus-tcp": modbus_tcp is not None,
        "modbus-rtu": modbus_rtu,
        "socketcand": socketcand is not None,
        "slcan": slcan,
    }
    kinds = [kind for kind, is_chosen in chosen.items() if is_chosen]
    if len(kinds) != 1:
        raise InputError(
            "which wire? add one of --serial (a pseudo-terminal each), --modbus-tcp PORT, "
            "--modbus-rtu, --socketcand PORT and --slcan"
        )
    loaded = load_rig(rig)
    schedule = load_faults(faults, amplifiers=loaded.amplifiers) if faults else FaultFile(())
    wire = Wire(
        kinds[0],
        speed=speed,
        port=modbus_tcp or socketcand or 0,
        shared=shared,
        unpluggable=faults is not None,
    )
    positions = {
        str(number): parse_point(text, what="--finger")
        for number, text in enumerate(finger or [], start=1)
    }
    view = _LiveView() if sys.stdout.isatty() else None
    try:
        asyncio.run(
            run_far_end(
                loaded,
                wire=wire,
                faults=schedule,
                fingers=positions,
                control=control,
                ready=_announce,
                view=view,
                until_eof=until_eof,
            )
        )
    finally:
        if view is not None:
            view.close()


def _announce(urls: Mapping[str, str]) -> None:
    for name, url in urls.items():
        print(f"{name}: {url}")
    sys.stdout.flush()


class _LiveView:
    """A picture that is drawn over again in place, from the first call on."""

    def __init__(self) -> None:
        from rich.live import Live

        self._live = Live(auto_refresh=False)

    def __call__(self, bench: "Bench") -> None:
        from sim.view import draw

        self._live.start()
        self._live.update(draw(bench), refresh=True)

    def close(self) -> None:
        self._live.stop()
