"""`era measure --impedance`: what an exciter is, by its impedance and its weight."""

from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import typer
from typer.core import TyperCommand
from typer.main import get_command

from model.commands.options import JsonOption, next_line, print_report
from model.errors import InputError

if TYPE_CHECKING:
    from sim.desk.measuring.impedance import Circuit

app = typer.Typer(add_completion=False, rich_markup_mode=None)

FLAG = "--impedance"


@app.command()
def impedance(
    is_impedance: Annotated[
        bool, typer.Option(FLAG, help="Measure an exciter, not a plate.", show_default=False)
    ] = True,
    device: Annotated[
        str | None,
        typer.Option(
            metavar="DEVICE",
            help="Sound card: jack, jack:CLIENT, or of PortAudio; without it, files alone.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="Z.csv", help="File to write the impedance to."),
    ] = None,
    free_file: Annotated[
        Path | None,
        typer.Option("--free", metavar="FREE.csv", help="Impedance of the exciter hanging free."),
    ] = None,
    glued_file: Annotated[
        Path | None,
        typer.Option(
            "--glued", metavar="GLUED.csv", help="Impedance of it glued to something heavy."
        ),
    ] = None,
    weight: Annotated[
        float | None,
        typer.Option(metavar="G", help="Weight of the whole exciter in grams.", min=0.1),
    ] = None,
    scale_error: Annotated[
        float, typer.Option(metavar="G", help="Standard error of the scale in grams.", min=0)
    ] = 0.1,
    series: Annotated[
        float, typer.Option(metavar="OHM", help="Resistor in series with the exciter.", min=0.1)
    ] = 10.0,
    inputs: Annotated[
        str,
        typer.Option(
            metavar="A,B",
            help="Inputs before the exciter and over the resistor; one number: it is moved.",
        ),
    ] = "1,2",
    level: Annotated[
        float, typer.Option(help="Largest sample of output 1, 1 is full scale.", max=1.0)
    ] = 0.1,
    periods: Annotated[
        int, typer.Option(metavar="N", help="Seconds that count.", min=2, max=60)
    ] = 4,
    as_json: JsonOption = False,
) -> None:
    """Measure an exciter's impedance from 10 to 1000 Hz, and tell the parts of its circuit.

    Output 1 drives it in series with a resistor to ground. Once hanging free, once glued to
    something heavy, and weighed: print the keys of a rig's exciter, each with the interval that
    holds nine of ten.
    """
    from model.files.replacing import check_ending, check_place
    from sim.desk.measuring.impedance import exciter_values, fitted
    from sim.desk.measuring.impedance_run import (
        default_lines,
        measured_impedance,
        read_impedance,
        write_impedance,
    )
    from sim.desk.measuring.sound_card import open_card

    given = {"free": free_file, "glued": glued_file}
    read = {name: read_impedance(path) for name, path in given.items() if path is not None}
    names = {name: f"--{name} {path}" for name, path in given.items()}
    if (device is None) != (output is None):
        missing = "--device" if device is None else "--output"
        raise InputError(f"{missing} is missing; a measurement needs both, files neither")
    if device is None and not read:
        raise InputError("--device is missing; measure, or give --free and --glued")
    if device is not None and output is not None:
        check_place(output, example="free.csv")
        check_ending(output, ".csv", what="an impedance")
        if len(read) == 2:
            raise InputError("--free and --glued are both given; omit the one that is measured")
        taken = _inputs(inputs)
        if level <= 0:
            raise InputError(f"--level must be above 0, got {level:g}")
        with closing(open_card(device, outputs=1, inputs=max(taken), limit=level)) as card:
            found = measured_impedance(
                card, inputs=taken, series=series, level=level, periods=periods, move=_moved
            )
        name = "free" if "glued" in read else "glued" if "free" in read else "measured"
        read[name], names[name] = found, f"{device}"
        fitted(*found, what=device)  # what is no exciter is not written
        write_impedance(output, *found)
    circuits = {name: fitted(*each, what=names[name]) for name, each in read.items()}
    values = exciter_values(
        circuits.get("free", circuits.get("measured")),
        circuits.get("glued"),
        None if weight is None else 1e-3 * weight,
        1e-3 * scale_error,
    )
    following = None
    if output is not None and "measured" in circuits:
        following = next_line(
            "era", "measure", FLAG, "--device", str(device), "--free", output, "-o",
            output.with_stem("glued"), "--weight", "GRAMS",
        )  # fmt: skip
    rows = [
        f"{len(default_lines())} frequencies; wrote {output}" if output else None,
        *_rows(circuits, values),
        following,
    ]
    print_report(rows, _as_json(circuits, values, output), as_json=as_json)


def _inputs(text: str) -> tuple[int, ...]:
    found = tuple(int(part) if part.strip().isdecimal() else 0 for part in text.split(","))
    if len(found) > 2 or len(set(found)) < len(found) or min(found) < 1:
        raise InputError(f"--inputs must be one or two numbers from 1, such as 1,2, got {text}")
    return found


def _moved(place: str) -> None:
    typer.prompt(f"Connect the input {place}, and press Enter", "", show_default=False, err=True)


_UNITS = {
    "resonance": (1.0, "Hz"),
    "q": (1.0, ""),
    "force_factor": (1.0, ""),
    "resistance": (1.0, ""),
    "inductance": (1e3, "mH"),
    "coil_mass": (1e3, "g"),
    "weight": (1e3, "g"),
}
"""Keys of an exciter in a rig file, and the units in which they are printed."""


def _rows(
    circuits: "Mapping[str, Circuit]", values: Mapping[str, tuple[float, float]]
) -> Iterator[str]:
    from sim.desk.measuring.impedance import HALF_WIDTH

    for name, each in circuits.items():
        yield (
            f"{name}: resonance {each['resonance']:.4g} Hz, Q_ms {each['q']:.3g}, R "
            f"{each['resistance']:.4g} ohm; the circuit explains all but {100 * each.misfit:.2g} %"
        )
    yield f"Q_es {values['q_es'][0]:.3g}; keys of an exciter, with what holds nine of ten:"
    for key, (factor, unit) in _UNITS.items():
        if key in values:
            value, error = (factor * each for each in values[key])
            text = f"{key}: {value:.4g} {unit}".rstrip()
            yield f"    {text:28s} # ± {HALF_WIDTH * error:.2g} {unit}".rstrip()
        if key == "resonance":
            yield f"    resonance_is: {'mounted' if 'glued' in circuits else 'free'}"
    if "force_factor" not in values:
        yield "force factor and masses need --glued and --weight"


def _as_json(
    circuits: "Mapping[str, Circuit]",
    values: Mapping[str, tuple[float, float]],
    output: Path | None,
) -> dict[str, Any]:
    from sim.desk.measuring.impedance import HALF_WIDTH, NAMES

    return {
        "runs": {
            name: {key: each[key] for key in NAMES} | {"misfit": each.misfit}
            for name, each in circuits.items()
        },
        "resonance_is": "mounted" if "glued" in circuits else "free",
        "values": {
            name: {"value": value, "half_width_90": HALF_WIDTH * error}
            for name, (value, error) in values.items()
        },
        "files": [] if output is None else [str(output)],
    }


class MeasureCommand(TyperCommand):
    """`era measure`; with a flag it is another command, with options of its own."""

    variants: ClassVar = {FLAG: get_command(app)}

    def make_context(
        self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any
    ) -> Any:
        """The context of this command, or of a variant that a flag asks for."""
        asked = [variant for flag, variant in self.variants.items() if flag in args]
        if asked:
            return asked[0].make_context(info_name, args, parent, **extra)
        return super().make_context(info_name, args, parent, **extra)
