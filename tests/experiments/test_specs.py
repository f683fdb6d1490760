"""What a comparison consists of."""

from pathlib import Path

import pytest
import yaml

from sb3_crc import PRESETS
from sb3_crc.configurations import CONFIGS
from sb3_crc.experiments.specs import compared, read_sweep
from sb3_crc.objectives import objective_weights

LAPTOP = CONFIGS / "laptop.yml"
SWEEP = """
env_steps: 16000
eval_every: 8000
tasks: [cartpole-swingup]
seeds: [3, 5]
conf_file: own.yml
variants:
  rad: {}
  half: {preset: crc, objectives.contrastive.weight: 0.5, env_kwargs.render_quality: fast}
"""
OWN = """
default:
  policy: CnnPolicy
  env_kwargs: {image_size: 36}
  presets:
    crc: {objectives: {contrastive: 0.7, reconstruction: {weight: 0.3, bits: 5}}}
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "own.yml").write_text(OWN)
    (tmp_path / "sweep.yml").write_text(SWEEP)
    return tmp_path / "sweep.yml"


def test_the_same_seeds_and_steps_for_all_and_what_is_compared_comes_together() -> None:
    methods, tasks = ["crc", "rad", "sac"], ["cartpole-swingup", "walker-walk"]
    specs = compared(methods, tasks, [4, 7], env_steps=8_000, eval_every=1_600, conf_file=LAPTOP)
    assert [(spec.task, spec.seed, spec.method) for spec in specs] == [
        (task, seed, method) for task in tasks for seed in (4, 7) for method in methods
    ]
    assert {spec.agent_steps for spec in specs if spec.task == "cartpole-swingup"} == {1_000}
    assert {spec.agent_steps for spec in specs if spec.task == "walker-walk"} == {4_000}
    assert len({spec.name for spec in specs}) == 12


def test_a_preset_brings_what_the_file_leaves_open() -> None:
    curl, sac = compared(["curl", "sac"], ["cartpole-swingup"], [0], env_steps=8_000, eval_every=800, conf_file=LAPTOP)
    assert curl.settings["objectives"] == PRESETS["curl"]["objectives"]
    assert curl.settings["augmentation"] == "random_shift"
    assert "objectives" not in sac.settings and sac.settings["env_kwargs"] == curl.settings["env_kwargs"]


def test_a_name_says_everything_that_decides_what_comes_out() -> None:
    common = {"env_steps": 16_000, "eval_every": 800, "conf_file": LAPTOP}
    (spec,) = compared(["rad"], ["cartpole-swingup"], [0], **common)
    assert spec.name == compared(["rad"], ["cartpole-swingup"], [0], **common)[0].name
    others = [
        compared(["rad"], ["cartpole-swingup"], [1], **common),
        compared(["rad"], ["cartpole-swingup"], [0], **{**common, "env_steps": 24_000}),
        compared(["rad"], ["cartpole-swingup"], [0], **{**common, "eval_every": 1_600}),
        compared(["rad"], ["cartpole-swingup"], [0], **common, eval_episodes=3),
        compared(["rad"], ["cartpole-swingup"], [0], **{**common, "conf_file": None}),
    ]
    assert spec.name not in {other.name for (other,) in others}


def test_a_sweep_reaches_into_settings(file: Path) -> None:
    specs = read_sweep(file)
    assert [(spec.method, spec.seed) for spec in specs] == [("rad", 3), ("half", 3), ("rad", 5), ("half", 5)]
    half = specs[1].settings
    assert half["objectives"] == {"contrastive": {"weight": 0.5}, "reconstruction": {"weight": 0.3, "bits": 5}}
    assert half["env_kwargs"] == {"image_size": 36, "render_quality": "fast"}
    assert specs[0].settings["env_kwargs"] == {"image_size": 36}, "variants must not share what they change"
    assert [spec.seed for spec in read_sweep(file, seeds=1)] == [0, 0]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("rad: {}", "red: {}", "preset of 'red'"),
        ("rad: {}", "rad: {learning_rat: 1}", "learning_rat"),
        ("env_steps: 16000", "env_steps: 16001", "env_steps=16001 must be a positive multiple of the action repeat, 8"),
        ("eval_every: 8000", "eval_every: 4", "eval_every=4 must be"),
        ("tasks: [cartpole-swingup]", "tasks: []", "tasks is empty"),
        ("tasks: [cartpole-swingup]", "task: cartpole-swingup", "key"),
        ("seeds: [3, 5]", "", "has no seeds"),
        ("env_kwargs.render_quality: fast", "learning_starts: 2000", "nothing would be learned"),
        ("seeds: [3, 5]", "seeds: [-1]", "seed=-1 must be at least 0"),
        ("seeds: [3, 5]", "seeds: [10099]", "seed=10099 meets those of evaluations of final policies, 10000 to 10099"),
        ("seeds: [3, 5]", "seeds: [20100]", "seed=20100 meets those of evaluations during training, .*, 20000 and above"),
        ("rad: {}", "rad: {train_freq: 3}", "are 2000 agent steps, no multiple of n_envs=1 times train_freq=3"),
        (
            "rad: {}",
            "rad: {n_envs: 16, train_freq: [3, step]}",
            "2000 agent steps, no multiple of n_envs=16 times train_freq=3",
        ),
        ("rad: {}", "rad: {train_freq: [1, episode]}", r"train_freq=\[1, 'episode'\] would not end after exactly the budget"),
        ("rad: {}", "rad: {n_envs: 0}", "n_envs=0 must be a whole number, at least 1"),
        ("tasks: [cartpole-swingup]", "tasks: [cartpole-swngup]", "Did you mean 'cartpole-swingup'"),
    ],
)
def test_mistakes_are_named_before_anything_runs(file: Path, old: str, new: str, message: str) -> None:
    assert old in SWEEP
    file.write_text(SWEEP.replace(old, new))
    with pytest.raises(ValueError, match=message):
        read_sweep(file)


def test_rollouts_that_end_with_the_budget_and_seeds_beside_those_of_evaluations_pass(file: Path) -> None:
    new = SWEEP.replace("seeds: [3, 5]", "seeds: [9984, 10100]").replace("rad: {}", "rad: {n_envs: 16, train_freq: [5, step]}")
    file.write_text(new)
    assert [spec.settings.get("n_envs") for spec in read_sweep(file)] == [16, None, 16, None]
    file.write_text(new.replace("9984", "9985"))
    with pytest.raises(
        ValueError, match="rad on cartpole-swingup: seed=9985 meets those of"
    ):  # its last environment has 10 000
        read_sweep(file)


@pytest.mark.parametrize("conf_file", [None, LAPTOP, Path("nowhere.yml")])
def test_an_unknown_task_is_refused_before_all_else(conf_file: Path | None) -> None:
    """Also where the configuration names an action repeat, so that the task's own is not asked for, or cannot be read."""
    with pytest.raises(ValueError, match=r"Unknown task 'walker-wlk'.*only stand, walk, run\. Did you mean 'walker-walk'"):
        compared(["crc"], ["cartpole-swingup", "walker-wlk"], [0], env_steps=8_000, conf_file=conf_file)
    with pytest.raises(ValueError, match="there is no domain 'pole'; the domains are acrobot"):
        compared(["crc"], ["pole-swingup"], [0], env_steps=8_000, conf_file=conf_file)


def test_a_task_may_be_named_by_its_id() -> None:
    by_id, by_name = (
        compared(["crc"], [task], [0], env_steps=8_000, conf_file=LAPTOP)
        for task in ("dmc_pixels/walker-walk-v0", "walker-walk")
    )
    assert by_id == by_name
    with pytest.raises(ValueError, match="tasks: 'walker-walk' is there twice"):
        compared(["crc"], ["walker-walk", "dmc_pixels/walker-walk-v0"], [0], env_steps=8_000, conf_file=LAPTOP)


def test_by_default_there_are_twenty_evaluations_at_whole_agent_steps(file: Path) -> None:
    specs = compared(["rad"], ["cartpole-swingup", "walker-walk"], [0], env_steps=10_000, conf_file=LAPTOP)
    assert [spec.eval_every for spec in specs] == [496, 500]  # 62 decisions of 8 steps, 250 of 2
    file.write_text(
        SWEEP.replace("eval_every: 8000", "").replace("env_kwargs.render_quality: fast", "env_kwargs.action_repeat: 5")
    )
    assert {spec.method: spec.eval_every for spec in read_sweep(file)} == {"rad": 800, "half": 800}
    assert {spec.eval_every for spec in read_sweep(file, env_steps=8_040)} == {400}


@pytest.mark.parametrize(
    ("addition", "message"),
    [
        ("variants: {crc: {}, rad: {}, crc: {batch_size: 8}}", "'crc' is there twice"),
        ("tasks: [walker-walk, walker-walk]", "tasks: 'walker-walk' is there twice"),
        ("seeds: [0, 1, 0]", "seeds: 0 is there twice"),
        ("variants: {a/b: {preset: crc}}", "'a/b': its name becomes that of a folder"),
        ("variants: {..: {preset: crc}}", "'..': its name becomes that of a folder"),
    ],
)
def test_names_that_would_hide_runs(tmp_path: Path, addition: str, message: str) -> None:
    lines = {"env_steps": "1600", "tasks": "[cartpole-swingup]", "seeds": "1", "variants": "{crc: {}}"}
    key, _, value = addition.partition(": ")
    path = tmp_path / "sweep.yml"
    path.write_text("".join(f"{name}: {own}\n" for name, own in {**lines, key: value}.items()))
    with pytest.raises(ValueError, match=message):
        read_sweep(path)
    with pytest.raises(ValueError, match="presets: 'crc' is there twice"):
        compared(["crc", "rad", "crc"], ["cartpole-swingup"], [0], env_steps=1600, eval_every=800)


def test_the_ablations_of_the_paper() -> None:
    for configuration in (None, LAPTOP):
        first = read_sweep(CONFIGS / "sweeps" / "ablation_1.yml", conf_file=configuration)
        losses = {spec.method: "".join(sorted(name[2] for name in spec.settings["objectives"])) for spec in first}
        # n: contrastive and consistency, c: reconstruction
        assert losses == {
            "none": "",
            "contrastive": "n",
            "contrastive+reconstruction": "cn",
            "all-three": "cnn",
            "all-but-contrastive": "cn",
            "all-but-reconstruction": "nn",
        }
        assert len({spec.name for spec in first}) == 18
        (everything,) = (spec for spec in first if spec.method == "all-three" and spec.seed == 0)
        (crc,) = compared(["crc"], ["cartpole-swingup"], [0], env_steps=100_000, eval_every=5_000, conf_file=configuration)
        assert everything.settings == crc.settings


def test_the_generalisation_ablation_of_the_paper() -> None:
    for configuration in (None, LAPTOP):
        specs = read_sweep(CONFIGS / "sweeps" / "ablation_3.yml", conf_file=configuration)
        assert len({spec.name for spec in specs}) == 4 * 4 * 3
        for spec in specs:
            (watched,) = spec.settings["callback"]
            assert next(iter(watched.values()))["modes"] == ["video_easy", "color_hard"]
            assert spec.settings["augmentation"] == "random_crop"
        weights = {spec.method: objective_weights(spec.settings["objectives"]) for spec in specs}
        assert weights["0-100-0"] == {"reconstruction": 1.0}
        assert set(weights) == {"33-33-33", "100-0-0", "0-100-0", "0-0-100"}


def test_sweep_files_are_plain_yaml() -> None:
    for path in (CONFIGS / "sweeps").glob("*.yml"):
        assert isinstance(yaml.safe_load(path.read_text()), dict)
