"""Commands that train: ``sb3-crc compare | sweep | watch``."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sb3_crc import completion
from sb3_crc.command import Group, No, command, separated
from sb3_crc.console import console, on_a_screen, say, show, tell

if TYPE_CHECKING:
    from sb3_crc.experiments.specs import RunSpec
    from sb3_crc.experiments.watching import Progress

app = typer.Typer()


@dataclass(frozen=True)
class Execution:
    """How ``compare`` and ``sweep`` execute runs."""

    engine: Annotated[
        str,
        typer.Option(
            help="What runs them: local (processes of this machine), ray or slurm.",
            autocompletion=completion.one_of("local", "ray", "slurm"),
        ),
    ] = "local"
    jobs: Annotated[
        int | None, typer.Option(min=1, help="local, slurm: runs at once; else as many as cores, memory and GPU allow.")
    ] = None
    address: Annotated[
        str | None, typer.Option(help="ray: of a cluster, host:port or auto; else Ray runs on this machine.")
    ] = None
    cpus: Annotated[int | None, typer.Option(min=1, help="ray, slurm: cores of each run; else one.")] = None
    gpus: Annotated[
        float | None, typer.Option(min=0, help="ray, slurm: GPUs of each run; else none. Ray shares one: 0.25.")
    ] = None
    memory: Annotated[
        float | None, typer.Option(min=0.1, help="ray, slurm: gigabytes of each run; else what is measured.")
    ] = None
    slurm: Annotated[
        list[str] | None,
        typer.Option(help="slurm: NAME=VALUE of submitit, once for each: partition=gpu, account=NAME, timeout_min=240."),
    ] = None
    checkpoint_every: Annotated[int, typer.Option(min=1, help="Agent steps between two checkpoints of a run.")] = 1_000
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="List the runs, their state, hours, memory and disk; start none.")
    ] = False


@command(
    app,
    Group.COMPARE,
    "sb3-crc compare --task cartpole-swingup --presets crc,rad -o runs --dry-run",
    "sb3-crc compare --task cartpole-swingup --conf-file zoo_configs/laptop.yml -o runs",
)
def compare(
    task: Annotated[
        list[str], typer.Option(help="domain-task of dm_control; once for each task.", autocompletion=completion.tasks)
    ],
    presets: Annotated[
        str,
        typer.Option(help="Presets and stock algorithms, separated by commas.", autocompletion=completion.methods),
    ] = "crc,rad,sac",
    seeds: Annotated[int, typer.Option(min=1, help="How many trainings of each preset on each task.")] = 3,
    first_seed: Annotated[int, typer.Option(min=0, help="Seed of the first training; the others follow it.")] = 0,
    env_steps: Annotated[int, typer.Option(min=1, help="Budget of each run in environment steps.")] = 100_000,
    eval_every: Annotated[
        int | None, typer.Option(min=1, help="Environment steps between two evaluations; else a twentieth of the budget.")
    ] = None,
    eval_episodes: Annotated[int, typer.Option(min=1, help="Episodes of each evaluation.")] = 10,
    conf_file: Annotated[
        Path | None, typer.Option(help="YAML file with the settings of all; else each preset's zoo_configs/<preset>.yml.")
    ] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the runs and of scores.csv.")] = Path("comparison"),
    *,
    execution: Execution,
) -> object:
    """Train several methods with the same seeds, evaluate them alike, and write scores.csv. The same command goes on."""
    from sb3_crc.experiments.specs import compared

    specs = compared(
        separated(presets),
        task,
        range(first_seed, first_seed + seeds),
        env_steps=env_steps,
        eval_every=eval_every,
        eval_episodes=eval_episodes,
        conf_file=conf_file,
    )
    return _run(specs, output, execution)


@command(
    app,
    Group.COMPARE,
    "sb3-crc sweep zoo_configs/sweeps/ablation_1.yml -o ablation_1 --dry-run",
    "sb3-crc sweep zoo_configs/sweeps/ablation_1.yml --conf-file zoo_configs/laptop.yml -o ablation_1",
)
def sweep(
    file: Annotated[Path, typer.Argument(help="YAML file: tasks, seeds, env_steps, variants; see zoo_configs/sweeps.")],
    seeds: Annotated[int | None, typer.Option(min=1, help="How many trainings of each variant; else the file's.")] = None,
    env_steps: Annotated[
        int | None, typer.Option(min=1, help="Budget of each run in environment steps; else the file's.")
    ] = None,
    conf_file: Annotated[
        Path | None, typer.Option(help="YAML file with the settings of all; else the one that the sweep names.")
    ] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the runs and of scores.csv.")] = Path("sweep"),
    pack: Annotated[
        bool, typer.Option("--pack", help="local: fill a GPU with runs, of which four draw on it and the others on the CPU.")
    ] = False,
    *,
    execution: Execution,
) -> object:
    """Train the variants of a sweep file as `compare` does its presets. The same command goes on."""
    from sb3_crc.configurations import shipped
    from sb3_crc.experiments.specs import read_sweep

    conf_file = None if conf_file is None else shipped(conf_file).absolute()
    specs = read_sweep(file, seeds=seeds, env_steps=env_steps, conf_file=conf_file)
    return _run(specs, output, execution, pack=pack)


@command(app, Group.COMPARE, "sb3-crc watch runs", "sb3-crc watch logs --json")
def watch(
    runs: Annotated[
        list[Path],
        typer.Argument(help="Runs of train.py, or folders that contain some.", autocompletion=completion.runs),
    ],
    every: Annotated[float, typer.Option(min=0.5, help="Seconds between two looks.")] = 5.0,
    once: Annotated[
        bool, typer.Option("--once", help="Look once; so it is too with --json and where the output is no terminal.")
    ] = False,
) -> object:
    """Progress, returns, instruments and time left of runs while they train; ends when all have ended, or with Ctrl-C."""
    import time

    from rich.live import Live

    from sb3_crc.experiments.runs import find_runs
    from sb3_crc.experiments.watching import progress_table, read_progress

    def look() -> "list[Progress]":
        found = [read_progress(run) for run in find_runs(runs)]
        if not found:
            raise FileNotFoundError(f"no run of train.py in {', '.join(map(str, runs))}")
        return found

    progresses = look()
    if once or console.quiet or not on_a_screen(console):
        show(progress_table(progresses))
    else:
        with Live(progress_table(progresses), console=console, auto_refresh=False) as live:
            while any(one.status in ("unfinished", "silent") for one in progresses):
                time.sleep(every)
                progresses = look()
                live.update(progress_table(progresses), refresh=True)
    return {"runs": progresses}


def _run(specs: "Sequence[RunSpec]", output: Path, execution: Execution, *, pack: bool = False) -> object:
    from sb3_crc.experiments.campaign import Campaign, execute, parse_assignments, plan
    from sb3_crc.experiments.engines.local import Stopped
    from sb3_crc.experiments.scores import read_scores, write_scores

    options = asdict(execution)
    dry_run = options.pop("dry_run")
    options["slurm"] = parse_assignments(execution.slurm or [], "--slurm")
    campaign = Campaign(**options, pack=pack or None)
    if dry_run:
        planned = plan(specs, output, campaign)
        for line in planned.lines():
            say(line)
        return planned.document()
    try:
        failed = execute(specs, output, campaign)
    except Stopped as stopped:
        slurm = campaign.engine == "slurm"
        tell("Stopped. " + ("The jobs go on, and the same command waits for them." if slurm else "The same command goes on."))
        raise typer.Exit(128 + stopped.signum) from None
    scores = read_scores([output])
    file = output / "scores.csv"
    write_scores(scores, file)
    say(f"{file}: {scores.final['run'].nunique()} runs")
    for missing in scores.missing:
        tell(f"missing: {missing}")
    document = {"scores": file, "runs": scores.final["run"].nunique(), "failed": [output / spec.name for spec in failed]}
    document["missing"] = list(scores.missing)
    return No(document) if failed else document
