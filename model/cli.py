"""Commands of the model for the command `era`."""

import typer

from model.commands.calibrate_cli import calibrate
from model.commands.plate_cli import (
    convergence,
    materials,
    modes,
    plate_app,
    plate_map,
    template,
)
from model.commands.plate_show_cli import show as show_plate
from model.commands.table_cli import build, contrast_map, export, plot, query, table_app
from model.commands.table_show_cli import show, verify
from model.errors import InputError

plate_app.command()(modes)
plate_app.command("map")(plate_map)
plate_app.command()(convergence)
plate_app.command()(materials)
plate_app.command("show")(show_plate)
plate_app.command()(template)

table_app.command()(build)
table_app.command()(show)
table_app.command()(verify)
table_app.command()(query)
table_app.command("map")(contrast_map)
table_app.command()(plot)
table_app.command()(export)

app = typer.Typer()
app.command()(calibrate)
app.add_typer(plate_app, name="plate")
app.add_typer(table_app, name="table")

EXIT_STATUS: dict[type[BaseException], int] = {InputError: 2}
"""Exit status for each class of error that these commands raise on purpose."""
