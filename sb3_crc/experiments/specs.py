"""What a comparison consists of: runs, each described completely before it begins and named by its content.

A sweep file names variants, and what each changes in the configuration of its preset::

    env_steps: 100_000
    eval_every: 5_000            # environment steps between two evaluations
    tasks: [cartpole-swingup]
    seeds: 3                     # 0, 1, 2; or a list
    variants:
      C+R+C: {preset: crc}
      C+R: {preset: crc, objectives.consistency: null}      # a dotted key reaches into a mapping, null removes
"""

import hashlib
import inspect
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import yaml
from stable_baselines3 import SAC

from sb3_crc.configurations import configuration_file, read_settings, shipped, with_overrides
from sb3_crc.crc_sac import CRCSAC
from sb3_crc.envs.tasks import default_action_repeat, environment_id, split_task
from sb3_crc.evaluation import FIRST_SEED as FIRST_EVALUATION
from sb3_crc.experiments.final import FIRST_SEED as FIRST_FINAL
from sb3_crc.presets import PRESETS
from sb3_crc.settings import check_name
from sb3_crc.stock import STOCK

#: Settings of a configuration that are rl_zoo3's, not the algorithm's
ZOO_SETTINGS = {"n_timesteps", "env_kwargs", "n_envs", "callback"}
#: Seeds that no training may have: the first, the last (None: there is none), and of what
EVALUATION_SEEDS: tuple[tuple[int, int | None, str], ...] = (
    (FIRST_FINAL, FIRST_FINAL + 99, "evaluations of final policies"),
    (FIRST_EVALUATION, None, "evaluations during training, of analyses and of trials"),
)
#: Key of a sweep -> of which type it must be, and that in words
SWEEP_KEYS: dict[str, tuple[Any, str]] = {
    "tasks": (list, "a list of domain-task"),
    "seeds": (int | list, "a number of trainings, or a list of whole numbers"),
    "env_steps": (int, "a whole number"),
    "eval_every": (int, "a whole number"),
    "eval_episodes": (int, "a whole number"),
    "variants": (dict, "a mapping from names to changes"),
    "conf_file": (str | Path, "a path"),
}


class _UniqueKeys(yaml.SafeLoader):
    """Of two variants of one name YAML itself would silently drop the first."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        _check_unique(f"keys{node.start_mark}", [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)])
        return super().construct_mapping(node, deep)


@dataclass(frozen=True)
class RunSpec:
    """
    One training, and how it is evaluated.

    :param method: what it is called in tables
    :param preset: ``--algo`` of train.py
    :param task: domain-task
    :param seed: of the training
    :param env_steps: the budget in environment steps, random ones and repeats included
    :param eval_every: environment steps between two evaluations of the current policy
    :param eval_episodes: of each of them, and of the final policy
    :param settings: of rl_zoo3 for this environment, complete
    :raises ValueError: if steps are no multiple of the action repeat, or the budget none of a rollout; if the seed is negative
        (rl_zoo3 would draw one) or an evaluation's (:data:`EVALUATION_SEEDS`), or a setting does not exist or cannot work
    """

    method: str
    preset: str
    task: str
    seed: int
    env_steps: int
    eval_every: int
    eval_episodes: int
    settings: Mapping[str, Any]

    def __post_init__(self) -> None:
        repeat = self.action_repeat
        for name in ("env_steps", "eval_every"):
            value = getattr(self, name)
            if value < 1 or value % repeat != 0:
                raise ValueError(
                    f"{self.method} on {self.task}: {name}={value} must be a positive multiple of the action repeat, {repeat}"
                )
        for name, least in (("eval_episodes", 1), ("seed", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{self.method} on {self.task}: {name}={getattr(self, name)} must be at least {least}")
        learning_starts = self.settings.get("learning_starts", 0)
        if self.agent_steps <= learning_starts:
            raise ValueError(
                f"{self.method} on {self.task}: {self.env_steps} environment steps are {self.agent_steps} agent steps; with "
                f"learning_starts={learning_starts} nothing would be learned"
            )
        self._check_rollouts()
        self._check_seeds()
        algorithm = CRCSAC if self.preset in PRESETS else SAC
        known = {*inspect.signature(SAC.__init__).parameters, *inspect.signature(algorithm.__init__).parameters}
        for name in self.settings:
            check_name(f"{self.method}: setting", name, sorted((known | ZOO_SETTINGS) - {"self", "env", "kwargs"}))

    def _check_rollouts(self) -> None:
        """Training ends where a rollout does, and only a policy after exactly the budget is scored."""
        where, train_freq = f"{self.method} on {self.task}", self.settings.get("train_freq", 1)
        frequency, unit = train_freq if isinstance(train_freq, list | tuple) else (train_freq, "step")
        n_envs = self.settings.get("n_envs", 1)
        if unit != "step":
            raise ValueError(f"{where}: train_freq={train_freq!r} would not end after exactly the budget; it must count steps")
        for name, value in (("train_freq", frequency), ("n_envs", n_envs)):
            if type(value) is not int or value < 1:
                raise ValueError(f"{where}: {name}={value!r} must be a whole number, at least 1")
        if self.agent_steps % (frequency * n_envs) != 0:
            raise ValueError(
                f"{where}: {self.env_steps} environment steps are {self.agent_steps} agent steps, no multiple of "
                f"n_envs={n_envs} times train_freq={frequency}; training would not end after exactly the budget"
            )

    def _check_seeds(self) -> None:
        """Environment k of a training has its seed + k."""
        seeds = range(self.seed, self.seed + self.settings.get("n_envs", 1))
        for first, last, what in EVALUATION_SEEDS:
            if seeds[-1] >= first and (last is None or seeds[0] <= last):
                kept = f"{first} and above" if last is None else f"{first} to {last}"
                raise ValueError(
                    f"{self.method} on {self.task}: seed={self.seed} meets those of {what}, {kept}: choose another"
                )

    @property
    def action_repeat(self) -> int:
        """Environment steps per agent step."""
        return _action_repeat(self.task, self.settings)

    @property
    def agent_steps(self) -> int:
        """The budget in decisions."""
        return self.env_steps // self.action_repeat

    @property
    def name(self) -> str:
        """Relative path of its folder; it ends with a digest of everything that decides what the run will be."""
        content = {name: value for name, value in asdict(self).items() if name != "method"}
        digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:8]
        return f"{self.task}/{self.method}/seed_{self.seed}-{digest}"


def compared(
    presets: Sequence[str],
    tasks: Sequence[str],
    seeds: Sequence[int],
    *,
    env_steps: int,
    eval_every: int | None = None,
    eval_episodes: int = 10,
    conf_file: Path | None = None,
) -> list[RunSpec]:
    """
    :param presets: presets or stock algorithms; each is its own method
    :param tasks: domain-task, or the whole ids of such
    :param seeds: of the trainings; the same for all methods
    :param env_steps: see :class:`RunSpec`
    :param eval_every: see there; None: a twentieth of the budget, in whole agent steps
    :param eval_episodes: see there
    :param conf_file: configuration of all of them; None: each preset's own file
    :return: a run for each of task, seed and preset, in this order, so that what is compared comes together
    :raises ValueError: for unknown names or values that cannot work, before anything runs
    """
    _check_unique("presets", presets)
    return _grid(
        {preset: {"preset": preset} for preset in presets},
        tasks,
        seeds,
        env_steps=env_steps,
        eval_every=eval_every,
        eval_episodes=eval_episodes,
        conf_file=conf_file,
    )


def read_sweep(file: Path, **overrides: Any) -> list[RunSpec]:
    """
    :param file: as described at the top of this module; ``conf_file`` in it is relative to it
    :param overrides: keys of it that count instead; None: the file's
    :return: a run for each of task, seed and variant
    :raises FileNotFoundError: if it is missing
    :raises ValueError: naming file and key, for what is no sweep
    """
    file = shipped(file)
    try:
        content = yaml.load(file.read_text(encoding="utf-8"), _UniqueKeys)  # a SafeLoader
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{file} cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{file} is no sweep: it must be a mapping with {', '.join(sorted(SWEEP_KEYS))}")
    content |= {name: value for name, value in overrides.items() if value is not None}
    for key in content:
        check_name(f"{file}: key", key, sorted(SWEEP_KEYS))
    if lacking := sorted({"tasks", "seeds", "env_steps", "variants"} - content.keys()):
        raise ValueError(f"{file} is no sweep: it has no {', '.join(lacking)}")
    _check_types(file, content)
    seeds = content["seeds"]
    conf_file = content.get("conf_file")
    return _grid(
        content["variants"],
        content["tasks"],
        range(seeds) if isinstance(seeds, int) else seeds,
        env_steps=content["env_steps"],
        eval_every=content.get("eval_every"),
        eval_episodes=content.get("eval_episodes", 10),
        conf_file=None if conf_file is None else file.parent / conf_file,
    )


def _check_types(file: Path, content: Mapping[str, Any]) -> None:
    """:raises ValueError: naming file and key, for what is of another type than a sweep's"""
    for key, value in content.items():
        kind, words = SWEEP_KEYS[key]
        if not isinstance(value, kind) or isinstance(value, bool):
            raise ValueError(f"{file}: {key} must be {words}; it is {value!r}")
    for method, changes in content["variants"].items():
        if not isinstance(method, str) or not isinstance(changes, dict | None):
            raise ValueError(f"{file}: variants.{method} must be a mapping of changes with a name; it is {changes!r}")
    for key, kind in (("tasks", str), ("seeds", int)):
        wrong = [one for one in content[key] if type(one) is not kind] if isinstance(content[key], list) else []
        if wrong:
            raise ValueError(f"{file}: {key} must be {SWEEP_KEYS[key][1]}; {wrong[0]!r} is among them")


def _check_unique(name: str, values: Sequence[Any]) -> None:
    """:raises ValueError: naming what is there twice"""
    twice = [value for place, value in enumerate(values) if value in values[:place]]
    if twice:
        raise ValueError(f"{name}: {twice[0]!r} is there twice")


def _action_repeat(task: str, settings: Mapping[str, Any]) -> int:
    own = (settings.get("env_kwargs") or {}).get("action_repeat")
    return int(own or default_action_repeat(task))


def _grid(
    variants: Mapping[str, Mapping[str, Any]],
    tasks: Iterable[str],
    seeds: Iterable[int],
    *,
    env_steps: int,
    eval_every: int | None,
    eval_episodes: int,
    conf_file: Path | None,
) -> list[RunSpec]:
    tasks, seeds = ["-".join(split_task(task)) for task in tasks], list(seeds)  # an unknown task is refused before all else
    named: dict[str, Sequence[Any]] = {"tasks": tasks, "seeds": seeds, "variants": list(variants)}
    for name, values in named.items():
        if not values:
            raise ValueError(f"{name} is empty: there is nothing to run")
        _check_unique(name, values)
    resolved = {}
    for method, changes in variants.items():
        if not str(method).strip(" .") or set(str(method)) & set("/\\\0"):
            raise ValueError(f"variant {method!r}: its name becomes that of a folder, so there can be no slash in it")
        overrides = dict(changes or {})
        preset = overrides.pop("preset", method)
        check_name(f"preset of {method!r}", preset, [*PRESETS, *STOCK])
        file = configuration_file(preset) if conf_file is None else conf_file
        for task in tasks:
            settings = read_settings(file, preset, environment_id(task))
            if preset in PRESETS:  # written out, so that overrides find what they change and later defaults change nothing
                settings = {**PRESETS[preset], **settings}
            settings = with_overrides(settings, overrides)
            settings.pop("n_timesteps", None)  # the budget decides
            repeat = _action_repeat(task, settings)
            every = max(1, env_steps // repeat // 20) * repeat if eval_every is None else eval_every
            resolved[method, task] = preset, every, settings
    return [
        RunSpec(method, preset, task, seed, env_steps, every, eval_episodes, settings)
        for task in tasks
        for seed in seeds
        for method in variants
        for preset, every, settings in [resolved[method, task]]
    ]
