"""A plate without hardware, as a client of a JACK server.

python tests/programs/desk_plate.py RIG --sensors SENSORS.csv
"""

import json
import select
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from drivers.errors import LinkError
from kit.desk_plate import BLOCK_MULTIPLE, DeskPlate
from model.commands.options import RigArgument
from model.errors import InputError

if TYPE_CHECKING:
    import jack

_POLL = 0.05  # s


class JackPlate:
    """Ports in_1.. and out_1.. of a client; each block is advanced in the server's callback.

    Raises InputError for a server whose blocks do not suit.
    """

    def __init__(self, client: "jack.Client", plate: DeskPlate) -> None:
        if client.blocksize % BLOCK_MULTIPLE:
            raise InputError(
                f"blocks of the JACK server must be a multiple of {BLOCK_MULTIPLE} frames, got "
                f"{client.blocksize}; start it with -p 128"
            )
        self._client, self._plate = client, plate
        self._problem: Exception | None = None
        self._ended = threading.Event()
        for number in range(plate.inputs):
            client.outports.register(f"out_{number + 1}", is_terminal=True)
        for number in range(plate.outputs):
            client.inports.register(f"in_{number + 1}", is_terminal=True)

    def start(self) -> None:
        """Begin to vibrate."""
        self._client.set_process_callback(self._advance)
        self._client.set_shutdown_callback(self._lose)
        self._client.activate()

    def wait(self, timeout: float) -> None:
        """Wait for a time [s]; raises what ended the plate."""
        if self._ended.wait(timeout) and self._problem is not None:
            raise self._problem

    def _lose(self, _status: object, _reason: object) -> None:
        self._problem = LinkError("jack: the server has ended; start it, and this again")
        self._ended.set()

    def _advance(self, _frames: int) -> None:
        if self._problem is not None:
            return
        try:
            played = np.stack([port.get_array() for port in self._client.inports], axis=1)
            heard = self._plate.advance(played.astype(float))
            for port, samples in zip(self._client.outports, heard.T, strict=True):
                port.get_array()[:] = samples
        except Exception as problem:  # nothing above catches it in the server's thread
            self._problem = problem
            self._ended.set()


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
