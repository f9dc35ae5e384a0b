"""URL schemes of amplifiers, and wires of simulated amplifiers.

They are listed in tables on pages, in the help of `era amp`, and in the table of classes in
drivers/wires/wire.py. The sources are `WireAddress.SCHEMES` of each class, and the simulation's
table of far ends.
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
    """Return the class of each scheme as Python code, simulated amplifiers last."""
    places = {}
    for scheme, address, _ in _schemes():
        places[scheme] = f"{address.__module__}:{address.__name__}"
    lines = []
    for scheme in sorted(places, key=lambda scheme: (places[scheme].startswith("sim."), scheme)):
        if places[scheme].startswith("sim."):
            lines.append("    # In a package that imports this one; imported only if it is used.")
        lines.append(f'    "{scheme}": "{places[scheme]}",')
    body = "\n".join(lines)
    return (
        f"_CLASSES: Mapping[str, str] = {{\n{body}\n}}\n"
        '"""Classes of the built-in schemes, imported when they are used."""'
    )


def help_text() -> str:
    """Return the list of URLs in the help of `era amp`, as Python code."""
    rows = [scheme for _, _, scheme in _schemes()]
    width = max(len(scheme.example) for scheme in rows)
    lines = [f"  {scheme.example:{width}}  {scheme.help}" for scheme in rows]
    text = "\n".join(lines)
    return (
        "# \\b: these lines stay as they are.\n"
        f'_URL_HELP = """\\b\nURLs:\n{text}\nQuote URLs that contain ?, # or &.\n"""'
    )


def urls() -> str:
    """Return the table of URLs."""
    lines = ["| scheme and place | amplifier | options (default) |", "|---|---|---|"]
    for _, _, scheme in _schemes():
        for form, options in scheme.forms.items():
            lines.append(f"| `{form}` | {scheme.number} | {options} |")
    return "\n".join(lines)


def far_ends() -> str:
    """Return the table of wires that can be simulated."""
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
    """Yield each scheme with its class: serial lines first, simulated amplifiers last."""
    for module in _modules():
        for address in vars(module).values():
            if not (isinstance(address, type) and issubclass(address, WireAddress)):
                continue
            if address.__module__ == module.__name__:
                for name, scheme in vars(address).get("SCHEMES", {}).items():
                    yield name, address, scheme


def _modules() -> list[ModuleType]:
    """Return the modules with addresses, found without the registry, which is generated."""
    names = sorted(
        (info.name for info in pkgutil.iter_modules(drivers.wires.__path__)), reverse=True
    )
    names.remove("wire")
    modules = [import_module(f"drivers.wires.{name}") for name in names]
    return [*modules, import_module(_SIMULATION)]
