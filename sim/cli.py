"""`era sim`: simulated amplifiers on real wires over one plate."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drivers.errors import LinkError
from model.commands.options import ExactOption, SeedOption, seed_of_plate
from model.errors import InputError
from sim.soft_amp.soft_amp_cli import port_option, soft_amp

if TYPE_CHECKING:
    from model.arrays import Point
    from model.rig.rig import Rig
    from sim.far_ends.wire_assignment import SimulatedWire
    from sim.faults import FaultFile
    from sim.plant.imperfections import Imperfections
    from sim.simulation import Simulation

app = typer.Typer(pretty_exceptions_enable=False)
app.command("soft-amp")(soft_amp)

EXIT_STATUS: dict[type[BaseException], int] = {InputError: 2, LinkError: 3}
"""Exit status by class of error."""


@app.command()
def sim(
    rig: Annotated[Path, typer.Argument(metavar="RIG", help="Rig file, e.g. RIG.yaml.")],
    serial: Annotated[
        bool, typer.Option("--serial", help="Put each amplifier on a pseudo-terminal.")
    ] = False,
    modbus_tcp: Annotated[int | None, port_option("Modbus TCP")] = None,
    modbus_rtu: Annotated[
        bool, typer.Option("--modbus-rtu", help="Serve Modbus RTU on one pseudo-terminal.")
    ] = False,
    socketcand: Annotated[int | None, port_option("a CAN bus through socketcand")] = None,
    slcan: Annotated[
        bool, typer.Option("--slcan", help="Serve a CAN bus behind a serial adapter (slcan).")
    ] = False,
    firmware: Annotated[
        bool,
        typer.Option(
            "--firmware",
            help="Run the firmware built by `make firmware` for each amplifier; the plate "
            "does not move.",
        ),
    ] = False,
    cortex_m: Annotated[
        bool,
        typer.Option(
            "--cortex-m",
            help="Like --firmware, on a Cortex-M3 emulated by QEMU for each amplifier.",
        ),
    ] = False,
    wire: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=WIRE",
            help="Wire of an amplifier, e.g. main=serial or side=modbus-tcp:5020 (repeatable). "
            "Default: the scheme of its url in the rig.",
        ),
    ] = None,
    link: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME=]PATH",
            help="Create a symbolic link to the pseudo-terminal of an amplifier (default: "
            "the first; repeatable).",
        ),
    ] = None,
    shared: Annotated[
        bool,
        typer.Option("--shared", help="Put all amplifiers on one line, at addresses 1, 2, ..."),
    ] = False,
    speed: Annotated[
        int | None,
        typer.Option(
            metavar="BIT/S",
            help="Simulate the transmission time of bytes at this speed.",
            min=300,
        ),
    ] = None,
    line: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME=]KIND",
            help="Simulated link: native, usb-high-speed, usb-full-speed, ftdi, "
            "ftdi-low-latency, can, can-usb, ethernet or prompt (no added latency); "
            "repeatable. Default: typical for the wire; prompt for a single amplifier.",
        ),
    ] = None,
    faults: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Inject the faults listed in this file.")
    ] = None,
    finger: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y", help="Place a finger at this position in meters (repeatable)."),
    ] = None,
    exact: ExactOption = False,
    seed: SeedOption = None,
    control: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Serve the control socket at this path.")
    ] = None,
    virtual_time: Annotated[
        bool,
        typer.Option("--virtual-time", help="Advance time only through the control socket."),
    ] = False,
    until_eof: Annotated[
        bool,
        typer.Option("--until-eof", help="Exit at the end of standard input."),
    ] = False,
) -> None:
    """Simulate the amplifiers of a rig on real wires. Print a URL for each, and run until Ctrl-C.

    The simulated plate is drawn at random from the rig's tolerances (repeatable with --seed).
    """
    from sim.early_exit import exit_on_signal

    with exit_on_signal():
        from model.rig.rig_file import load_rig
        from sim.far_ends.firmware import find_firmware
        from sim.far_ends.wire_assignment import SimulatedWire, assign_wires, choose_lines, links_of
        from sim.simulation import Simulation
        from sim.transport.simulated_line import PROMPT
        from sim.transport.terminal_links import links_by_amplifier

        plate_seed = seed_of_plate(exact=exact, seed=seed)
        defaults = SimulatedWire(
            "serial",
            speed=speed,
            shared=shared,
            unpluggable=faults is not None,
            line_kind=PROMPT if virtual_time else None,  # a host's time never stops
            seed=plate_seed or 0,
        )
        ports: dict[str, int | None] = {
            "serial": 0 if serial else None,
            "modbus-tcp": modbus_tcp,
            "modbus-rtu": 0 if modbus_rtu else None,
            "socketcand": socketcand,
            "slcan": 0 if slcan else None,
        }
        common_wire = _common_wire(defaults, ports)
        if virtual_time and control is None:
            raise InputError("--virtual-time needs --control PATH, which advances the time")
        loaded_rig = load_rig(rig)
        is_firmware = firmware or cortex_m
        if is_firmware:
            flags = {
                "--wire": wire,
                "--shared": shared,
                "--speed": speed,
                "--line": line,
                "--faults": faults,
                "--virtual-time": virtual_time,
            }
            _check_firmware_options(ports, flags)
        urls_to_wire = {} if is_firmware else loaded_rig.amplifiers
        wires = assign_wires(
            urls_to_wire, common=common_wire, options=wire or [], defaults=defaults
        )
        wires = choose_lines(wires, line or [])
        links = links_by_amplifier(link or [], amplifiers=list(loaded_rig.amplifiers))
        simulation = Simulation(
            loaded_rig,
            wires,
            faults=_fault_file(faults, loaded_rig),
            fingers=_finger_positions(finger or []),
            imperfections=_imperfections(loaded_rig, plate_seed),
            control=control,
            until_eof=until_eof,
            firmware=find_firmware(is_emulated=cortex_m) if is_firmware else None,
            links={**links_of(wires), **links},
        )
        _run(simulation, virtual_time=virtual_time)


def _common_wire(
    defaults: "SimulatedWire", ports: Mapping[str, int | None]
) -> "SimulatedWire | None":
    """The wire of all amplifiers if one option is set; ports: by kind, None for unset options."""
    from dataclasses import replace

    kinds = [kind for kind, port in ports.items() if port is not None]
    if len(kinds) > 1:
        options = " and ".join([f"--{kind}" for kind in kinds])
        raise InputError(
            f"{options} exclude each other; give one, or the wire of each amplifier, as in "
            "--wire main=serial --wire side=slcan"
        )
    if not kinds:
        return None
    (kind,) = kinds
    return replace(defaults, kind=kind, port=ports[kind] or 0)


def _check_firmware_options(
    ports: Mapping[str, int | None], other_options: Mapping[str, object]
) -> None:
    """Raise InputError if options are given that `--firmware` does not support.

    ports: by kind of wire, None for unset options; other_options: by name, false if unset.
    """
    unsupported = [f"--{kind}" for kind, port in ports.items() if port is not None]
    unsupported += [name for name, value in other_options.items() if value]
    if unsupported:
        raise InputError(
            f"--firmware must be used without {', '.join(unsupported)}: each amplifier has a "
            "serial line of its own and runs in real time, and the plate does not move"
        )


def _fault_file(path: Path | None, rig: "Rig") -> "FaultFile":
    """The faults that a file lists, none without a file; raises ConfigError."""
    from sim.faults import FaultFile, load_faults

    if path is None:
        return FaultFile(faults=[])
    return load_faults(path, amplifiers=rig.amplifiers)


def _finger_positions(options: Sequence[str]) -> dict[str, "Point"]:
    """Positions [m] of fingers by id, numbered from 1; raises InputError."""
    from model.commands.options import parse_point

    fingers = {}
    for number, text in enumerate(options, start=1):
        fingers[str(number)] = parse_point(text, what="--finger")
    return fingers


def _imperfections(rig: "Rig", seed: int | None) -> "Imperfections":
    """The imperfections of the plate with a seed; none for None."""
    from sim.plant.imperfections import Imperfections, draw_imperfections

    if seed is None:
        return Imperfections()
    return draw_imperfections(rig, seed=seed)


def _run(simulation: "Simulation", *, virtual_time: bool) -> None:
    import asyncio

    from sim.simulation import SteppedLoop, make_fine_loop, run_simulation

    factory = SteppedLoop if virtual_time else make_fine_loop
    with asyncio.Runner(loop_factory=factory) as runner:
        runner.run(run_simulation(simulation, ready=_announce))


def _announce(urls: Mapping[str, str]) -> None:
    for name, url in urls.items():
        print(f"{name}: {url}")
    sys.stdout.flush()
