"""The command line, ``sb3-crc`` or ``python -m sb3_crc``: what works here, measurements, comparisons, analyses.

Training is ``train.py``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from sb3_crc.analysis.commands import app as analysis
from sb3_crc.console import console, errors, in_one_line, say
from sb3_crc.experiments.commands import app as experiments

app = typer.Typer(no_args_is_help=True, add_completion=False, help="CRC-RL for Stable-Baselines3.")
app.add_typer(experiments)
app.add_typer(analysis)

MARKS = {"ok": "[green]ok[/]", "note": "[yellow]note[/]", "broken": "[red]broken[/]"}


@app.command()
def doctor() -> None:
    """Show what works on this machine; exit code 1 if something essential does not."""
    from sb3_crc.doctor import Finding, examine

    table = Table(title="sb3_crc doctor", title_justify="left")
    for column in ("", "", "found", ""):
        table.add_column(column, overflow="fold")
    findings: list[Finding] = []
    with console.status("drawing a few frames"):
        for finding in examine():
            begins = not findings or findings[-1].topic != finding.topic
            if begins and findings:
                table.add_section()
            topic = finding.topic if begins else ""
            table.add_row(topic, finding.name, escape(finding.value), MARKS[finding.verdict])
            findings.append(finding)
    console.print(table)
    broken = [finding for finding in findings if finding.verdict == "broken"]
    for finding in broken:  # once more outside the table, where a command that is to be copied stays on one line
        say(f"{finding.name}: {finding.value}", errors)
    if broken:
        raise typer.Exit(1)


@app.command()
@in_one_line
def export(
    source: Annotated[Path, typer.Argument(help="run of train.py whose training has ended, or zip that CRCSAC has saved")],
    output: Annotated[Path, typer.Argument(help="policy.sb3crc, or a program for other runtimes: policy.onnx, policy.pt2")],
) -> None:
    """Write a policy as safetensors and JSON, which can be read without trust; the zip that it comes from cannot."""
    from sb3_crc import CRCSAC
    from sb3_crc.experiments.runs import Run
    from sb3_crc.export import ENVIRONMENT_ARGUMENTS, export_policy
    from sb3_crc.programs import ONNX, TORCH, export_program

    about: dict[str, Any] = {}
    if source.is_dir():
        run = Run(source)
        source = run.model
        if not source.exists():
            raise FileNotFoundError(f"{run.folder} has no final policy: its training has not ended")
        env_kwargs = {name: value for name, value in run.env_kwargs.items() if name in ENVIRONMENT_ARGUMENTS}
        about = {"task": run.task, "env_kwargs": env_kwargs}
    model = CRCSAC.load(source, device="cpu")
    program = output.suffix in (ONNX, TORCH)
    written = export_program(model, output) if program else export_policy(model, output, **about)
    say(f"{written}: {written.stat().st_size / 1e6:.1f} MB")


@app.command()
@in_one_line
def enjoy(
    policy: Annotated[Path, typer.Argument(help="file of `sb3-crc export`, of anyone")],
    task: Annotated[str | None, typer.Option(help="domain-task, if the file does not say")] = None,
    episodes: Annotated[int, typer.Option(min=1, help="how many")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="of the environment")] = 0,
    film: Annotated[Path | None, typer.Option(help="mp4 file to write, of one more episode")] = None,
) -> None:
    """Let an exported policy act by its mean action: print its returns, film it."""
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    from sb3_crc.analysis.films import film as record
    from sb3_crc.envs.dmc import make_dmc
    from sb3_crc.export import environment_of, load_policy

    acting = load_policy(policy)
    found, env_kwargs = environment_of(policy) if task is None else (task, {})
    env = make_vec_env(lambda: make_dmc(found, seed=seed, **env_kwargs), seed=seed)
    returns, _ = evaluate_policy(acting, env, n_eval_episodes=episodes, return_episode_rewards=True)
    assert isinstance(returns, list)
    for episode, value in enumerate(returns):
        say(f"{found}, episode {episode}: {value:.1f}")
    if film is not None:
        say(f"{film}: {record(acting, env, film):.1f}")
    env.close()


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
        say(str(error), errors)
        raise typer.Exit(2) from None
    say(f"pictures are drawn by {outcome.backend}: {outcome.renderer}")


@app.command()
def baselines(
    task: Annotated[str, typer.Argument(help="domain-task, for instance cartpole-swingup")],
    output: Annotated[Path | None, typer.Option(help="JSON file to write; else the result is printed")] = None,
    episodes: Annotated[int, typer.Option(min=2, help="of each policy")] = 20,
    action_repeat: Annotated[int | None, typer.Option(min=1, help="the task's own if not given")] = None,
    seed: int = 0,
) -> None:
    """Measure the returns of the random and of the zero policy."""
    from sb3_crc.experiments.baselines import measure_baselines

    measured = measure_baselines(task, episodes=episodes, action_repeat=action_repeat, seed=seed)
    _show(measured, output)


@app.command()
def ladder(
    rung: Annotated[
        str,
        typer.Argument(
            help="state: SAC from states; seen: SAC from positions as an encoder could see them; probe: an untrained encoder; "
            "teach: a taught one; overfit: each loss"
        ),
    ],
    task: Annotated[str, typer.Argument(help="domain-task")] = "cartpole-swingup",
    output: Annotated[Path | None, typer.Option(help="JSON file to write; else the result is printed")] = None,
    config: Annotated[Path, typer.Option(help="rl-zoo file whose policy_kwargs are used")] = Path("zoo_configs/laptop.yml"),
    reward_scale: Annotated[float, typer.Option(help="factor on the rewards, rung state")] = 1.0,
    error: Annotated[list[float] | None, typer.Option(help="of what is read off a frame, in metres, rung seen")] = None,
    n_steps: Annotated[list[int] | None, typer.Option(help="of the returns, rung seen")] = None,
    target_entropy: Annotated[float, typer.Option(help="of the policy, rung seen")] = -1.0,
    falling_rates: Annotated[bool, typer.Option("--falling-rates", help="learning rates that end at 0, rung seen")] = False,
    agent_steps: Annotated[int, typer.Option(min=600, help="of each training, rung seen")] = 7_500,
    evaluations: Annotated[int, typer.Option(min=1, help="of each training, rung seen")] = 6,
    seed: int = 0,
) -> None:
    """Measure what must work before learning from pixels can."""
    import yaml

    from sb3_crc.experiments import ladder as rungs

    policy_kwargs = yaml.safe_load(config.read_text())["default"]["policy_kwargs"]
    if rung == "state":
        measured: object = rungs.state_sac(task, reward_scale=reward_scale, seed=seed)
    elif rung == "seen":
        shared: dict[str, Any] = {"target_entropy": target_entropy, "falling_rates": falling_rates}
        shared |= {"agent_steps": agent_steps, "evaluations": evaluations, "seed": seed}
        measured = [
            rungs.seen_state_sac(task, error=one, n_steps=steps, **shared)
            for one in error or [0.0]
            for steps in n_steps or [1]
        ]
    elif rung == "probe":
        measured = rungs.probe_random_encoder(task, policy_kwargs["features_extractor_kwargs"], seed=seed)
    elif rung == "teach":
        measured = rungs.teach_encoder(task, policy_kwargs["features_extractor_kwargs"], seed=seed)
    elif rung == "overfit":
        measured = [
            rungs.overfit_one_batch(task, name, policy_kwargs, objective_kwargs=own, seed=seed)
            for name, own in rungs.OVERFITTED
        ]
    else:
        raise typer.BadParameter(f"{rung!r} is none of state, seen, probe, teach, overfit")
    _show(measured, output)


@app.command()
def trials(
    runs: Annotated[list[Path], typer.Argument(help="folders of runs, <logs>/<algo>/<env>_<number>")],
    output: Annotated[Path, typer.Option(help="CSV file to write into")] = Path("trials.csv"),
    episodes: Annotated[int, typer.Option(min=0, help="fresh ones for the final policy of each finished run")] = 10,
    note: Annotated[str, typer.Option(help="why it was tried, or why it was stopped")] = "",
) -> None:
    """Write runs into a table of trials: settings, curve, final return, time."""
    from sb3_crc.experiments.trials import record_trials

    for row in record_trials(runs, output, episodes=episodes, note=note):
        say(f"{row['trial']}: {row.get('final_mean', 'not finished')}")


@app.command()
def curve(
    runs: Annotated[list[Path], typer.Argument(help="folders of runs, <method>/<run>, each with its evaluations.npz")],
    output: Annotated[Path, typer.Option(help="picture to write")] = Path("learning_curve.png"),
    action_repeat: Annotated[int, typer.Option(min=1, help="environment steps per agent step of that run")] = 1,
    baselines: Annotated[Path | None, typer.Option(help="JSON of `baselines`, drawn as lines")] = None,
    title: str = "",
) -> None:
    """Draw the learning curve of a run, or those of several methods and seeds, beside policies that have learned nothing."""
    from sb3_crc.experiments.curves import plot_learning_curve, plot_learning_curves

    measured = {} if baselines is None else json.loads(baselines.read_text())
    references = {f"{name} policy": policy["mean"] for name, policy in measured.items()}
    files = [run / "evaluations.npz" for run in runs]
    if len(files) == 1:
        plot_learning_curve(files[0], output, action_repeat=action_repeat, title=title, references=references)
        return
    methods: dict[str, list[Path]] = {}
    for file in files:
        methods.setdefault(file.parent.parent.name, []).append(file)
    plot_learning_curves(methods, output, action_repeat=action_repeat, title=title, references=references)


def _show(measured: object, output: Path | None) -> None:
    if output is None:
        console.print_json(data=measured)
    else:
        output.write_text(json.dumps(measured, indent=2) + "\n")
