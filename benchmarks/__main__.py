"""The command line: ``python -m benchmarks [NAME ...]``, by default all of them; ``make bench``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from benchmarks.report import RESULTS, publish

app = typer.Typer(add_completion=False, help=__doc__)
console = Console(stderr=True)
Repeats = Annotated[int, typer.Option(min=1, help="Rounds, in each of which every program is timed once.")]
Folder = Annotated[Path, typer.Option(help="Where the JSON files go.")]


@app.command()
def update(
    repeats: Repeats = 10,
    networks: Annotated[list[str], typer.Option(help="paper, laptop")] = ["paper", "laptop"],  # noqa: B006
    batch: Annotated[list[int], typer.Option(help="Batch sizes.")] = [128, 512],  # noqa: B006
    policy_delay: Annotated[list[int], typer.Option(help="Updates per update of the actor.")] = [1, 2],  # noqa: B006
    method: Annotated[list[str] | None, typer.Option(help="Methods beside the peers; default: all.")] = None,
    output: Folder = RESULTS,
) -> None:
    """CRCSAC.train against stock SB3 SAC and a textbook CRC-RL."""
    from benchmarks.update import OURS, measure

    methods = tuple(method or OURS)

    rows = []
    with console.status("") as status:
        for network in networks:
            for size in batch:
                for delay in policy_delay:
                    label = f"{network} networks, batch {size}, policy_delay {delay}"
                    told = lambda done, label=label: status.update(f"{label}: {done} of {repeats}")  # noqa: E731
                    told(0)
                    rows += measure(network, size, delay, repeats=repeats, methods=methods, on_round=told)
    titles = ("networks", "batch", "policy_delay")
    publish("update", "One update (* changes the mathematics)", rows, _command(), by=titles, folder=output)


def _command() -> str:
    return " ".join(["python -m benchmarks", *sys.argv[1:]])


if __name__ == "__main__":
    app()
