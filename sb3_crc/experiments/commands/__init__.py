"""Commands that train, compare, turn runs into evidence, and share them."""

import typer

from sb3_crc.experiments.commands import evidence, looking, measuring, sharing, training

app = typer.Typer()
for commands in (training, looking, measuring, evidence, sharing):
    app.add_typer(commands.app)
