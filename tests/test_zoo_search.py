"""-optimize: what is drawn, what is kept of the configuration, what a study leaves, and two workers on one storage."""

import multiprocessing
import subprocess
import sys
from argparse import Namespace
from pathlib import Path
from typing import Any

import gymnasium as gym
import optuna
import pandas as pd
import pytest
import rl_zoo3.hyperparams_opt
import yaml

from sb3_crc import CRCSAC, PRESETS
from sb3_crc.zoo import CRCExperimentManager, register
from sb3_crc.zoo.manager import prepare_storage
from sb3_crc.zoo.search import constructor_arguments, sample
from tests.conftest import POLICY_KWARGS, NoiseEnv
from tests.test_zoo import ROOT, environment

BALANCE = "dmc_pixels/cartpole-balance-v0"
SHIFT = {"augmentation": "random_shift", "objectives": {}}


def drawn(configuration: dict[str, Any], n_envs: int = 1) -> tuple[dict[str, Any], optuna.trial.FrozenTrial]:
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    trial = study.ask()
    arguments = sample(configuration, trial, 1, n_envs, {"using_her_replay_buffer": False, "her_kwargs": {}})
    study.tell(trial, 0.0)
    return arguments, study.trials[0]


@pytest.mark.parametrize("preset", PRESETS)
def test_what_is_drawn_builds_and_keeps_the_preset(preset: str) -> None:
    register()
    sampler = rl_zoo3.hyperparams_opt.HYPERPARAMS_SAMPLER[preset]
    trial = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=1)).ask()
    arguments = sampler(trial, 2, 1, {"using_her_replay_buffer": False, "her_kwargs": {}})
    assert rl_zoo3.hyperparams_opt.HYPERPARAMS_CONVERTER[preset](trial.params) == arguments
    assert trial.user_attrs == {"arguments": arguments}
    own = PRESETS[preset].get("policy_kwargs", {})
    model = rl_zoo3.ALGOS[preset]("CnnPolicy", NoiseEnv(), policy_kwargs={**own, **POLICY_KWARGS}, **arguments)
    for name, value in {**PRESETS[preset], "policy_kwargs": {**own, **POLICY_KWARGS}, **arguments}.items():
        assert getattr(model, name) == value, name
    assert set(model.objectives) == set(PRESETS[preset]["objectives"])


def test_weights_sum_to_one_and_the_objectives_keep_their_settings() -> None:
    arguments, _ = drawn(PRESETS["crc_release"])
    before, after = PRESETS["crc_release"]["objectives"], arguments["objectives"]
    assert sum(setting["weight"] for setting in after.values()) == pytest.approx(1)
    assert all(after[name]["weight"] != before[name]["weight"] for name in before)
    assert {name: {**setting, "weight": 0} for name, setting in after.items()} == {
        name: {**setting, "weight": 0} for name, setting in before.items()
    }
    plain = drawn(PRESETS["crc"])[0]["objectives"]
    assert isinstance(plain["contrastive"], float) and plain["consistency"]["reduction"] == "mean"


@pytest.mark.parametrize(
    ("configuration", "names"),
    [
        (PRESETS["rad"], {"replay_ratio"}),
        (PRESETS["curl"], {"replay_ratio", "encoder_learning_rate"}),  # of a single weight Adam sees nothing
        ({**PRESETS["curl"], "joint_update": True}, {"replay_ratio"}),
        (SHIFT, {"replay_ratio", "pad"}),
        ({**PRESETS["rad"], "train_freq": (1, "episode")}, set()),
        (
            PRESETS["crc"],
            {"replay_ratio", "encoder_learning_rate", *(f"share_{name}" for name in PRESETS["crc"]["objectives"])},
        ),
    ],
)
def test_only_what_has_an_effect_is_drawn(configuration: dict[str, Any], names: set[str]) -> None:
    always = {"learning_rate", "batch_size_pow", "tau", "encoder_tau", "one_minus_gamma"}
    assert set(drawn(configuration)[1].params) == always | names


def test_the_replay_ratio_counts_updates_per_decision() -> None:
    arguments, trial = drawn({**PRESETS["rad"], "train_freq": 5}, n_envs=4)
    assert arguments["gradient_steps"] == trial.params["replay_ratio"] * 5 * 4
    configuration = {**PRESETS["rad"], "train_freq": [5, "step"], "n_envs": 2}
    assert constructor_arguments(configuration, trial.params)["gradient_steps"] == trial.params["replay_ratio"] * 10


def test_converted_numbers() -> None:
    parameters = {"batch_size_pow": 7, "one_minus_gamma": 0.02, "pad": 3, "tau": 0.1}
    configuration = {**SHIFT, "augmentation_kwargs": {"pad": 8, "other": 1}}
    assert constructor_arguments(configuration, parameters) == {
        "batch_size": 128,
        "gamma": 0.98,
        "tau": 0.1,
        "augmentation_kwargs": {"pad": 3, "other": 1},
    }


@pytest.mark.parametrize(("learning_starts", "largest"), [(1_000, 9), (300, 8), (20, 4)])
def test_no_batch_is_larger_than_what_is_stored_by_then(learning_starts: int, largest: int) -> None:
    distribution = drawn({**PRESETS["rad"], "learning_starts": learning_starts})[1].distributions["batch_size_pow"]
    assert isinstance(distribution, optuna.distributions.IntDistribution)
    assert (distribution.low, distribution.high) == (min(6, largest), largest)


# -- The manager, on an environment of noise ---------------------------------------------------------------------------

NOISE = "SearchedNoise-v0"
CONFIGURATION = {
    "n_timesteps": 30,
    "policy": "CnnPolicy",
    "env_kwargs": {"size": 36},
    "learning_starts": 20,
    "buffer_size": 100,
    "augmentation": "random_shift",
    "policy_kwargs": POLICY_KWARGS,
    "objectives": {"contrastive": 0.5, "consistency": {"weight": 0.5, "reduction": "mean"}},
}


@pytest.fixture
def manager(tmp_path: Path) -> Any:
    register()
    if NOISE not in gym.registry:
        gym.register(NOISE, entry_point=NoiseEnv)
    (tmp_path / "config.yml").write_text(yaml.safe_dump({NOISE: CONFIGURATION}))

    def make(**kwargs: Any) -> CRCExperimentManager:
        settings = {"config": str(tmp_path / "config.yml"), "verbose": 0, "device": "cpu", "seed": 0, **kwargs}
        return CRCExperimentManager(Namespace(), "crc", NOISE, str(tmp_path / "logs"), **settings)

    return make


def search(manager: CRCExperimentManager) -> None:
    assert manager.setup_experiment() is None
    manager.hyperparameters_optimization()


def test_a_search_keeps_the_configuration_and_leaves_a_usable_best_trial(
    manager: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    built = []
    learn = CRCSAC.learn

    def spy(self: CRCSAC, *args: Any, **kwargs: Any) -> CRCSAC:
        evaluation = kwargs["callback"][-1].eval_env
        built.append((self, evaluation.observation_space))
        return learn(self, *args, **kwargs)

    monkeypatch.setattr(CRCSAC, "learn", spy)
    search(manager(optimize_hyperparameters=True, n_trials=2, n_evaluations=1, n_eval_episodes=1, pruner="none"))
    assert len(built) == 2
    for model, evaluated in built:
        assert model.policy_kwargs == POLICY_KWARGS
        assert model.objectives["consistency"]["reduction"] == "mean"
        assert model.objectives["contrastive"] + model.objectives["consistency"]["weight"] == pytest.approx(1)
        assert model.observation_space == evaluated and evaluated.shape == (9, 36, 36)

    folder = tmp_path / "logs" / "crc"
    best = yaml.safe_load((folder / f"best_{NOISE}.yml").read_text())[NOISE]
    (report,) = folder.glob("report_*.csv")
    trials = pd.read_csv(report)
    assert len(trials) == 2
    row = trials.loc[trials["value"].idxmax()]
    assert best["learning_rate"] == pytest.approx(row["params_learning_rate"])
    assert best["gradient_steps"] == row["params_replay_ratio"]
    assert best["n_timesteps"] == 30 and best["env_kwargs"] == {"size": 36} and best["policy_kwargs"] == POLICY_KWARGS
    again = manager(config=str(folder / f"best_{NOISE}.yml"), eval_freq=-1)
    model, _ = again.setup_experiment()
    assert (model.objectives, model.tau) == (best["objectives"], best["tau"])


def test_a_search_in_which_every_trial_fails_ends_with_a_sentence(
    manager: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def diverge(*args: Any, **kwargs: Any) -> None:
        raise FloatingPointError("train/critic_loss is nan")

    monkeypatch.setattr(CRCSAC, "learn", diverge)
    search(manager(optimize_hyperparameters=True, n_trials=2, n_evaluations=1))
    assert "No trial was completed" in capsys.readouterr().out
    assert not list((tmp_path / "logs" / "crc").glob("best_*"))


def test_a_trial_of_a_study_replaces_what_it_drew_and_nothing_else(manager: Any, tmp_path: Path) -> None:
    storage = f"sqlite:///{tmp_path}/study.db"
    parameters = {"tau": 0.03, "batch_size_pow": 4, "one_minus_gamma": 0.1, "share_contrastive": 0.1, "share_consistency": 0.3}
    study = optuna.create_study(storage=storage, study_name="s")
    distributions = {
        name: optuna.distributions.IntDistribution(0, 9)
        if name == "batch_size_pow"
        else optuna.distributions.FloatDistribution(0, 1)
        for name in parameters
    }
    study.add_trial(optuna.trial.create_trial(params=parameters, distributions=distributions, value=0.0))
    chosen = manager(storage=storage, study_name="s", trial_id=0, hyperparams={"tau": 0.5})
    for settings in chosen.read_hyperparameters():
        assert settings["objectives"] == {
            "contrastive": pytest.approx(0.25),
            "consistency": {"weight": pytest.approx(0.75), "reduction": "mean"},
        }
        assert settings["tau"] == 0.5  # -params wins
        assert settings["gamma"] == 0.9
        assert settings["policy_kwargs"] == POLICY_KWARGS


def test_storages_that_are_no_files_are_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for storage in (None, "sqlite://", "sqlite:///:memory:", "study.log"):
        prepare_storage(storage)
    assert not list(tmp_path.iterdir())
    prepare_storage("sqlite:///deep/study.db?timeout=30")
    assert (tmp_path / "deep" / "study.db").exists()


def test_workers_that_start_together_find_the_tables_of_sqlite(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    start = context.Barrier(4)

    def work() -> None:
        start.wait()
        prepare_storage(f"sqlite:///{tmp_path}/study.db")

    workers = [context.Process(target=work) for _ in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(60)
    assert [worker.exitcode for worker in workers] == [0, 0, 0, 0]


# -- The command -------------------------------------------------------------------------------------------------------


def optimize(folder: Path, *flags: str) -> list[str]:
    settings = ["--conf-file", str(ROOT / "tests" / "tiny.yml"), "-f", str(folder), "--device", "cpu", "--verbose", "0"]
    evaluation = ["--eval-episodes", "1", "--pruner", "none"]
    command = [sys.executable, "-m", "sb3_crc.zoo", "train", "--algo", "crc", "--env", BALANCE, "-optimize"]
    return [*command, *settings, *evaluation, *flags]


@pytest.mark.slow
@pytest.mark.parametrize("storage", ["sqlite:///{}/study.db", "{}/study.log"])
def test_two_workers_share_a_study(storage: str, tmp_path: Path) -> None:
    url = storage.format(tmp_path)
    flags = ["--n-trials", "2", "--storage", url, "--study-name", "shared"]
    command = optimize(tmp_path, *flags)
    workers = [
        subprocess.Popen(command, cwd=ROOT, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    for worker in workers:
        output, errors = worker.communicate(timeout=300)
        assert worker.returncode == 0, errors[-2000:]
        assert "Best trial:" in output
    opened: Any = url
    if url.endswith(".log"):
        opened = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(url))
    study = optuna.load_study(study_name="shared", storage=opened)
    assert [trial.state.name for trial in study.trials] == 4 * ["COMPLETE"]
    assert all(trial.user_attrs["arguments"]["objectives"] for trial in study.trials)
    configuration = yaml.safe_load((tmp_path / "crc" / "best_shared.yml").read_text())[BALANCE]
    assert configuration["learning_rate"] in [trial.params["learning_rate"] for trial in study.trials]
    assert configuration["env_kwargs"]["action_repeat"] == 40
