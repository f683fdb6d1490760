"""The command line: ``python -m benchmarks NAME``; ``make bench`` runs all of them."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from benchmarks.report import RESULTS, publish

app = typer.Typer(no_args_is_help=True, add_completion=False, help=__doc__)
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


@app.command()
def env(
    repeats: Annotated[int, typer.Option(min=1, help="Decisions of each environment that are timed, in turn.")] = 100,
    task: Annotated[list[str] | None, typer.Option(help="domain-task; default: the paper's ten.")] = None,
    quality: Annotated[list[str], typer.Option(help="benchmark, fast")] = ["benchmark", "fast"],  # noqa: B006
    image_size: Annotated[int, typer.Option(min=1, help="Side of the pictures in pixels.")] = 100,
    output: Folder = RESULTS,
) -> None:
    """make_dmc against dm_control alone and the usual chain of wrappers."""
    from benchmarks.env import measure
    from sb3_crc.envs.tasks import PAPER_TASKS

    tasks = tuple(task or PAPER_TASKS)
    with console.status("") as status:
        told = lambda done: status.update(f"{done} of {len(tasks) * len(quality)} environments")  # noqa: E731
        told(0)
        rows = measure(tasks, quality, repeats=repeats, image_size=image_size, on_row=told)
    publish("env", f"A decision with a picture of {image_size} pixels", rows, _command(), by=("quality",), folder=output)


@app.command()
def end_to_end(
    decisions: Annotated[int, typer.Option(min=1, help="Decisions, with one update each, that are timed.")] = 200,
    networks: Annotated[list[str], typer.Option(help="paper, laptop")] = ["paper", "laptop"],  # noqa: B006
    preset: Annotated[list[str], typer.Option(help="Presets beside the peer.")] = ["crc", "rad"],  # noqa: B006
    batch: Annotated[int, typer.Option(min=2, help="Batch size.")] = 128,
    quality: Annotated[str, typer.Option(help="benchmark, fast")] = "benchmark",
    output: Folder = RESULTS,
) -> None:
    """Where the time of learn() goes, in CRCSAC and in stock SB3 SAC; and how long acting takes."""
    from benchmarks.end_to_end import TASK, acting, measure
    from benchmarks.networks import NETWORKS

    rows, acting_rows = [], []
    with console.status("") as status:
        for network in networks:
            told = lambda method, network=network: status.update(f"{network} networks: {method}")  # noqa: E731
            rows += measure(
                networks=NETWORKS[network],
                presets=tuple(preset),
                decisions=decisions,
                batch_size=batch,
                render_quality=quality,
                on_method=told,
            )
            told("acting")
            acting_rows += acting(NETWORKS[network])
    title = f"learn() on {TASK}, batch {batch}, render quality {quality}"
    publish("end_to_end", title, rows, _command(), by=("networks", "unit"), folder=output)
    publish("acting", "predict() on one observation", acting_rows, _command(), folder=output)


@app.command()
def buffer(
    repeats: Repeats = 10,
    size: Annotated[list[int] | None, typer.Option(help="Transitions; default: 1 000, 10 000 and 100 000.")] = None,
    output: Folder = RESULTS,
) -> None:
    """FrameReplayBuffer against SB3's buffers and sb3-extra-buffers': memory, adding, sampling."""
    from benchmarks.buffer import SIZES, measure

    with console.status("") as status:
        rows = measure(tuple(size or SIZES), repeats=repeats, tell=status.update)
    publish("buffer", "Replay of stacks of three 100x100 frames", rows, _command(), by=("transitions",), folder=output)


@app.command()
def scaling(repeats: Repeats = 10, output: Folder = RESULTS) -> None:
    """An update of crc against batch and image size."""
    from benchmarks.scaling import measure

    with console.status("") as status:
        rows = measure(repeats=repeats, on_round=lambda done: status.update(f"{done} of {repeats}"))
    publish("scaling", "An update of crc", rows, _command(), by=("varied",), folder=output)


@app.command()
def profile(
    repeats: Annotated[int, typer.Option(min=1, help="Pairs of updates.")] = 5,
    method: Annotated[str, typer.Option(help="A method of update.")] = "crc",
    networks: Annotated[list[str], typer.Option(help="paper, laptop")] = ["paper", "laptop"],  # noqa: B006
    batch: Annotated[int, typer.Option(min=2, help="Batch size.")] = 128,
    output: Folder = RESULTS,
) -> None:
    """What an update spends its time on."""
    from benchmarks.profiling import measure

    rows = []
    with console.status("") as status:
        for network in networks:
            status.update(f"{network} networks")
            rows += [{"networks": network, **row} for row in measure(method, network, batch, repeats=repeats)]
    publish("profile", f"An update of {method}, batch {batch}", rows, _command(), by=("networks",), folder=output)


@app.command()
def checkpoints(
    decisions: Annotated[
        int, typer.Option(min=1, help="Random decisions, of which every 1 000th is followed by a checkpoint.")
    ] = 12_500,
    buffer_size: Annotated[
        int | None, typer.Option(min=1, help="Of the replay buffer; default: as many as decisions.")
    ] = None,
    networks: Annotated[list[str], typer.Option(help="paper, laptop")] = ["paper", "laptop"],  # noqa: B006
    output: Folder = RESULTS,
) -> None:
    """How long TrainingCheckpoint stops a training, how long it writes, and what it needs on the disk."""
    from benchmarks.checkpoints import EVERY, measure
    from benchmarks.networks import NETWORKS

    rows = []
    with console.status("") as status:
        for network in networks:
            status.update(f"{network} networks")
            rows.append(measure(networks=NETWORKS[network], decisions=decisions, buffer_size=buffer_size))
    publish("checkpoints", f"A checkpoint after every {EVERY} decisions", rows, _command(), folder=output)


@app.command()
def gpu(
    repeats: Repeats = 10,
    networks: Annotated[list[str], typer.Option(help="paper, laptop")] = ["paper"],  # noqa: B006
    batch: Annotated[list[int], typer.Option(help="Batch sizes.")] = [512],  # noqa: B006
    method: Annotated[list[str] | None, typer.Option(help="Presets beside stock SAC; default: five.")] = None,
    form: Annotated[list[str] | None, typer.Option(help="How updates are made; default: all four.")] = None,
    decisions: Annotated[int, typer.Option(min=1, help="Of learn() that are timed.")] = 500,
    output: Annotated[Path, typer.Option(help="Where the JSON file goes.")] = RESULTS.parent / "gpu",
) -> None:
    """CRCSAC.train and learn() against stock SB3 SAC on one GPU."""
    import torch as th

    from benchmarks.gpu import FORMS, METHODS, end_to_end, measure

    if not th.cuda.is_available():
        raise typer.BadParameter("there is no GPU that torch can use; python -m sb3_crc doctor says what there is")
    rows, whole = [], []
    with console.status("") as status:
        for network in networks:
            for size in batch:
                told = lambda done, size=size: status.update(f"batch {size}: {done} of {repeats}")  # noqa: E731
                own = {"methods": tuple(method or METHODS), "forms": tuple(form or FORMS)}
                rows += measure(network, size, repeats=repeats, on_round=told, **own)
                status.update("learn()")
                whole += end_to_end(network, size, decisions=decisions)
    publish("update", "One update on a GPU", rows, _command(), by=("networks", "batch"), folder=output)
    publish("end_to_end", "learn() on a GPU", whole, _command(), by=("networks", "batch"), folder=output)


@app.command("all")
def everything(output: Folder = RESULTS) -> None:
    """All of these with their defaults, one after the other: two hours on two cores, which nothing else should use."""
    update(output=output)
    buffer(output=output)
    env(output=output)
    end_to_end(output=output)
    scaling(output=output)
    checkpoints(output=output)
    profile(output=output)


def _command() -> str:
    return " ".join(["python -m benchmarks", *sys.argv[1:]])


if __name__ == "__main__":
    app()
