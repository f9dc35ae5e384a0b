"""The command `era soft-amp`."""

import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from model.errors import InputError
from sim.soft_amp.settings import Law, Protocol, SoftAmplifierSettings

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from sim.soft_amp.settings import SoftAmplifierLine


def port_option(protocol: str) -> Any:
    """Return the option for a loopback port with this protocol."""
    return typer.Option(
        metavar="PORT", help=f"Serve {protocol} on this loopback port; 0: any.", min=0, max=65535
    )


def soft_amp(
    device: Annotated[
        str | None,
        typer.Option(
            metavar="DEVICE",
            help='PortAudio device by number, "NAME" or "NAME, HOST API" (see --list).',
        ),
    ] = None,
    channels: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Number of channels, 2 to 32; more than 16 are split into two amplifiers.",
        ),
    ] = None,
    serial: Annotated[
        bool, typer.Option("--serial", help="Serve the serial protocol on a pseudo-terminal.")
    ] = False,
    tcp: Annotated[int | None, port_option("the serial protocol")] = None,
    modbus_tcp: Annotated[int | None, port_option("Modbus TCP")] = None,
    link: Annotated[
        Path | None,
        typer.Option(metavar="PATH", help="Link this path to the pseudo-terminal."),
    ] = None,
    rate: Annotated[
        int | None, typer.Option(metavar="HZ", help="Sample rate. Default: the device's.")
    ] = None,
    block: Annotated[
        int | None,
        typer.Option(
            metavar="FRAMES",
            help="Frames per block; default: 128 or 256, for JACK the server's period.",
            min=16,
            max=8192,
        ),
    ] = None,
    law: Annotated[
        Law,
        typer.Option(
            help="Output for a force from -1 to 1. linear: the force itself; square: its voltage, "
            "sqrt((1 + force) / 2)."
        ),
    ] = Law.LINEAR,
    limit: Annotated[
        float, typer.Option(metavar="LEVEL", help="Peak sample, 0 to 1 of full scale.")
    ] = 1.0,
    max_gaps: Annotated[
        int,
        typer.Option(
            metavar="N",
            help="A fault is latched if the sound has more than this number of gaps per second.",
            min=0,
            max=63,
        ),
    ] = 3,
    serial_number: Annotated[
        str | None, typer.Option(metavar="TEXT", help="Serial number, at most 30 bytes.")
    ] = None,
    list_devices: Annotated[
        bool,
        typer.Option("--list", help="List devices with outputs, inputs, rate and block; exit."),
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="With --list, print one JSON object.")
    ] = False,
    until_eof: Annotated[
        bool, typer.Option("--until-eof", help="Exit at the end of standard input.")
    ] = False,
) -> None:
    """Run a software amplifier on a sound card. Print its URL and play until Ctrl-C.

    Level 1 is the device's full scale, and silence is zero samples. Exits with status 3 if the
    device is missing or lost. On Linux the kernel kills the process, and so ends its sound, if the
    sound stalls for 0.1 s. In a systemd unit, use Type=notify.
    """
    from model.commands.options import print_report
    from sim.soft_amp.output import listed_devices
    from sim.soft_amp.sound_player import SoftAmplifierPlayer

    if list_devices:
        print_report(*listed_devices(), as_json=as_json)
        return
    if as_json:
        raise InputError("--json must be with --list; add it, or omit --json")
    if device is None or channels is None:
        missing = "--device" if device is None else "--channels"
        raise InputError(f"{missing} is missing; era soft-amp --list lists devices")
    protocol = Protocol.SERIAL if modbus_tcp is None else Protocol.MODBUS
    settings = SoftAmplifierSettings(
        device=device,
        channels=channels,
        protocol=protocol,
        serial_number=_serial_number(serial_number, device=device),
        rate=rate,
        block=block,
        law=law,
        limit=limit,
        max_gaps=max_gaps,
    )
    with _open_line(serial=serial, tcp=tcp, modbus_tcp=modbus_tcp, link=link) as line:
        player = SoftAmplifierPlayer(settings, line, report=_report)
        try:
            player.start()
            for url in line.urls(settings.amplifiers, protocol=protocol):
                print(url, flush=True)
            with suppress(KeyboardInterrupt):
                player.watch(until=sys.stdin.fileno() if until_eof else None)
            _report(player.underruns())
        finally:
            player.end()


def _report(line: str) -> None:
    print(f"soft-amp: {line}", file=sys.stderr, flush=True)


def _serial_number(option: str | None, *, device: str) -> str:
    """The serial number in an option, by default from the host's name and the device."""
    if option is None:
        import socket
        import zlib

        origin = f"{socket.gethostname()} {device}"
        return f"SOFT-{zlib.crc32(origin.encode()):08X}"
    length = len(option.encode())
    if not 1 <= length <= 30:
        raise InputError(f"--serial-number must have 1 to 30 bytes, got {length}")
    return option


def _open_line(
    *, serial: bool, tcp: int | None, modbus_tcp: int | None, link: Path | None
) -> "AbstractContextManager[SoftAmplifierLine]":
    """Open the line of the option that is set, by default a pseudo-terminal; raises InputError."""
    from sim.soft_amp.settings import tcp_place, terminal_place

    ports = {
        "--serial": 0 if serial else None,
        "--tcp": tcp,
        "--modbus-tcp": modbus_tcp,
    }
    options = [option for option, port in ports.items() if port is not None]
    if len(options) > 1:
        raise InputError(f"{' and '.join(options)} exclude each other; give one")
    if options in ([], ["--serial"]):
        return terminal_place(link)
    (option,) = options
    if link is not None:
        raise InputError(f"--link is of a pseudo-terminal; omit it, or {option}")
    protocol = Protocol.SERIAL if modbus_tcp is None else Protocol.MODBUS
    return tcp_place(ports[option] or 0, protocol=protocol)
