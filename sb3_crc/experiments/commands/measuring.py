"""Commands that measure what a task allows before anything is trained: ``sb3-crc baselines | landmarks | ladder``."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from sb3_crc import completion
from sb3_crc.command import Group, as_json, command
from sb3_crc.console import say
from sb3_crc.settings import check_name

app = typer.Typer()

LAPTOP = Path("zoo_configs/laptop.yml")
RUNGS = ("state", "screen", "seen", "probe", "teach", "overfit")
#: Options that only some rungs have
OWN_OPTIONS = {
    "--config": ("screen", "probe", "teach", "overfit"),
    "--set": ("screen", "teach"),
    "--policy": ("teach",),
    "--reward-scale": ("state",),
    "--error": ("seen",),
    "--n-steps": ("seen",),
    "--target-entropy": ("seen",),
    "--falling-rates": ("seen",),
    "--agent-steps": ("seen",),
    "--evaluations": ("seen", "screen"),
}


@command(app, Group.TASKS, "sb3-crc baselines cartpole-swingup --episodes 5", "sb3-crc baselines walker-walk --json")
def baselines(
    task: Annotated[str, typer.Argument(help="domain-task, for instance cartpole-swingup.", autocompletion=completion.tasks)],
    output: Annotated[Path | None, typer.Option(help="JSON file to write too, for `sb3-crc curve --baselines`.")] = None,
    episodes: Annotated[int, typer.Option(min=2, help="Episodes of each policy.")] = 20,
    action_repeat: Annotated[
        int | None, typer.Option(min=1, help="Environment steps per agent step; else the task's own.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of initial states and random actions.")] = 0,
) -> object:
    """Measure the returns of the random and of the zero policy."""
    from sb3_crc.experiments.baselines import measure_baselines

    measured = measure_baselines(task, episodes=episodes, action_repeat=action_repeat, seed=seed)
    for name, policy in measured.items():
        say(f"{task}, {name} policy: {policy['mean']:.1f} ± {policy['std']:.1f} ({len(policy['returns'])} episodes)")
    _keep(measured, output)
    return measured


@command(app, Group.TASKS, "sb3-crc landmarks --task cartpole-swingup --task walker-walk -o landmarks.json")
def landmarks(
    task: Annotated[
        list[str] | None,
        typer.Option(help="domain-task; once for each; else the paper's ten.", autocompletion=completion.tasks),
    ] = None,
    episodes: Annotated[int, typer.Option(min=1, help="Episodes of each policy on each task.")] = 10,
    output: Annotated[Path, typer.Option("--output", "-o", help="JSON file to write.")] = Path("landmarks.json"),
) -> object:
    """Measure what random actions and no actions get, on the episodes of final scores."""
    from sb3_crc.envs.tasks import PAPER_TASKS
    from sb3_crc.experiments.baselines import measure_landmarks
    from sb3_crc.experiments.runs import write_json

    found = measure_landmarks(task or PAPER_TASKS, episodes=episodes)
    write_json(found, output)
    for name, policies in found["returns"].items():
        say(f"{name}: {', '.join(f'{policy} {sum(own) / len(own):.1f}' for policy, own in policies.items())}")
    return found


@command(
    app,
    Group.TASKS,
    "sb3-crc ladder probe cartpole-swingup",
    "sb3-crc ladder seen --error 0.03 --n-steps 1 --n-steps 3 --output seen_3cm.json",
    'sb3-crc ladder teach --set "strides=[2, 2, 1, 1]" --policy policy.sb3crc',
    "sb3-crc ladder screen finger-spin --set n_steps=1 --set reward_scale=1 --evaluations 10",
)
def ladder(
    rung: Annotated[
        str,
        typer.Argument(
            help="state: SAC from states; screen: the same with a configuration's settings; seen: SAC from positions as an "
            "encoder could see them; probe: an untrained encoder; teach: a taught one; overfit: each loss.",
            autocompletion=completion.one_of(*RUNGS),
        ),
    ],
    task: Annotated[str, typer.Argument(help="domain-task.", autocompletion=completion.tasks)] = "cartpole-swingup",
    output: Annotated[Path | None, typer.Option(help="JSON file to write too.")] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            help="Configuration of rl-zoo: its policy_kwargs in rungs probe, teach, overfit, its settings in screen; else "
            f"{LAPTOP}."
        ),
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", help="name=value: another setting, rung screen, or argument of the encoder, rung teach."),
    ] = None,
    policy: Annotated[
        Path | None,
        typer.Option(help="Exported policy that leads to the frames, with random actions between its own, rung teach."),
    ] = None,
    reward_scale: Annotated[float | None, typer.Option(help="Factor on the rewards, rung state; else 1.")] = None,
    error: Annotated[
        list[float] | None, typer.Option(help="Of what is read off a frame, in metres, rung seen; once for each; else 0.")
    ] = None,
    n_steps: Annotated[
        list[int] | None, typer.Option(help="Agent steps of the n-step return, rung seen; once for each; else 1.")
    ] = None,
    target_entropy: Annotated[float | None, typer.Option(help="Of the policy, in nats, rung seen; else -1.")] = None,
    falling_rates: Annotated[bool, typer.Option("--falling-rates", help="Learning rates that end at 0, rung seen.")] = False,
    agent_steps: Annotated[
        int | None, typer.Option(min=600, help="Budget of each training in agent steps, rung seen; else 7500.")
    ] = None,
    evaluations: Annotated[
        int | None, typer.Option(min=1, help="How many in each training: rung seen, else 6; rung screen, else 10.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of everything.")] = 0,
) -> object:
    """Measure what must work before learning from pixels can."""
    if rung not in RUNGS:
        raise typer.BadParameter(f"{rung!r} is none of {', '.join(RUNGS)}", param_hint="RUNG")
    own: dict[str, Any] = {"reward_scale": reward_scale, "target_entropy": target_entropy, "agent_steps": agent_steps}
    own |= {"falling_rates": falling_rates or None, "evaluations": evaluations}
    own = {name: value for name, value in own.items() if value is not None}
    _check_options(rung, {**own, "config": config, "set": changes, "error": error, "n_steps": n_steps, "policy": policy})
    config = config or LAPTOP
    policy_kwargs = _policy_kwargs(config, task) if rung in ("probe", "teach", "overfit") else {}
    encoder_kwargs = policy_kwargs.get("features_extractor_kwargs") or {}
    from sb3_crc.experiments import ladder as rungs

    if rung == "state":
        measured: Any = rungs.state_sac(task, seed=seed, **own)
    elif rung == "screen":
        measured = _screened(config, task, changes or [], seed=seed, **own)
    elif rung == "seen":
        measured = [
            rungs.seen_state_sac(task, error=one, n_steps=steps, seed=seed, **own)
            for one in error or [0.0]
            for steps in n_steps or [1]
        ]
    elif rung == "probe":
        measured = rungs.probe_random_encoder(task, encoder_kwargs, seed=seed)
    elif rung == "teach":
        from sb3_crc.export import ENCODER_ARGUMENTS

        encoder = {**encoder_kwargs, **_changes(changes, ENCODER_ARGUMENTS)}
        measured = rungs.teach_encoder(task, encoder, policy=policy, seed=seed)
    else:
        measured = [
            rungs.overfit_one_batch(task, name, policy_kwargs, objective_kwargs=settings, seed=seed)
            for name, settings in rungs.OVERFITTED
        ]
    for name, value in _flat(measured):
        say(f"{name}: {value}")
    _keep(measured, output)
    return measured


def _check_options(rung: str, given: Mapping[str, Any]) -> None:
    """:raises BadParameter: for an option that the rung would not heed"""
    for name, value in given.items():
        option = f"--{name.replace('_', '-')}"
        if value not in (None, []) and rung not in OWN_OPTIONS[option]:
            raise typer.BadParameter(f"{option} is an option of {' and '.join(OWN_OPTIONS[option])}; this is rung {rung}")


def _screened(config: Path, task: str, changes: list[str], **own: Any) -> Mapping[str, Any]:
    from sb3_crc.configurations import read_settings, with_overrides
    from sb3_crc.envs.tasks import environment_id
    from sb3_crc.experiments.screening import USED, screened_state_sac

    settings = with_overrides(read_settings(config, "rad", environment_id(task)), _changes(changes, USED))
    return screened_state_sac(task, settings, **own)


def _changes(changes: list[str] | None, allowed: Sequence[str]) -> dict[str, Any]:
    import yaml

    values = {}
    for change in changes or []:
        name, equals, value = change.partition("=")
        if not (name and equals):
            raise typer.BadParameter(f"{change!r} is not name=value", param_hint="--set")
        check_name("--set", name, allowed)
        values[name] = yaml.safe_load(value)
    return values


def _policy_kwargs(config: Path, task: str) -> Mapping[str, Any]:
    from sb3_crc.configurations import read_settings
    from sb3_crc.envs.tasks import environment_id

    found = read_settings(config, "crc", environment_id(task)).get("policy_kwargs")
    if not isinstance(found, Mapping):
        raise ValueError(f"{config} has no policy_kwargs for {task}")
    return found


def _flat(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Numbers and names one by one, each with where it stands."""
    if isinstance(value, Mapping):
        inside = value.items()
    elif isinstance(value, list | tuple) and any(isinstance(one, Mapping) for one in value):
        inside = dict(enumerate(value)).items()
    else:
        yield name, value
        return
    for key, one in inside:
        yield from _flat(one, f"{name}.{key}" if name else str(key))


def _keep(measured: object, output: Path | None) -> None:
    if output is not None:
        output.write_text(as_json(measured) + "\n", encoding="utf-8")
