"""URL schemes of amplifiers and wires of simulated ones, where they are listed.

Tables on pages, the help of `era amp`, and the table of classes in drivers/wires/wire.py, from
`WireAddress.SCHEMES` of each class and from the simulation's table of far ends.
"""

import pkgutil
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from types import ModuleType

import drivers.wires
from drivers.wires.wire import Scheme, WireAddress
from sim.far_ends.wire_assignment import FAR_ENDS

_SIMULATION = "sim.memory_line"


def classes() -> str:
    """The class of each scheme, in Python; simulated amplifiers last."""
    places = {}
    for scheme, address, _ in _schemes():
        places[scheme] = f"{address.__module__}:{address.__name__}"
    lines = []
    for scheme in sorted(places, key=lambda scheme: (places[scheme].startswith("sim."), scheme)):
        if places[scheme].startswith("sim."):
            lines.append(
                "    # A plug-in of a package that imports this one; others never load it."
            )
        lines.append(f'    "{scheme}": "{places[scheme]}",')
    body = "\n".join(lines)
    return (
        f"_CLASSES: Mapping[str, str] = {{\n{body}\n}}\n"
        '"""The classes of the project\'s own schemes, loaded when they are used."""'
    )


def help_text() -> str:
    """The list of URLs in the help of `era amp`, in Python."""
    rows = [scheme for _, _, scheme in _schemes()]
    width = max(len(scheme.example) for scheme in rows)
    lines = [f"  {scheme.example:{width}}  {scheme.help}" for scheme in rows]
    text = "\n".join(lines)
    return (
        "# \\b: these lines stay as they are.\n"
        f'_URL_HELP = """\\b\nURLs:\n{text}\nQuote URLs that contain ?, # or &.\n"""'
    )


def urls() -> str:
    """The table of URLs."""
    lines = ["| scheme and place | amplifier | options (default) |", "|---|---|---|"]
    for _, _, scheme in _schemes():
        for form, options in scheme.forms.items():
            lines.append(f"| `{form}` | {scheme.number} | {options} |")
    return "\n".join(lines)


def far_ends() -> str:
    """The table of wires that can be simulated."""
    lines = ["| WIRE | the host opens |", "|---|---|"]
    for name, kind in FAR_ENDS.items():
        wire = f"{name}:PORT" if kind.is_ported else name
        lines.append(f"| `{wire}` | {kind.opens} |")
    return "\n".join(lines)


PARTS: Mapping[str, Callable[[], str]] = {
    "classes": classes,
    "help": help_text,
    "urls": urls,
    "far_ends": far_ends,
}


def _schemes() -> Iterator[tuple[str, type[WireAddress], Scheme]]:
    """Each scheme with its class and its facts: serial lines first, simulated amplifiers last."""
    for module in _modules():
        for address in vars(module).values():
            if not (isinstance(address, type) and issubclass(address, WireAddress)):
                continue
            if address.__module__ == module.__name__:
                for name, scheme in vars(address).get("SCHEMES", {}).items():
                    yield name, address, scheme


def _modules() -> list[ModuleType]:
    """The modules with addresses; not by the registry, which is written from them."""
    names = sorted(
        (info.name for info in pkgutil.iter_modules(drivers.wires.__path__)), reverse=True
    )
    names.remove("wire")
    modules = [import_module(f"drivers.wires.{name}") for name in names]
    return [*modules, import_module(_SIMULATION)]
