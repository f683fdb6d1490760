"""The page that describes a shared policy: README.md of a repository on the Hugging Face Hub, and the metadata in it.

Every number on it is read from the run's files. What is not there is called so: a policy without ``final.json`` is "not
evaluated", and the Hub is told no score.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import yaml

from sb3_crc.experiments.runs import FINAL, PROVENANCE, Run
from sb3_crc.export import ENVIRONMENT_ARGUMENTS
from sb3_crc.presets import PRESETS

POLICY, FILM, CURVE, SETTINGS = "policy.sb3crc", "replay.mp4", "learning_curve.png", "config.yml"
PAPER = "https://arxiv.org/abs/2301.13473"
#: What else is in such a repository -> what it is
OTHER_FILES = {
    SETTINGS: "settings, a configuration of the RL Zoo",
    "args.yml": "which algorithm, task, seed and budget",
    "env_kwargs.yml": "of the environment",
    "train_eval_metrics.zip": "training episodes, evaluations during training, the log",
    FINAL: "the evaluation above, with machine and versions",
    PROVENANCE: "machine, versions and revision of the training",
}


def model_card(run: Run, repo_id: str, files: Mapping[str, str | float], *, agent_steps: int) -> str:
    """
    :param run: one that has ended
    :param repo_id: ``user/name``, where it will be
    :param agent_steps: that its policy has learned from
    :param files: names of what lies beside the page -> what there is to say of it; of ``replay.mp4`` the return of its episode
    :return: Markdown, with a YAML header
    """
    final = run.final
    header = yaml.safe_dump(_metadata(run, final), sort_keys=False, allow_unicode=True)
    sections = [
        f"---\n{header}---",
        f"# {run.preset} on {run.arguments['env']}",
        f"{_what_it_is(run)} {_how_long(run, agent_steps)}",
        "## Score",
        *_score(run, final, files),
        "## Use it",
        *_usage(run, repo_id, files),
        "## Train it again",
        *_training(run),
        "## Files",
        "\n".join(["| file | |", "|---|---|", *(f"| `{name}` | {said} |" for name, said in _said_of(files).items())]),
    ]
    return "\n\n".join(sections) + "\n"


def score(returns: list[float]) -> str:
    """:return: mean and standard deviation, as the Hub's tables of RL models have them"""
    return f"{np.mean(returns):.2f} +/- {np.std(returns):.2f}"


def environment_arguments(run: Run) -> dict[str, Any]:
    """:return: arguments of :func:`~sb3_crc.make_dmc` with which a shared policy acts"""
    return {name: value for name, value in run.env_kwargs.items() if name in ENVIRONMENT_ARGUMENTS}


def _metadata(run: Run, final: Mapping[str, Any] | None) -> dict[str, Any]:
    env_id = run.arguments["env"]
    tags = [env_id, "deep-reinforcement-learning", "reinforcement-learning", "stable-baselines3", "sb3_crc"]
    metadata: dict[str, Any] = {"library_name": "stable-baselines3", "pipeline_tag": "reinforcement-learning", "tags": tags}
    if final is not None:
        name = "reinforcement-learning"
        result = {
            "task": {"type": name, "name": name},
            "dataset": {"type": env_id, "name": env_id},
            "metrics": [{"type": "mean_reward", "value": score(final["returns"]), "name": "mean_reward", "verified": False}],
        }
        metadata["model-index"] = [{"name": run.preset, "results": [result]}]
    return metadata


def _what_it_is(run: Run) -> str:
    sees = {"state": "states", "dict": "pixels and states"}.get(str(run.env_kwargs.get("observation")), "pixels")
    if run.preset not in PRESETS:
        return f"Stock SAC of Stable-Baselines3 (`--algo {run.preset}` of sb3_crc), trained from {sees}."
    objectives = run.settings.get("objectives", PRESETS[run.preset]["objectives"])
    terms = ", ".join(f"{name} ({_weight(setting):.3g})" for name, setting in objectives.items())
    return (
        f"A policy of `CRCSAC`, trained from {sees} with the preset `{run.preset}` of sb3_crc, an extension of "
        f"[Stable-Baselines3](https://github.com/DLR-RM/stable-baselines3). Auxiliary objectives of the encoder, with their "
        f"weights: {terms or 'none'} ([CRC-RL]({PAPER}))."
    )


def _how_long(run: Run, agent_steps: int) -> str:
    done = agent_steps * run.action_repeat
    asked = "" if done == run.budget else f"; it was meant for {run.budget:,}"
    return f"It has seen {done:,} environment steps ({agent_steps:,} decisions){asked}. The seed was {run.seed}."


def _weight(setting: Any) -> float:
    return float(setting["weight"] if isinstance(setting, Mapping) else setting)


def _score(run: Run, final: Mapping[str, Any] | None, files: Mapping[str, str | float]) -> list[str]:
    paragraphs = []
    if final is None:
        paragraphs.append(
            "**Not evaluated.** Nobody has measured what the final policy is worth (`sb3-crc evaluate RUN` does). Evaluations "
            "during training, where there are some, are no substitute: settings and moments may have been chosen by them."
        )
    else:
        returns = final["returns"]
        paragraphs.append(
            f"**{score(returns)}**: mean and standard deviation of the undiscounted returns of {len(returns)} fresh "
            f"episode{'s' * (len(returns) > 1)}, {', '.join(f'{value:.1f}' for value in returns)}. The mean action of the "
            f"final policy was taken, the policy after exactly {final['environment_steps']:,} environment steps and "
            f"{final['updates']:,} updates, never the best of several checkpoints. The environment's seed was "
            f"{final['first_seed']}. This is one training: another seed gives another policy with another score."
        )
    if run.env_kwargs.get("render_quality") == "fast":
        paragraphs.append("Pictures are drawn with `render_quality='fast'`: the score cannot be compared with published ones.")
    if FILM in files:
        paragraphs.append(f"The film, `{FILM}`, shows one episode of the final policy, with a return of {files[FILM]:.1f}.")
    if CURVE in files:
        episodes = run.arguments.get("eval_episodes")
        each = f" ({episodes} episodes each)" if episodes else ""
        paragraphs.append(f"![Evaluations during training]({CURVE})\n\nEvaluations during training{each}.")
    return paragraphs


def _usage(run: Run, repo_id: str, files: Mapping[str, str | float]) -> list[str]:
    paragraphs = []
    if POLICY in files and run.is_of_suite:
        arguments = "".join(f", {name}={value!r}" for name, value in environment_arguments(run).items())
        paragraphs += [
            f"With sb3_crc installed. `{POLICY}` holds numbers and a description, and reading it executes nothing, so nobody "
            "has to be trusted:",
            f"""```python
from huggingface_hub import hf_hub_download
from sb3_crc import load_policy, make_dmc

policy = load_policy(hf_hub_download({repo_id!r}, {POLICY!r}))
env = make_dmc({run.task!r}{arguments})
observation, _ = env.reset(seed=0)
score, ended = 0.0, False
while not ended:
    action, _ = policy.predict(observation, deterministic=True)
    observation, reward, terminated, truncated, _ = env.step(action)
    score, ended = score + float(reward), terminated or truncated
print(score)
```""",
            f"In a shell: `sb3-crc enjoy {POLICY} --film film.mp4`. `load_weights(model, {POLICY!r})` goes on with it.",
        ]
    owner, _, name = repo_id.partition("/")
    flags = f"--algo {run.preset} --env {run.arguments['env']} -f logs"
    paragraphs += [
        "As a run of the RL Zoo, with optimizers. **SB3's zips may hold pickles, which are programs: do this only if you "
        "trust whoever made them.**",
        f"""```console
TRUST_REMOTE_CODE=True python -m sb3_crc.zoo load_from_hub {flags} -orga {owner} -name {name}
python -m sb3_crc.zoo enjoy {flags}
```""",
    ]
    return paragraphs


def _training(run: Run) -> list[str]:
    steps = int(run.arguments["n_timesteps"])
    flags = f"--conf-file settings.yml --seed {run.seed}" + (f" -n {steps}" if steps > 0 else "")
    settings = yaml.safe_dump({"default": run.settings}, sort_keys=False, default_flow_style=None, width=120)
    paragraphs = [
        f"Settings, to be saved as `settings.yml`; `n_timesteps` counts decisions of {run.action_repeat} environment steps "
        "each, and what is not named is the preset's:",
        f"```yaml\n{settings}```",
        f"```console\npython train.py --algo {run.preset} --env {run.arguments['env']} {flags}\n```",
    ]
    if made := run.distinct("versions"):
        versions = ", then ".join(", ".join(f"{name} {version}" for name, version in one.items()) for one in made)
        machines = [one["gpu"] or f"{one['processor']}, {one['threads']} thread(s)" for one in run.distinct("machine")]
        revisions = ", then ".join(run.distinct("git_revision"))
        revision = f", revision {revisions}" if revisions else ""
        device = ", then ".join(dict.fromkeys(machines))
        paragraphs.append(f"Trained on {run.distinct('time')[0][:10]} on {device}, with {versions}{revision}.")
    else:
        paragraphs.append("Machine and versions of the training were not recorded.")
    return paragraphs


def _said_of(files: Mapping[str, str | float]) -> dict[str, str]:
    fixed = {
        POLICY: "encoder, actor and Q networks, as safetensors and JSON",
        FILM: "one episode",
        CURVE: "evaluations during training",
        **OTHER_FILES,
    }
    return {name: fixed.get(name, str(said)) for name, said in files.items()}
