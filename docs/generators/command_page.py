"""The reference in docs/reference/commands.md: every command with its arguments and options.

Common arguments and options are listed once, at the beginning.
"""

from collections import Counter
from collections.abc import Iterator
from typing import Any

import typer
from typer.core import TyperGroup

from era_haptics.command import command_modules
from registry.command_line import join_commands

_MANY = 6
"""Number of commands from which on an argument or option that they share is common."""

_Records = list[tuple[str, str]]


def command_reference() -> str:
    """Return all commands in the order of `era --help`, as Markdown."""
    group, _ = join_commands(command_modules())
    commands = list(_commands(group, typer.Context(group, info_name="era")))
    counts = Counter(record for *_, records in commands for record in records)
    common: dict[str, str] = {}
    for (name, text), count in counts.most_common():
        if count >= _MANY:
            common.setdefault(name, text)
    lines = ["### Common arguments and options", ""]
    lines += [f"- `{name}`: {text}" for name, text in sorted(common.items())]
    for path, usage, summary, records in commands:
        entry = list(_entry(path, usage, summary, records, common))
        lines += ["", f"### {path}", "", entry[0], *(["", *entry[1:]] if entry[1:] else [])]
    return "\n".join(lines)


def _commands(
    group: TyperGroup, context: typer.Context
) -> Iterator[tuple[str, str, str, _Records]]:
    """Yield the full name, usage, summary, and arguments and options of each command."""
    for name in group.list_commands(context):
        command = group.commands[name]
        inner = typer.Context(command, info_name=name, parent=context)
        if isinstance(command, TyperGroup):
            yield from _commands(command, inner)
            continue
        yield _described(command, inner)


def _described(command: Any, context: typer.Context) -> tuple[str, str, str, _Records]:
    usage = " ".join([context.command_path, *command.collect_usage_pieces(context)])
    found = [parameter.get_help_record(context) for parameter in command.params]
    records = [(" ".join(one[0].split()), " ".join(one[1].split())) for one in found if one]
    return context.command_path, usage, " ".join((command.help or "").split()), records


def _entry(
    path: str, usage: str, summary: str, records: _Records, common: dict[str, str]
) -> Iterator[str]:
    """Yield the lines of a command: summary, usage, and arguments and options of its own."""
    is_common = [
        name in common and text.startswith(common[name].rstrip(".")) for name, text in records
    ]
    options = [
        f"`{name}`"
        for (name, _), shared in zip(records, is_common, strict=True)
        if shared and name.startswith("--")
    ]
    also = f"also with {', '.join(options)}" if options else ""
    if usage == f"{path} [OPTIONS]":
        yield f"{summary} {also.capitalize()}." if also else summary
    else:
        yield summary
        yield f"- `{usage}`{also and f', {also}'}"
    for (name, text), shared in zip(records, is_common, strict=True):
        if not shared:
            yield f"- `{name}`: {text}"
