"""Commands that make evidence of runs: ``sb3-crc trials | results | reproduced``."""

from pathlib import Path
from typing import Annotated

import typer

from sb3_crc import completion
from sb3_crc.command import Group, No, command
from sb3_crc.console import say, tell

app = typer.Typer()


@command(app, Group.EVIDENCE, "sb3-crc trials logs/crc/dmc_pixels-cartpole-swingup-v0_1 --output trials.csv")
def trials(
    runs: Annotated[
        list[Path], typer.Argument(help="Folders of runs, <logs>/<algo>/<env>_<number>.", autocompletion=completion.runs)
    ],
    output: Annotated[Path, typer.Option(help="CSV file to write into; rows of other runs stay.")] = Path("trials.csv"),
    episodes: Annotated[
        int, typer.Option(min=0, help="Fresh episodes for the final policy of each finished run; 0: it is not scored.")
    ] = 10,
    note: Annotated[str, typer.Option(help="Why it was tried, or why it was stopped.")] = "",
) -> object:
    """Write runs into a table of trials: settings, curve, final return, time."""
    from sb3_crc.experiments.trials import record_trials

    rows = record_trials(runs, output, episodes=episodes, note=note)
    for row in rows:
        say(f"{row['trial']}: {row.get('final_mean', 'not finished')}")
    return {"file": output, "trials": rows}


@command(app, Group.EVIDENCE, "sb3-crc results results/laptop/final --baseline crc --baseline rad")
def results(
    sources: Annotated[
        list[Path],
        typer.Argument(help="CSV files of scores, or folders that contain runs.", autocompletion=completion.runs),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Markdown file to write.")] = Path("results.md"),
    baselines: Annotated[
        list[str] | None,
        typer.Option(
            "--baseline",
            help="A method that the others are compared with, once for each; else rad.",
            autocompletion=completion.methods,
        ),
    ] = None,
    landmarks_file: Annotated[
        Path | None, typer.Option("--landmarks", help="JSON file of `sb3-crc landmarks`; else they are not in it.")
    ] = None,
    trials: Annotated[
        list[Path] | None,
        typer.Option(help="CSV file of `sb3-crc trials`, to say how many led to the settings; once for each file."),
    ] = None,
) -> object:
    """What scores show and what they do not, as a page: each seed, chances to reach what is published, what was not done."""
    from sb3_crc.experiments.evidence import results_page

    page = results_page(sources, baselines=baselines or ["rad"], landmarks=landmarks_file, trials=trials or ())
    output.write_text(page, encoding="utf-8")
    say(str(output))
    return {"written": [output]}


@command(app, Group.EVIDENCE, "sb3-crc reproduced reproduction results/laptop/final")
def reproduced(
    runs: Annotated[
        Path,
        typer.Argument(
            help="Folder with runs of one method on one task, or CSV file of their scores.", autocompletion=completion.runs
        ),
    ],
    committed: Annotated[
        Path,
        typer.Argument(help="Scores that are to be reproduced: CSV file, or folder of runs.", autocompletion=completion.runs),
    ],
) -> object:
    """Do runs agree with scores that are committed? The exit code is 1 if they do not."""
    from sb3_crc.experiments.reproduction import compare_with

    found = compare_with(committed, runs)
    for name in ("committed", "reproduced"):
        each = ", ".join(f"seed {seed}: {value:.1f}" for seed, value in found[name].items())
        say(f"{found['method']} on {found['task']}, {name}: {sum(found[name].values()) / len(found[name]):.1f} ({each})")
    if found["interval"] is None:
        tell("one committed seed: no interval to compare with")
        return {**found, "agrees": None}
    low, high = found["interval"]
    mean = sum(found["reproduced"].values()) / len(found["reproduced"])
    say(f"expected if nothing has changed: {low:.0f} to {high:.0f} (95 %)")
    if not low <= mean <= high:
        tell("outside of it")
        return No({**found, "agrees": False})
    return {**found, "agrees": True}
