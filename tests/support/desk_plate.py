"""A plate without hardware, as a client of a JACK server.

python tests/support/desk_plate.py RIG --sensors SENSORS.csv
"""

import json
import select
import sys
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from drivers.errors import LinkError
from kit.desk_plate import DeskPlate, JackPlate
from model.commands.options import RigArgument
from model.errors import InputError

_POLL = 0.05  # s


def desk_plate(
    rig_file: RigArgument,
    sensors_file: Annotated[
        Path,
        typer.Option(
            "--sensors", metavar="SENSORS.csv", help="Accelerometers, as for era measure."
        ),
    ],
    name: Annotated[str, typer.Option(metavar="NAME", help="Name of the client.")] = "desk",
    seed: Annotated[
        int, typer.Option(metavar="N", help="Draw another plate, and other noise.", min=0)
    ] = 1,
    noise: Annotated[
        float,
        typer.Option(metavar="DENSITY", help="Noise of an accelerometer, m/s²/sqrt(Hz).", min=0),
    ] = 5e-3,
    delay: Annotated[
        int, typer.Option(metavar="SAMPLES", help="Delay of the converters.", min=0, max=48_000)
    ] = 73,
    y_cable: Annotated[
        bool,
        typer.Option("--y-cable", help="The loop-back is beside the last ERA, as in era measure."),
    ] = False,
    mesh: Annotated[
        str | None, typer.Option(metavar="NXxNY", help="Mesh that the plate is solved on.")
    ] = None,
    truth: Annotated[
        Path | None, typer.Option(metavar="FILE.json", help="Write what the plate really is.")
    ] = None,
    until_eof: Annotated[
        bool,
        typer.Option(
            "--until-eof",
            help='Exit at the end of standard input; lines {"fingers": [[X, Y], ...]} touch the '
            'plate, and {"sensor": NAME} moves the only sensor.',
        ),
    ] = False,
) -> None:
    """Be a plate that deviates from its rig. Print the device to play to; Ctrl-C ends.

    Its inputs take what a sound card would play to the ERAs, by their channels, and the loop-back
    last, which --y-cable leaves out; its outputs give what accelerometers would record. Everything
    is simulated.
    """
    import gc

    from era_haptics.lab.measuring.sensor_file import read_sensors
    from kit.desk_plate import MESH, Converters, draw_truth
    from kit.jack_client import jack_client
    from model.rig.rig_file import load_rig

    rig = load_rig(rig_file)
    sensors = read_sensors(sensors_file, rig.plate, may_move=True)
    drawn = draw_truth(rig, seed=seed, mesh=mesh or MESH)
    client = jack_client(name)
    try:
        converters = Converters(delay=delay, noise=noise)
        plate = DeskPlate(
            drawn,
            sensors,
            rate=client.samplerate,
            converters=converters,
            seed=seed,
            is_shared=y_cable,
        )
        if truth is not None:
            truth.write_text(json.dumps(drawn.as_json(), indent=1) + "\n", encoding="utf-8")
        running = JackPlate(client, plate)
        gc.collect()
        gc.freeze()  # what is loaded is never looked through again, in the middle of a block
        running.start()
        typer.echo(f"{name}, JACK")
        typer.echo(
            f"desk-plate: simulated; {plate.outputs} inputs for what the card plays, "
            f"{plate.inputs} outputs, {client.samplerate} Hz, "
            f"blocks of {client.blocksize} frames",
            err=True,
        )
        with suppress(KeyboardInterrupt):
            _run(running, plate, until_eof=until_eof)
    finally:
        client.close()


def _run(running: JackPlate, plate: DeskPlate, *, until_eof: bool) -> None:
    """Take lines from standard input until it ends, or for ever."""
    while True:
        running.wait(0 if until_eof else _POLL)
        if until_eof and select.select([sys.stdin], [], [], _POLL)[0]:
            line = sys.stdin.readline()
            if not line:
                return
            typer.echo(json.dumps(_changed(plate, line)))


def _changed(plate: DeskPlate, line: str) -> dict[str, object]:
    """Change what a line asks for; return the new state."""
    try:
        wanted = json.loads(line)
        if "sensor" in wanted:
            plate.move_sensor(str(wanted["sensor"]))
            return {"sensor": wanted["sensor"]}
        positions = [(float(x), float(y)) for x, y in wanted["fingers"]]
        plate.set_fingers(positions)
    except (ValueError, TypeError, KeyError) as problem:
        raise InputError(
            f'a line must be {{"fingers": [[X, Y], ...]}} or {{"sensor": NAME}}, got {line[:60]!r}'
        ) from problem
    return {"fingers": len(positions)}


if __name__ == "__main__":
    try:
        typer.run(desk_plate)
    except (InputError, LinkError) as error:
        typer.echo(f"error: {error}", err=True)
        raise SystemExit(3) from None
