"""Commands that compare: ``sb3-crc compare | sweep | evaluate | table | curves``."""

import importlib.util
from pathlib import Path
from typing import Annotated, Any

import typer

from sb3_crc.console import console, errors, in_one_line, say

app = typer.Typer()

Sources = Annotated[list[Path], typer.Argument(help="folders that contain runs, or CSV files of scores")]
Mixed = Annotated[bool, typer.Option("--allow-mixed", help="Let scores of different protocols stand in one table.")]
Engine = Annotated[str, typer.Option(help="local, ray or slurm")]
Jobs = Annotated[int | None, typer.Option(min=1, help="runs at once; else as many as cores, memory and GPU allow")]
Address = Annotated[str | None, typer.Option(help="of a Ray cluster, host:port or auto; else Ray runs on this machine")]
Cpus = Annotated[int | None, typer.Option(min=1, help="ray, slurm: cores of each run; else one")]
Gpus = Annotated[float | None, typer.Option(min=0, help="ray, slurm: GPUs of each run; Ray shares one: 0.25")]
Memory = Annotated[float | None, typer.Option(min=0.1, help="ray, slurm: gigabytes of each run; else what is measured")]
Slurm = Annotated[list[str] | None, typer.Option(help="NAME=VALUE of submitit: partition=gpu, account=..., timeout_min=240")]
Every = Annotated[int, typer.Option(min=1, help="agent steps between two checkpoints of a run")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="List the runs, their state, hours, memory and disk; start none.")]


@app.command()
@in_one_line
def compare(
    task: Annotated[list[str], typer.Option(help="domain-task; once for each task")],
    presets: Annotated[str, typer.Option(help="presets and stock algorithms, separated by commas")] = "crc,rad,sac",
    seeds: Annotated[int, typer.Option(min=1, help="how many trainings of each")] = 3,
    first_seed: Annotated[int, typer.Option(min=0, help="of the trainings; the others follow it")] = 0,
    env_steps: Annotated[int, typer.Option(min=1, help="budget of each run in environment steps")] = 100_000,
    eval_every: Annotated[int | None, typer.Option(min=1, help="environment steps; else a twentieth of the budget")] = None,
    eval_episodes: Annotated[int, typer.Option(min=1, help="of each evaluation")] = 10,
    conf_file: Annotated[Path | None, typer.Option(help="configuration of all; else zoo_configs/<preset>.yml")] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="folder of the runs and of scores.csv")] = Path("comparison"),
    engine: Engine = "local",
    jobs: Jobs = None,
    address: Address = None,
    cpus: Cpus = None,
    gpus: Gpus = None,
    memory: Memory = None,
    slurm: Slurm = None,
    checkpoint_every: Every = 1_000,
    dry_run: DryRun = False,
) -> None:
    """Train several methods with the same seeds, evaluate them alike, and write scores.csv. The same command goes on."""
    from sb3_crc.experiments.specs import compared

    specs = compared(
        [name.strip() for name in presets.split(",") if name.strip()],
        task,
        range(first_seed, first_seed + seeds),
        env_steps=env_steps,
        eval_every=max(1, env_steps // 20) if eval_every is None else eval_every,
        eval_episodes=eval_episodes,
        conf_file=conf_file,
    )
    how = {"engine": engine, "jobs": jobs, "address": address, "cpus": cpus, "gpus": gpus, "memory": memory, "slurm": slurm}
    _run(specs, output, dry_run, checkpoint_every=checkpoint_every, **how)


@app.command()
@in_one_line
def sweep(
    file: Annotated[Path, typer.Argument(help="YAML file: tasks, seeds, env_steps, variants; see zoo_configs/sweeps")],
    seeds: Annotated[int | None, typer.Option(min=1, help="instead of the file's")] = None,
    env_steps: Annotated[int | None, typer.Option(min=1, help="instead of the file's")] = None,
    conf_file: Annotated[Path | None, typer.Option(help="instead of the file's, for instance zoo_configs/laptop.yml")] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="folder of the runs and of scores.csv")] = Path("sweep"),
    engine: Engine = "local",
    jobs: Jobs = None,
    address: Address = None,
    cpus: Cpus = None,
    gpus: Gpus = None,
    memory: Memory = None,
    slurm: Slurm = None,
    checkpoint_every: Every = 1_000,
    pack: Annotated[
        bool, typer.Option("--pack", help="local: fill a GPU with runs, of which four draw on it and the others on the CPU")
    ] = False,
    dry_run: DryRun = False,
) -> None:
    """Train the variants of a sweep file as `compare` does its presets. The same command goes on."""
    from sb3_crc.experiments.specs import read_sweep

    conf_file = None if conf_file is None else conf_file.absolute()
    specs = read_sweep(file, seeds=seeds, env_steps=env_steps, conf_file=conf_file)
    how = {"engine": engine, "jobs": jobs, "address": address, "cpus": cpus, "gpus": gpus, "memory": memory, "slurm": slurm}
    how["pack"] = pack or None
    _run(specs, output, dry_run, checkpoint_every=checkpoint_every, **how)


@app.command()
@in_one_line
def evaluate(
    runs: Annotated[list[Path], typer.Argument(help="folders of runs of train.py, or that contain some")],
    episodes: Annotated[int, typer.Option(min=1, help="fresh ones")] = 10,
    again: Annotated[bool, typer.Option("--again", help="Evaluate also what has been evaluated.")] = False,
) -> None:
    """Score final policies: mean action, fresh episodes, seeds that no training and no other evaluation has seen."""
    from sb3_crc.experiments.final import evaluate_final
    from sb3_crc.experiments.runs import FINAL, find_runs, read_json

    found = list(find_runs(runs))
    if not found:
        raise FileNotFoundError(f"no run of train.py in {', '.join(map(str, runs))}")
    for run in found:
        done = (run.folder / FINAL).exists() and not again
        returns = (read_json(run.folder / FINAL) if done else evaluate_final(run, episodes=episodes))["returns"]
        episodes_range = f"{min(returns):.1f} to {max(returns):.1f}, {len(returns)} episodes"
        say(f"{run.folder}: {sum(returns) / len(returns):.1f} ({episodes_range})")


@app.command()
@in_one_line
def table(
    which: Annotated[str, typer.Argument(help="100k or 500k: environment steps")],
    sources: Sources,
    format: Annotated[str, typer.Option(help="text, markdown, latex or csv")] = "text",
    output: Annotated[Path | None, typer.Option("--output", "-o", help="file to write; else it is printed")] = None,
    allow_mixed: Mixed = False,
) -> None:
    """The paper's table: published scores, ours beside them, and what is missing."""
    from sb3_crc.experiments.table_formats import table_text

    text = table_text(which, sources, format, allow_mixed)
    if output is None:
        typer.echo(text)
    else:
        output.write_text(text + "\n", encoding="utf-8")


@app.command()
@in_one_line
def curves(
    sources: Sources,
    output: Annotated[Path, typer.Option("--output", "-o", help="folder for figures and summaries")] = Path("figures"),
    baseline: Annotated[str | None, typer.Option(help="the method that others are compared with; the first if absent")] = None,
    weights: Annotated[Path | None, typer.Option(help="sweep file of convex weights, drawn as a triangle")] = None,
    allow_mixed: Mixed = False,
) -> None:
    """Curves with intervals over environment steps and wall time, profiles, and which differences are resolved."""
    from sb3_crc.experiments.comparison_figures import draw_comparison, draw_weights
    from sb3_crc.experiments.scores import read_scores
    from sb3_crc.experiments.specs import convex_weights

    if importlib.util.find_spec("rliable") is None:
        raise ValueError("curves needs the extra 'analysis': pip install 'sb3-crc[analysis]'")
    scores = read_scores(sources)
    written = draw_comparison(scores, output, baseline=baseline, allow_mixed=allow_mixed)
    if weights is not None:
        written += draw_weights(scores, output, convex_weights(weights))
    for path in written:
        say(str(path))
    for missing in scores.missing:
        say(f"missing: {missing}", errors)


@app.command()
@in_one_line
def report(
    sources: Annotated[list[Path], typer.Argument(help="runs, folders that contain runs and figures, CSV files of scores")],
    output: Annotated[Path, typer.Option("--output", "-o", help="file to write")] = Path("report.html"),
    title: Annotated[str | None, typer.Option(help="of the page; else the names of what it is about")] = None,
) -> None:
    """One page about runs, to be opened in a browser: tables, curves, instruments, settings, films, commands."""
    from sb3_crc.experiments.report.page import write_report

    if lacking := [name for name in ("plotly", "rliable") if importlib.util.find_spec(name) is None]:
        raise ValueError(f"report needs {' and '.join(lacking)}: pip install 'sb3-crc[analysis]'")
    left_out = write_report(sources, output, title=title)
    say(f"{output}: {output.stat().st_size / 1e6:.1f} MB")
    for one in left_out:
        say(f"left out, the page would have become too large: {one}", errors)


@app.command()
@in_one_line
def results(
    sources: Sources,
    output: Annotated[Path, typer.Option("--output", "-o", help="file to write")] = Path("results.md"),
    baseline: Annotated[str, typer.Option(help="the method that others are compared with")] = "rad",
    landmarks_file: Annotated[Path | None, typer.Option("--landmarks", help="of `sb3-crc landmarks`")] = None,
    trials: Annotated[Path | None, typer.Option(help="table of trials, of `sb3-crc trials`")] = None,
) -> None:
    """What scores show and what they do not, as a page: each seed, chances to reach what is published, what was not done."""
    from sb3_crc.experiments.evidence import results_page

    output.write_text(results_page(sources, baseline=baseline, landmarks=landmarks_file, trials=trials), encoding="utf-8")
    say(str(output))


@app.command()
@in_one_line
def landmarks(
    task: Annotated[list[str] | None, typer.Option(help="domain-task; once for each; else the paper's ten")] = None,
    episodes: Annotated[int, typer.Option(min=1, help="of each policy on each task")] = 10,
    output: Annotated[Path, typer.Option("--output", "-o", help="JSON file to write")] = Path("landmarks.json"),
) -> None:
    """Measure what random actions and no actions get."""
    from sb3_crc.envs.tasks import PAPER_TASKS
    from sb3_crc.experiments.landmarks import measure_landmarks
    from sb3_crc.experiments.runs import write_json

    found = measure_landmarks(task or PAPER_TASKS, episodes=episodes)
    write_json(found, output)
    for name, policies in found["returns"].items():
        say(f"{name}: {', '.join(f'{policy} {sum(own) / len(own):.1f}' for policy, own in policies.items())}")


@app.command()
@in_one_line
def reproduced(
    runs: Annotated[Path, typer.Argument(help="folder with runs of one method on one task, or CSV file of their scores")],
    committed: Annotated[Path, typer.Argument(help="scores that are to be reproduced: CSV file, or folder of runs")],
) -> None:
    """Do runs agree with scores that are committed? The exit code is 1 if they do not."""
    from sb3_crc.experiments.evidence import compare_with

    found = compare_with(committed, runs)
    for name in ("committed", "reproduced"):
        each = ", ".join(f"seed {seed}: {value:.1f}" for seed, value in found[name].items())
        say(f"{found['method']} on {found['task']}, {name}: {sum(found[name].values()) / len(found[name]):.1f} ({each})")
    if found["interval"] is None:
        say("one committed seed: no interval to compare with")
        return
    low, high = found["interval"]
    mean = sum(found["reproduced"].values()) / len(found["reproduced"])
    say(f"expected if nothing has changed: {low:.0f} to {high:.0f} (95 %)")
    if not low <= mean <= high:
        say("outside of it", errors)
        raise typer.Exit(1)


@app.command()
@in_one_line
def watch(
    runs: Annotated[list[Path], typer.Argument(help="runs of train.py, or folders that contain some")],
    every: Annotated[float, typer.Option(min=0.5, help="seconds between two looks")] = 5.0,
    once: Annotated[bool, typer.Option("--once", help="Look once; so it is too where the output is no terminal.")] = False,
) -> None:
    """Progress, returns, instruments and time left of runs while they train; ends when all have ended, or with Ctrl-C."""
    import time

    from rich.live import Live

    from sb3_crc.experiments.runs import find_runs
    from sb3_crc.experiments.watching import Progress, progress_table, read_progress

    def look() -> list[Progress]:
        found = [read_progress(run) for run in find_runs(runs)]
        if not found:
            raise FileNotFoundError(f"no run of train.py in {', '.join(map(str, runs))}")
        return found

    progresses = look()
    if once or not console.is_terminal:
        console.print(progress_table(progresses))
        return
    with Live(progress_table(progresses), console=console, auto_refresh=False) as live:
        try:
            while any(one.status in ("unfinished", "silent") for one in progresses):
                time.sleep(every)
                progresses = look()
                live.update(progress_table(progresses), refresh=True)
        except KeyboardInterrupt:
            return


def _run(specs: Any, output: Path, dry_run: bool, **how: Any) -> None:
    from sb3_crc.experiments.campaign import Campaign, describe, execute, parse_assignments
    from sb3_crc.experiments.engines.local import Stopped
    from sb3_crc.experiments.scores import read_scores, write_scores

    campaign = Campaign(**how | {"slurm": parse_assignments(how["slurm"] or [], "--slurm")})
    if dry_run:
        for line in describe(specs, output, campaign):
            say(line)
        return
    try:
        failed = execute(specs, output, campaign)
    except Stopped as stopped:
        slurm = campaign.engine == "slurm"
        errors.print(
            "Stopped. " + ("The jobs go on, and the same command waits for them." if slurm else "The same command goes on.")
        )
        raise typer.Exit(128 + stopped.signum) from None
    scores = read_scores([output])
    write_scores(scores, output / "scores.csv")
    say(f"{output / 'scores.csv'}: {scores.final['run'].nunique()} runs")
    for missing in scores.missing:
        say(f"missing: {missing}", errors)
    if failed:
        raise typer.Exit(1)
