"""The command line: ``python -m sb3_crc doctor`` and ``python -m sb3_crc rendering``."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

app = typer.Typer(no_args_is_help=True, add_completion=False, help="CRC-RL for Stable-Baselines3.")
console = Console()
errors = Console(stderr=True)

MARKS = {"ok": "[green]ok[/]", "note": "[yellow]note[/]", "broken": "[red]broken[/]"}


@app.command()
def doctor() -> None:
    """Show what works on this machine; exit code 1 if something essential does not."""
    from sb3_crc.doctor import examine

    table = Table(title="sb3_crc doctor", title_justify="left")
    for column in ("", "", "found", ""):
        table.add_column(column, overflow="fold")
    findings = []
    with console.status("drawing a few frames"):
        for finding in examine():
            begins = not findings or findings[-1].topic != finding.topic
            if begins and findings:
                table.add_section()
            topic = finding.topic if begins else ""
            table.add_row(topic, finding.name, escape(finding.value), MARKS[finding.verdict])
            findings.append(finding)
    console.print(table)
    if any(finding.verdict == "broken" for finding in findings):
        raise typer.Exit(1)


@app.command()
def rendering(
    install: Annotated[
        bool,
        typer.Option("--install", help="Install the missing system library as root in a container, or if AUTO_APT=1 or CI=1."),
    ] = False,
) -> None:
    """Print the OpenGL back end that draws without a display; exit code 2 and what mends it if there is none."""
    from sb3_crc.envs.rendering import RenderingUnavailable, install_system_library, prove_backend

    try:
        try:
            outcome = prove_backend()
        except RenderingUnavailable:
            if not install:
                raise
            install_system_library()
            outcome = prove_backend()
    except RenderingUnavailable as error:
        # soft_wrap: a command that is to be copied must stay on one line
        errors.print(escape(str(error)), soft_wrap=True, highlight=False)
        raise typer.Exit(2) from None
    line = f"pictures are drawn by {outcome.backend}: {outcome.renderer}"
    console.print(escape(line), soft_wrap=True, highlight=False)
