"""Commands that score, tabulate and draw runs: ``sb3-crc evaluate | table | curves | curve | report``."""

from pathlib import Path
from typing import Annotated, Any
from zipfile import BadZipFile

import typer

from sb3_crc import completion
from sb3_crc.command import Group, No, command, require
from sb3_crc.console import say, tell

app = typer.Typer()

Sources = Annotated[
    list[Path],
    typer.Argument(help="Folders that contain runs, or CSV files of scores.", autocompletion=completion.runs),
]
Mixed = Annotated[bool, typer.Option("--allow-mixed", help="Let scores of different protocols stand in one table.")]


@command(app, Group.RUNS, "sb3-crc evaluate logs/crc/dmc_pixels-cartpole-swingup-v0_1")
def evaluate(
    runs: Annotated[
        list[Path],
        typer.Argument(help="Folders of runs of train.py, or that contain some.", autocompletion=completion.runs),
    ],
    episodes: Annotated[int, typer.Option(min=1, help="Fresh episodes of each run.")] = 10,
    again: Annotated[bool, typer.Option("--again", help="Evaluate also what has been evaluated.")] = False,
) -> object:
    """Score final policies: mean action, fresh episodes from seeds that no training has. Runs that are not ready are named."""
    from sb3_crc.experiments.runs import find_runs

    found = list(find_runs(runs))
    if not found:
        raise FileNotFoundError(f"no run of train.py in {', '.join(map(str, runs))}")
    scored: list[dict[str, Any]] = []
    skipped: list[dict[str, Any]] = []
    for number, run in enumerate(found, 1):
        try:
            final = None if again else run.final
            if final is None:
                from sb3_crc.experiments.final import evaluate_final

                tell(f"[{number}/{len(found)}] {run.folder}: {episodes} episodes")
                final = evaluate_final(run, episodes=episodes)
            about = {"folder": run.folder, "method": run.method, "task": run.task, "seed": run.seed}
        except (FileNotFoundError, ValueError, BadZipFile) as error:
            skipped.append({"folder": run.folder, "reason": str(error)})
            continue
        returns = final["returns"]
        mean = sum(returns) / len(returns)
        say(f"{run.folder}: {mean:.1f} ({min(returns):.1f} to {max(returns):.1f}, {len(returns)} episodes)")
        scored.append({**about, "mean": mean, "returns": returns})
    for one in skipped:
        named = str(one["folder"]) in one["reason"]
        tell(f"skipped: {one['reason'] if named else '{folder}: {reason}'.format(**one)}")
    document = {"runs": scored, "skipped": skipped}
    return No(document) if skipped else document


@command(app, Group.RUNS, "sb3-crc table 100k runs --format markdown", "sb3-crc table 100k results/laptop/final")
def table(
    which: Annotated[
        str,
        typer.Argument(help="Environment steps: 100k or 500k.", autocompletion=completion.one_of("100k", "500k")),
    ],
    sources: Sources,
    format: Annotated[
        str,
        typer.Option(
            help="text, markdown, latex or csv, for people and their papers.",
            autocompletion=completion.one_of("text", "markdown", "latex", "csv"),
        ),
    ] = "text",
    output: Annotated[Path | None, typer.Option("--output", "-o", help="File to write; else it is printed.")] = None,
    allow_mixed: Mixed = False,
) -> object:
    """The paper's table: published scores, ours beside them, and what is missing."""
    from sb3_crc.experiments.scores import read_scores
    from sb3_crc.experiments.table_formats import FORMATS, render
    from sb3_crc.experiments.tables import paper_table
    from sb3_crc.settings import check_name

    check_name("format", format, FORMATS)  # before much is read
    found = paper_table(read_scores(sources), which, allow_mixed=allow_mixed)
    text = render(found, format)
    if output is None:
        say(text)
    else:
        output.write_text(text + "\n", encoding="utf-8")
    return found


@command(app, Group.RUNS, "sb3-crc curves runs -o figures --baseline rad")
def curves(
    sources: Sources,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for figures and summaries.")] = Path("figures"),
    baseline: Annotated[
        str | None, typer.Option(help="The method that others are compared with; else the first that is found.")
    ] = None,
    weights: Annotated[
        Path | None, typer.Option(help="Sweep file of convex weights of the three losses, drawn as a triangle.")
    ] = None,
    allow_mixed: Mixed = False,
) -> object:
    """Curves with intervals over environment steps and wall time, profiles, and which differences are resolved."""
    from sb3_crc.experiments.comparison_figures import draw_comparison
    from sb3_crc.experiments.convex_weights import convex_weights, draw_weights
    from sb3_crc.experiments.scores import read_scores

    require("analysis", "rliable")
    shares = None if weights is None else convex_weights(weights)  # before much is read
    scores = read_scores(sources)
    written = draw_comparison(scores, output, baseline=baseline, allow_mixed=allow_mixed)
    if shares is not None:
        written += draw_weights(scores, output, shares, allow_mixed=allow_mixed)
    for path in written:
        say(str(path))
    for missing in scores.missing:
        tell(f"missing: {missing}")
    return {"written": written, "missing": list(scores.missing)}


@command(app, Group.RUNS, "sb3-crc curve logs/crc/dmc_pixels-cartpole-swingup-v0_1")
def curve(
    runs: Annotated[
        list[Path],
        typer.Argument(help="Runs of train.py, <method>/<run>, each with evaluations.npz.", autocompletion=completion.runs),
    ],
    output: Annotated[Path, typer.Option(help="Picture to write.")] = Path("learning_curve.png"),
    action_repeat: Annotated[
        int | None,
        typer.Option(min=1, help="Environment steps per agent step; else the runs' own, 1 where there is no args.yml."),
    ] = None,
    baselines: Annotated[
        Path | None, typer.Option(help="JSON file of `sb3-crc baselines`, whose returns are drawn as lines.")
    ] = None,
    title: Annotated[str, typer.Option(help="Written above it; else nothing is.")] = "",
) -> object:
    """Draw the learning curve of a run, or those of several methods and seeds, beside policies that have learned nothing."""
    from sb3_crc.experiments.curves import plot_learning_curve, plot_learning_curves
    from sb3_crc.experiments.runs import Run, read_json

    measured = {} if baselines is None else read_json(baselines)
    references = {f"{name} policy": policy["mean"] for name, policy in measured.items()}
    tasks = {Run(run).task for run in runs if _is_described(run)}
    if len(tasks) > 1:
        raise ValueError(f"these runs are of several tasks, {', '.join(sorted(tasks))}: `sb3-crc curves` draws those")
    repeat = _common_repeat(runs) if action_repeat is None else action_repeat
    shared: dict[str, Any] = {"action_repeat": repeat, "title": title, "references": references}
    files = [run / "evaluations.npz" for run in runs]
    if len(files) == 1:
        plot_learning_curve(files[0], output, **shared)
    else:
        methods: dict[str, list[Path]] = {}
        for file in files:
            method = Run(file.parent).method if _is_described(file.parent) else file.parent.parent.name
            methods.setdefault(method, []).append(file)
        plot_learning_curves(methods, output, **shared)
    say(str(output))
    return {"written": [output]}


def _is_described(run: Path) -> bool:
    return any(run.glob("*/args.yml"))


def _common_repeat(runs: list[Path]) -> int:
    from sb3_crc.experiments.runs import Run

    repeats = {Run(run).action_repeat if _is_described(run) else 1 for run in runs}
    if len(repeats) > 1:
        raise ValueError(
            f"these runs do not share an axis: an agent step is {' or '.join(map(str, sorted(repeats)))} environment steps"
        )
    return repeats.pop()


@command(app, Group.RUNS, "sb3-crc report runs -o report.html")
def report(
    sources: Annotated[
        list[Path],
        typer.Argument(help="Runs, folders with runs and figures, CSV files of scores.", autocompletion=completion.runs),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="File to write.")] = Path("report.html"),
    title: Annotated[str | None, typer.Option(help="Of the page; else the names of what it is about.")] = None,
) -> object:
    """One page about runs, to be opened in a browser: tables, curves, instruments, settings, films, commands."""
    from sb3_crc.experiments.report.page import write_report

    require("analysis", "plotly", "rliable")
    left_out = write_report(sources, output, title=title)
    say(f"{output}: {output.stat().st_size / 1e6:.1f} MB")
    for one in left_out:
        tell(f"left out, the page would have become too large: {one}")
    return {"file": output, "bytes": output.stat().st_size, "left_out": left_out}
