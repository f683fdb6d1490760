"""The command line, ``sb3-crc`` or ``python -m sb3_crc``: what works here, measurements, comparisons, analyses.

Training is ``train.py``. Modules that take long to import are imported by the commands that need them.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sb3_crc import completion
from sb3_crc.analysis.commands import app as analysis
from sb3_crc.command import Group, No, Program, command, require
from sb3_crc.console import errors, say, show, tell
from sb3_crc.experiments.commands import app as experiments

if TYPE_CHECKING:
    from sb3_crc.doctor import Finding

HELP = """\
CRC-RL for Stable-Baselines3: SAC from pixels with contrastive, reconstruction and consistency losses.

Begin with `sb3-crc doctor`, then `make train`, which two processor cores can do, or, with a GPU and the paper's settings,

\b
  python train.py --algo crc --env dmc_pixels/cartpole-swingup-v0

and look at it with `sb3-crc report logs`. The help of each command ends with an example."""
EPILOG = """\
Every command takes --json: one JSON document on stdout, all else on stderr.

Exit codes: 0 fine; 1 the answer is no, or work failed; 2 wrong usage or input; 130 Ctrl-C; 143 SIGTERM.

README.md and docs/command_line.md say more."""

app = typer.Typer(cls=Program, no_args_is_help=True, help=HELP, epilog=EPILOG, pretty_exceptions_enable=False)
app.add_typer(experiments)
app.add_typer(analysis)

MARKS = {"ok": "[green]ok[/]", "note": "[yellow]note[/]", "broken": "[red]broken[/]"}


def _version(wanted: bool) -> None:
    if wanted:
        from sb3_crc import __version__

        say(f"sb3-crc {__version__}")
        raise typer.Exit


@app.callback()
def program(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """See :data:`HELP`."""


@command(app, Group.MACHINE, "sb3-crc doctor", "sb3-crc doctor --json > machine.json")
def doctor() -> object:
    """Show what works on this machine; exit code 1 if something essential does not."""
    from rich.markup import escape
    from rich.table import Table

    from sb3_crc.doctor import examine

    table = Table(title="sb3_crc doctor", title_justify="left")
    for column in ("", "", "found", ""):
        table.add_column(column, overflow="fold")
    findings: list[Finding] = []
    with errors.status("drawing a few frames"):
        for finding in examine():
            begins = not findings or findings[-1].topic != finding.topic
            if begins and findings:
                table.add_section()
            topic = finding.topic if begins else ""
            table.add_row(topic, finding.name, escape(finding.value), MARKS[finding.verdict])
            findings.append(finding)
    show(table)
    broken = [finding for finding in findings if finding.verdict == "broken"]
    for finding in broken:  # once more outside the table, where a command that is to be copied stays on one line
        tell(f"{finding.name}: {finding.value}")
    document = {"works": not broken, "findings": findings}
    return No(document) if broken else document


@command(app, Group.MACHINE, "sb3-crc rendering")
def rendering(
    install: Annotated[
        bool,
        typer.Option("--install", help="Install the missing system library as root in a container, or if AUTO_APT=1 or CI=1."),
    ] = False,
) -> object:
    """Print the OpenGL back end that draws without a display; exit code 1 and what mends it if there is none."""
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
        tell(str(error))
        return No({"backend": None, "renderer": None, "reason": str(error)})
    say(f"pictures are drawn by {outcome.backend}: {outcome.renderer}")
    return {"backend": outcome.backend, "renderer": outcome.renderer, "reason": None}


@command(
    app,
    Group.SHARE,
    "sb3-crc export logs/crc/dmc_pixels-cartpole-swingup-v0_1 policy.sb3crc",
    "sb3-crc export logs/crc/dmc_pixels-cartpole-swingup-v0_1 policy.onnx",
)
def export(
    source: Annotated[
        Path,
        typer.Argument(
            help="Run of train.py whose training has ended, or zip that CRCSAC has saved.", autocompletion=completion.runs
        ),
    ],
    output: Annotated[
        Path, typer.Argument(help="File to write: policy.sb3crc, or a program for other runtimes: policy.onnx, policy.pt2.")
    ],
) -> object:
    """Write a policy as safetensors and JSON, which can be read without trust; the zip that it comes from cannot."""
    from sb3_crc import CRCSAC
    from sb3_crc.experiments.model_card import environment_arguments
    from sb3_crc.experiments.runs import Run
    from sb3_crc.export import export_policy
    from sb3_crc.programs import ONNX, TORCH, export_program

    about: dict[str, Any] = {}
    if source.is_dir():
        run = Run(source)
        source = run.model
        if not source.exists():
            raise FileNotFoundError(f"{run.folder} has no final policy: its training has not ended")
        about = {"task": run.task, "env_kwargs": environment_arguments(run)}
    model = CRCSAC.load(source, device="cpu")
    program = output.suffix in (ONNX, TORCH)
    written = export_program(model, output) if program else export_policy(model, output, **about)
    say(f"{written}: {written.stat().st_size / 1e6:.1f} MB")
    return {"file": written, "bytes": written.stat().st_size}


@command(
    app,
    Group.SHARE,
    "sb3-crc enjoy results/laptop/cartpole-swingup/policy.sb3crc",
    "sb3-crc enjoy policy.sb3crc --film policy.mp4",
)
def enjoy(
    policy: Annotated[Path, typer.Argument(help="File of `sb3-crc export`, of anyone.")],
    task: Annotated[
        str | None,
        typer.Option(help="domain-task, seen as the file says; else the file's own.", autocompletion=completion.tasks),
    ] = None,
    episodes: Annotated[int, typer.Option(min=1, help="How many.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Of the environment.")] = 0,
    film: Annotated[Path | None, typer.Option(help="mp4 file to write, of one more episode; else none.")] = None,
) -> object:
    """Let an exported policy act by its mean action: print its returns, film it."""
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.utils import check_for_correct_spaces

    from sb3_crc.analysis.films import film as record
    from sb3_crc.envs.dmc import make_dmc
    from sb3_crc.export import load_policy

    if film is not None:
        require("video", "av")
    acting = load_policy(policy)
    found, env_kwargs = _stage(policy, task)
    env = make_vec_env(lambda: make_dmc(found, seed=seed, **env_kwargs), seed=seed)
    check_for_correct_spaces(env, acting.observation_space, acting.action_space)  # dm_control would repeat a lone action
    returns, _ = evaluate_policy(acting, env, n_eval_episodes=episodes, return_episode_rewards=True)
    assert isinstance(returns, list)
    for episode, value in enumerate(returns):
        say(f"{found}, episode {episode}: {value:.1f}")
    document: dict[str, Any] = {"task": found, "seed": seed, "returns": returns, "film": film, "film_return": None}
    if film is not None:
        document["film_return"] = record(acting, env, film)
        say(f"{film}: {document['film_return']:.1f}")
    env.close()
    return document


def _stage(policy: Path, task: str | None) -> tuple[str, dict[str, Any]]:
    """
    Where an exported policy acts: in another task, too, it sees and decides as in its own.

    :return: task, and arguments of make_dmc
    """
    from sb3_crc.envs.tasks import NAMESPACE, default_action_repeat, task_names
    from sb3_crc.export import PolicyFileError, environment_of

    try:
        own, env_kwargs = environment_of(policy)
    except PolicyFileError:
        if task is None:
            raise
        return task, {}
    if task is None and "/" in own and not own.startswith(f"{NAMESPACE}/"):
        raise ValueError(
            f"{policy} acts in {own!r}, which is no task of dm_control: load it in Python (sb3_crc.load_policy), with an "
            "environment of yours, or name a task by --task"
        )
    if task is None:
        return own, env_kwargs
    repeat = {"action_repeat": default_action_repeat(own)} if own in task_names() else {}
    return task, {**repeat, **env_kwargs}
