"""Commands that train, compare, and turn runs into evidence."""

import typer

from sb3_crc.experiments.commands import evidence, looking, measuring, training

app = typer.Typer()
for commands in (training, looking, measuring, evidence):
    app.add_typer(commands.app)
