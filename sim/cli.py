"""`era sim`: simulated amplifiers on real wires over one plate."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drivers.errors import LinkError
from model.errors import InputError
from sim.witness_cli import witness

if TYPE_CHECKING:
    from sim.control.context import SimulationContext
    from sim.far_ends.wires import Wire
    from sim.process.far_end import FarEnd
    from sim.process.view import PlateView
    from sim.sensors.accelerometer import Accelerometer

app = typer.Typer(pretty_exceptions_enable=False)
app.command()(witness)

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
    wire: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=WIRE",
            help="Put one amplifier elsewhere: main=serial, side=modbus-tcp:5020; repeatable. "
            "What no option names is on the wire that its url in the rig asks for.",
        ),
    ] = None,
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
    finger_load: Annotated[
        str | None,
        typer.Option(
            metavar="LOAD",
            help="Fingers load the plate: light, or N/m,N s/m,kg. Else they only feel.",
        ),
    ] = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=X,Y", help="An accelerometer here [m]; may be repeated."),
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Record sensors and fingers: .csv, .wav or .uff."),
    ] = None,
    rate: Annotated[
        float, typer.Option(metavar="HZ", help="Sampling rate of sensors and fingers.")
    ] = 10_000.0,
    control: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Serve a control socket at this path.")
    ] = None,
    virtual_time: Annotated[
        bool,
        typer.Option("--virtual-time", help="Time passes only as the control socket says."),
    ] = False,
    until_eof: Annotated[
        bool,
        typer.Option("--until-eof", help="End with standard input, as when its writer dies."),
    ] = False,
) -> None:
    """Simulate a rig behind real wires. Prints a URL per amplifier; Ctrl-C or SIGTERM ends it."""
    from sim.process.endings import gone_when_told

    with gone_when_told():  # until there is something to end in order
        from model.config.points import parse_point
        from model.finger.load import parse_finger_load
        from model.rig.file import load_rig
        from sim.far_ends.wire_choice import choose_wires
        from sim.far_ends.wires import Wire
        from sim.faults.fault_file import FaultFile, load_faults
        from sim.process.far_end import FarEnd

        plain = Wire("serial", speed=speed, shared=shared, unpluggable=faults is not None)
        common = _common_wire(
            plain,
            {
                "serial": 0 if serial else None,
                "modbus-tcp": modbus_tcp,
                "modbus-rtu": 0 if modbus_rtu else None,
                "socketcand": socketcand,
                "slcan": 0 if slcan else None,
            },
        )
        if virtual_time and control is None:
            raise InputError("--virtual-time: who lets time pass? Add --control PATH")
        loaded = load_rig(rig)
        _check_rate(rate, frequency_max=loaded.limits.frequency_max)
        far_end = FarEnd(
            loaded,
            choose_wires(loaded.amplifiers, common=common, own=wire or [], plain=plain),
            faults=load_faults(faults, amplifiers=loaded.amplifiers) if faults else FaultFile(()),
            fingers={
                str(number): parse_point(text, what="--finger")
                for number, text in enumerate(finger or [], start=1)
            },
            finger_load=(
                parse_finger_load(finger_load, what="--finger-load") if finger_load else None
            ),
            sensors=[_sensor(text) for text in sensor or []],
            sample_rate=rate,
            control=control,
            record=record,
            until_eof=until_eof,
        )
        _run(far_end, virtual_time=virtual_time)


def _common_wire(plain: "Wire", ports: Mapping[str, int | None]) -> "Wire | None":
    """The wire that all amplifiers are on, by the port of the one kind that was asked for."""
    from dataclasses import replace

    given = {kind: port for kind, port in ports.items() if port is not None}
    if len(given) > 1:
        named = " and ".join(f"--{kind}" for kind in given)
        raise InputError(
            f"{named}: all amplifiers can be on one of them only; leave one, or say which "
            "amplifier is where, as in --wire main=serial --wire side=slcan"
        )
    return next((replace(plain, kind=kind, port=port) for kind, port in given.items()), None)


def _check_rate(rate: float, *, frequency_max: float) -> None:
    least = 2.5 * frequency_max
    if not least <= rate <= 1e6:
        raise InputError(
            f"--rate {rate:g}: the plate is driven at up to {frequency_max:g} Hz, "
            f"which {least:g} to 1e+06 Hz can follow"
        )


def _sensor(text: str) -> "Accelerometer":
    from model.config.points import parse_point
    from sim.sensors.accelerometer import Accelerometer

    name, equals, place = text.partition("=")
    if not (name and equals):
        raise InputError(f"--sensor {text}: write its name and place, as in --sensor P1=0.10,0.08")
    return Accelerometer(name, *parse_point(place, what="--sensor"))


def _run(far_end: "FarEnd", *, virtual_time: bool) -> None:
    import asyncio

    from sim.process.far_end import run_far_end
    from sim.process.virtual_time import SteppedLoop

    view = _LiveView() if sys.stdout.isatty() else None
    factory = SteppedLoop if virtual_time else None
    try:
        with asyncio.Runner(loop_factory=factory) as runner:
            said = runner.run(run_far_end(far_end, ready=_announce, view=view))
    finally:
        if view is not None:
            view.close()
    if said is not None:
        print(said)


def _announce(urls: Mapping[str, str]) -> None:
    for name, url in urls.items():
        print(f"{name}: {url}")
    sys.stdout.flush()


class _LiveView:
    """A picture that is drawn over again in place, from the first call on."""

    def __init__(self) -> None:
        from rich.live import Live

        self._live = Live(auto_refresh=False)
        self._plate: PlateView | None = None

    def __call__(self, context: "SimulationContext") -> None:
        from sim.process.view import PlateView, draw

        if self._plate is None:
            self._plate = PlateView(context.bench)
            context.bench.taps.append(self._plate)
            self._live.start()
        self._live.update(draw(context, self._plate), refresh=True)

    def close(self) -> None:
        self._live.stop()
