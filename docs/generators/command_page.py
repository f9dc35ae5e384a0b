"""The reference in docs/reference/commands.md: every command with its arguments and options.

`python docs/generators/command_page.py docs/reference/commands.md` writes it anew between the
page's two marks, from the commands themselves.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import typer
from typer.core import TyperGroup

from controller.cli.main import load_commands
from page_part import insert

WRITER = "docs/generators/command_page.py"


def command_reference() -> str:
    """All commands by name, groups after the single ones, as Markdown."""
    group, _ = load_commands()
    context = typer.Context(group, info_name="era")
    return "\n".join(_group(group, context))


def _group(group: TyperGroup, context: typer.Context) -> Iterator[str]:
    commands = sorted(
        group.commands.items(), key=lambda item: (isinstance(item[1], TyperGroup), item[0])
    )
    for name, command in commands:
        inner = typer.Context(command, info_name=name, parent=context)
        if isinstance(command, TyperGroup):
            yield from _group(command, inner)
            continue
        yield from (f"### {inner.command_path}", "")
        yield from (" ".join((command.help or "").split()), "")
        usage = " ".join(command.collect_usage_pieces(inner))
        yield from ("```text", f"{inner.command_path} {usage}", "```", "")
        records = [parameter.get_help_record(inner) for parameter in command.params]
        yield from ("| | |", "|---|---|")
        for record in records:
            if record is not None:
                yield f"| `{_cell(record[0])}` | {_cell(record[1])} |"
        yield ""


def _cell(text: str) -> str:
    """Without what a table of Markdown would take for its own."""
    return " ".join(text.split()).replace("|", "\\|")


if __name__ == "__main__":
    path = Path(sys.argv[1])
    path.write_text(
        insert(path.read_text("utf-8"), command_reference(), writer=WRITER), encoding="utf-8"
    )
