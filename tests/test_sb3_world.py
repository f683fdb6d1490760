"""CRCSAC where Stable-Baselines3's users put it: callbacks, wrappers, loggers, files."""

import csv
import inspect
import json
import math
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_crc import CRCSAC, PRESETS, CRCPolicy, PixelEncoder
from tests.conftest import POLICY_KWARGS, NoiseEnv, make_model

ROOT = Path(__file__).parent.parent
SMALL = ("batch_size", "buffer_size", "learning_starts", "initial_updates")  # what would take long
FORMS: dict[str, dict[str, Any]] = {
    **{
        name: {
            **{key: value for key, value in preset.items() if key not in SMALL},
            "policy_kwargs": {**preset.get("policy_kwargs", {}), **POLICY_KWARGS},
        }
        for name, preset in PRESETS.items()
    },
    "n_steps": {"n_steps": 3},
    "fixed temperature": {"ent_coef": 0.2},
    "schedules": {"learning_rate": "lin_0.001", "encoder_learning_rate": "lin_0.002", "ent_coef_learning_rate": None},
    "normalised": {"policy_kwargs": {**POLICY_KWARGS, "layer_norm": True, "actor_features": "latent"}, "reward_scale": 3.0},
    "shift": {"augmentation": "random_shift", "max_grad_norm": 0.1, "policy_delay": 3, "target_update_interval": 3},
}


@pytest.fixture(scope="module")
def observations() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (5, 9, 40, 40), dtype=np.uint8)


def optimizers(model: SAC) -> dict[str, th.optim.Optimizer]:
    """Every optimizer that the model or a module of its policy holds, wherever it is kept."""

    def search() -> Iterator[tuple[str, th.optim.Optimizer]]:
        for owner, kept in [("model", vars(model)), *((name, vars(module)) for name, module in model.policy.named_modules())]:
            for name, value in kept.items():
                for key, one in value.items() if isinstance(value, dict) else [("", value)]:
                    if isinstance(one, th.optim.Optimizer):
                        yield f"{owner}.{name}.{key}", one

    return dict(search())


def flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    if isinstance(tree, dict | list | tuple):
        pairs = tree.items() if isinstance(tree, dict) else enumerate(tree)
        return {name: value for key, branch in pairs for name, value in flat(branch, f"{prefix}/{key}").items()}
    return {prefix: tree}


def state(model: CRCSAC) -> dict[str, Any]:
    """All that training changes: networks with their buffers, optimizers, temperature, counters."""
    own = {
        "policy": model.policy.state_dict(),
        "optimizers": {name: optimizer.state_dict() for name, optimizer in optimizers(model).items()},
        "temperature": model._temperature(),
        "counters": [model._n_updates, model.num_timesteps, model._episode_num, model._current_progress_remaining],
    }
    return {name: value.clone() if isinstance(value, th.Tensor) else value for name, value in flat(own).items()}


def differences(first: dict[str, Any], second: dict[str, Any]) -> list[str]:
    """Names whose values are not equal bit for bit."""
    common = first.keys() & second.keys()
    unequal = (
        name
        for name in common
        if not (th.equal(first[name], second[name]) if isinstance(first[name], th.Tensor) else first[name] == second[name])
    )
    return sorted([*(first.keys() ^ second.keys()), *unequal])


def train_on(model: CRCSAC, seed: int, updates: int = 5) -> None:
    """Updates on batches, crops and actions that the seed decides."""
    np.random.seed(seed)
    th.manual_seed(seed)
    model.train(gradient_steps=updates, batch_size=16)


# -- Save and load -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
def test_training_goes_on_bit_for_bit_after_load(form: str, tmp_path: Path, observations: np.ndarray) -> None:
    model = make_model(**FORMS[form])
    model._current_progress_remaining = 0.5
    train_on(model, seed=1)  # an odd number: the delays of policy and targets must go on where they were
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "buffer.pkl")

    loaded = CRCSAC.load(tmp_path / "model.zip", device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer.pkl")
    loaded.set_logger(model.logger)
    assert differences(state(model), state(loaded)) == []
    predictions = [m.predict(observations, deterministic=True)[0] for m in (model, loaded)]
    assert np.array_equal(*predictions)

    before = state(model)
    for continued in (model, loaded):
        train_on(continued, seed=2)
    assert differences(state(model), state(loaded)) == []
    moved = differences(before, state(model))
    assert any("critic_target" in name for name in moved) and any("exp_avg" in name for name in moved)


def test_arguments_from_yaml_are_taken_again_by_load(tmp_path: Path, observations: np.ndarray) -> None:
    settings = yaml.safe_load("""
        learning_rate: lin_0.001
        encoder_learning_rate: 0.0005
        objectives: {contrastive: 0.5, consistency: {weight: 0.5, reduction: mean}}
        image_size: [36, 34]
        ent_coef: auto_0.2
        target_entropy: auto
        train_freq: 2
        policy_kwargs:
          net_arch: [32, 32]
          log_std_bounds: [-5, 2]
          features_extractor_kwargs: {channels: [8, 8], strides: [2, 2], features_dim: 16, latent_activation: tanh}
    """)
    model = make_model(**settings)
    train_on(model, seed=1)
    model.save(tmp_path / "model.zip")
    loaded = CRCSAC.load(tmp_path / "model.zip", env=NoiseEnv(), **settings)
    assert differences(state(model), state(loaded)) == []
    predictions = [m.predict(observations, deterministic=True)[0] for m in (model, loaded)]
    assert np.array_equal(*predictions)

    changed = CRCSAC.load(tmp_path / "model.zip", gamma=0.5, batch_size=7, learning_rate=0.25)
    assert (changed.gamma, changed.batch_size, changed.lr_schedule(0.5)) == (0.5, 7, 0.25)
    with pytest.raises(ValueError, match="policy kwargs"):
        CRCSAC.load(tmp_path / "model.zip", policy_kwargs={"net_arch": [16]})


def test_load_takes_other_n_step_returns(tmp_path: Path) -> None:
    """What SB3 derives from ``n_steps`` and ``gamma`` must not survive them."""
    make_model(n_steps=3).save(tmp_path / "model.zip")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = CRCSAC.load(tmp_path / "model.zip", env=NoiseEnv(), gamma=0.5)
        one_step = CRCSAC.load(tmp_path / "model.zip", env=NoiseEnv(), n_steps=1)
    assert (loaded.replay_buffer.n_steps, loaded.replay_buffer.gamma) == (3, 0.5)
    assert getattr(one_step.replay_buffer, "n_steps", 1) == 1


def test_load_refuses_arguments_that_do_not_exist(tmp_path: Path) -> None:
    make_model().save(tmp_path / "model.zip")
    with pytest.raises((TypeError, ValueError), match="learning_rte"):
        CRCSAC.load(tmp_path / "model.zip", learning_rte=0.1)


@pytest.mark.parametrize(
    "device", ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not th.cuda.is_available(), reason="no GPU"))]
)
def test_load_puts_everything_on_the_device(device: str, tmp_path: Path) -> None:
    model = make_model()
    train_on(model, seed=1)
    model.save(tmp_path / "model.zip")
    loaded = CRCSAC.load(tmp_path / "model.zip", env=NoiseEnv(), device=device)
    kept = {
        name: value for name, value in state(loaded).items() if isinstance(value, th.Tensor) and not name.endswith("/step")
    }
    assert {value.device.type for value in kept.values()} == {device}
    assert loaded.replay_buffer.device.type == device
    loaded.learn(45)  # forty steps of warm-up, five updates
    assert loaded._n_updates == 5 + 5


MEASURE = """
import sys
import numpy as np, psutil
from sb3_crc import CRCSAC
small, large = sys.argv[1:]
process = psutil.Process()
CRCSAC.load(small)  # whatever the first load imports
before = process.memory_info().rss
model = CRCSAC.load(large)
model.predict(np.zeros((9, 100, 100), np.uint8))
loaded = process.memory_info().rss
ballast = np.ones(100 * 2**20, np.uint8)
print(model.buffer_size, (loaded - before) / 2**20, (process.memory_info().rss - loaded) / 2**20)
"""


def test_loading_allocates_no_replay_memory(tmp_path: Path) -> None:
    model = make_model(NoiseEnv(size=100))
    model.save(tmp_path / "small.zip")
    model.buffer_size = 100_000  # 18 GB of frames, were they there
    model.save(tmp_path / "large.zip")
    arguments = [sys.executable, "-c", MEASURE, str(tmp_path / "small.zip"), str(tmp_path / "large.zip")]
    run = subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert run.returncode == 0, run.stderr
    buffer_size, growth, ballast = map(float, run.stdout.split())
    assert buffer_size == 100_000
    assert growth < 50
    assert ballast > 90  # the measure sees memory that is used


# -- Files that cannot be loaded ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("saved") / "model.zip"
    make_model().save(path)
    return path


@pytest.mark.parametrize("extractor", [NatureCNN, PixelEncoder])
def test_a_zip_of_stock_sac_is_refused(extractor: type, tmp_path: Path) -> None:
    policy_kwargs = {"net_arch": [8], "features_extractor_class": extractor}
    SAC("CnnPolicy", NoiseEnv(), buffer_size=10, policy_kwargs=policy_kwargs).save(tmp_path / "sac.zip")
    with pytest.raises(ValueError, match=r"sac\.zip.*CRCSAC"):
        CRCSAC.load(tmp_path / "sac.zip")


def test_a_zip_of_another_image_size_is_refused(saved: Path) -> None:
    with pytest.raises(ValueError, match=r"\(9, 40, 40\).*\(9, 48, 48\)"):
        CRCSAC.load(saved, env=NoiseEnv(size=48))
    with pytest.raises(ValueError, match=r"\(9, 40, 40\).*\(9, 48, 48\)"):
        CRCSAC.load(saved).set_env(NoiseEnv(size=48))
    with pytest.raises(ValueError, match=r"\(9, 48, 48\).*\(9, 40, 40\)"):
        CRCSAC.load(saved).predict(np.zeros((9, 48, 48), np.uint8))


@pytest.mark.parametrize("share", [0.0, 0.001, 0.2, 0.5, 0.95, 0.9999])
def test_a_truncated_zip_is_refused(share: float, saved: Path, tmp_path: Path) -> None:
    whole = saved.read_bytes()
    (tmp_path / "truncated.zip").write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match=r"truncated\.zip.*(wasn't a zip-file|not a complete)"):
        CRCSAC.load(tmp_path / "truncated.zip")


def test_a_damaged_zip_is_refused(saved: Path, tmp_path: Path) -> None:
    damaged = bytearray(saved.read_bytes())
    damaged[len(damaged) // 2] ^= 0xFF
    (tmp_path / "damaged.zip").write_bytes(damaged)
    with pytest.raises(ValueError, match=r"damaged\.zip"):
        CRCSAC.load(tmp_path / "damaged.zip")


def test_what_is_no_model_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.zip").write_text("no zip at all")
    with pytest.raises(ValueError, match=r"text\.zip.*wasn't a zip-file"):
        CRCSAC.load(tmp_path / "text.zip")
    with pytest.raises(FileNotFoundError, match=r"absent\.zip'?$"):
        CRCSAC.load(tmp_path / "absent.zip")
    with pytest.raises(FileNotFoundError, match=r"absent"):
        CRCSAC.load(tmp_path / "absent")


# -- Parts of a model --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", PRESETS)
def test_a_policy_saves_and_loads_alone(preset: str, tmp_path: Path, observations: np.ndarray) -> None:
    model = make_model(**FORMS[preset])
    train_on(model, seed=1)
    model.policy.save(tmp_path / "policy.pth")
    loaded = CRCPolicy.load(tmp_path / "policy.pth")
    predictions = [p.predict(observations, deterministic=True)[0] for p in (model.policy, loaded)]
    assert np.array_equal(*predictions)
    assert differences(dict(model.policy.state_dict()), dict(loaded.state_dict())) == []


@pytest.mark.parametrize("preset", PRESETS)
def test_parameters_make_a_round_trip(preset: str, tmp_path: Path) -> None:
    model, other = make_model(**FORMS[preset]), make_model(**FORMS[preset], seed=1)
    train_on(model, seed=1)
    parameters = model.get_parameters()
    kept = {**flat({name: o.state_dict() for name, o in optimizers(model).items()}), **model.policy.state_dict()}
    assert len(flat(parameters)) == len(kept)  # every optimizer is among them

    def compared(m: CRCSAC) -> dict[str, Any]:
        return {name: value for name, value in state(m).items() if name.startswith(("/policy", "/optimizers"))}

    assert differences(compared(model), compared(other)) != []
    other.set_parameters(parameters, exact_match=True)
    assert differences(compared(model), compared(other)) == []
    model.save(tmp_path / "model.zip")
    from_file = make_model(**FORMS[preset], seed=2)
    from_file.set_parameters(tmp_path / "model.zip", exact_match=True)
    assert differences(compared(model), compared(from_file)) == []

    del parameters["critic.optimizer"]
    with pytest.raises(ValueError, match=r"critic\.optimizer"):
        other.set_parameters(parameters, exact_match=True)


def test_a_replay_buffer_is_saved_and_loaded(tmp_path: Path) -> None:
    model = make_model()
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    other = CRCSAC("CnnPolicy", NoiseEnv(), buffer_size=200, policy_kwargs=POLICY_KWARGS)
    assert other.replay_buffer.size() == 0
    other.load_replay_buffer(tmp_path / "buffer.pkl")
    assert other.replay_buffer.size() == 40
    batches = []
    for m in (model, other):
        np.random.seed(3)
        batches.append(m.replay_buffer.sample(16))
    assert all(map(th.equal, batches[0][:5], batches[1][:5]))


# -- Callbacks ---------------------------------------------------------------------------------------------------------


def test_eval_callback_keeps_the_best_model(tmp_path: Path, observations: np.ndarray) -> None:
    model = make_model()
    callback = EvalCallback(
        Monitor(NoiseEnv()), n_eval_episodes=2, eval_freq=4, best_model_save_path=tmp_path, log_path=tmp_path, verbose=0
    )
    predictions: list[np.ndarray] = []

    class Remember(StopTrainingOnRewardThreshold):
        def _on_step(self) -> bool:
            predictions.append(self.model.predict(observations, deterministic=True)[0])
            return True

    callback.callback_on_new_best = Remember(0.0)
    callback.callback_on_new_best.parent = callback
    model.learn(12, callback, reset_num_timesteps=False)
    with np.load(tmp_path / "evaluations.npz") as evaluations:
        assert evaluations["timesteps"].tolist() == [44, 48, 52]
        means = evaluations["results"].mean(axis=1)
    assert len(predictions) == sum(mean > max(means[:index], default=-math.inf) for index, mean in enumerate(means))
    best = CRCSAC.load(tmp_path / "best_model.zip")
    assert best.num_timesteps == 44 + 4 * int(means.argmax())
    assert np.array_equal(best.predict(observations, deterministic=True)[0], predictions[-1])


def test_training_stops_at_the_reward_threshold() -> None:
    for threshold, steps in ((-1e9, 44), (1e9, 50)):
        model = make_model()
        stop = StopTrainingOnRewardThreshold(reward_threshold=threshold, verbose=0)
        model.learn(10, EvalCallback(Monitor(NoiseEnv()), stop, eval_freq=4, verbose=0), reset_num_timesteps=False)
        assert model.num_timesteps == steps


def test_checkpoint_callback_saves_model_and_replay_buffer(tmp_path: Path) -> None:
    model = make_model()
    model.learn(10, CheckpointCallback(5, str(tmp_path), save_replay_buffer=True), reset_num_timesteps=False)
    names = {f"rl_model_{steps}_steps.zip" for steps in (45, 50)}
    names |= {f"rl_model_replay_buffer_{steps}_steps.pkl" for steps in (45, 50)}
    assert {path.name for path in tmp_path.iterdir()} == names

    loaded = CRCSAC.load(tmp_path / "rl_model_45_steps.zip", env=NoiseEnv())
    loaded.load_replay_buffer(tmp_path / "rl_model_replay_buffer_45_steps.pkl")
    assert (loaded.num_timesteps, loaded._n_updates) == (45, 4)  # SB3 calls back before it stores and trains
    assert np.array_equal(loaded.replay_buffer.observations[:44], model.replay_buffer.observations[:44])
    loaded.learn(3, reset_num_timesteps=False)
    assert (loaded.num_timesteps, loaded._n_updates) == (48, 7)


# -- Environments ------------------------------------------------------------------------------------------------------


def test_evaluate_policy_returns_what_an_own_loop_returns() -> None:
    model = make_model()
    venv = DummyVecEnv([lambda: Monitor(NoiseEnv())])
    venv.seed(3)
    rewards, lengths = evaluate_policy(model, venv, n_eval_episodes=2, return_episode_rewards=True)
    env = NoiseEnv()
    expected = []
    for seed in (3, None):
        observation, _ = env.reset(seed=seed)
        total, ended = 0.0, False
        while not ended:
            observation, reward, _, ended, _ = env.step(model.predict(observation, deterministic=True)[0])
            total += reward
        expected.append(total)
    assert lengths == [10, 10]
    assert rewards == pytest.approx(expected, abs=1e-5)  # Monitor rounds
    assert len(set(expected)) == 2


def test_vec_normalize_normalises_the_rewards_and_leaves_the_images() -> None:
    venv = VecNormalize(DummyVecEnv([NoiseEnv]), norm_obs=False, gamma=0.9)
    model = make_model(venv)
    venv.ret_rms.var = 0.04
    samples = []
    for env in (None, venv):
        np.random.seed(3)
        samples.append(model.replay_buffer.sample(16, env=env))
    np.random.seed(3)
    views = model._sample_views(16)
    assert th.allclose(views.rewards, samples[0].rewards * 5, rtol=1e-4)
    assert th.equal(views.rewards, samples[1].rewards)
    assert views.anchor.images.dtype == th.uint8
    train_on(model, seed=1)


def test_vec_normalize_of_images_is_refused_with_the_way_out() -> None:
    with pytest.raises(ValueError, match=r"VecNormalize.*norm_obs=False"):
        make_model(VecNormalize(DummyVecEnv([NoiseEnv])))


def test_set_env() -> None:
    class Bright(NoiseEnv):
        def _frame(self) -> np.ndarray:
            return np.full(self.observation_space.shape, 255, np.uint8)

    model = make_model()
    model.set_env(Bright())
    model.learn(5, reset_num_timesteps=False)
    assert (model.num_timesteps, model._n_updates) == (45, 5)
    assert (model.replay_buffer.observations[40:45] == 255).all()
    assert not (model.replay_buffer.observations[:40] == 255).all()
    with pytest.raises(AssertionError, match="number of environments"):
        model.set_env(DummyVecEnv([NoiseEnv] * 2))


@pytest.mark.parametrize(("reset", "steps", "updates"), [(False, 52, 12), (True, 42, 4)])
def test_learn_twice(reset: bool, steps: int, updates: int) -> None:
    """Going on trains at once; starting to count anew plays random actions until ``learning_starts`` again."""
    model = make_model()
    model.learn(2, reset_num_timesteps=False)
    assert model._n_updates == 2
    model.learn(42 if reset else 10, reset_num_timesteps=reset)
    assert (model.num_timesteps, model._n_updates) == (steps, updates)


@pytest.mark.parametrize("n_envs", [1, 2])
def test_action_noise_is_added(n_envs: int) -> None:
    noise = NormalActionNoise(np.array([10.0, -10.0]), np.zeros(2))
    model = make_model(DummyVecEnv([NoiseEnv] * n_envs), action_noise=noise, learning_starts=20)
    stored = model.replay_buffer.actions[20 // n_envs : 40 // n_envs]
    assert (stored == np.array([1, -1])).all() and len(stored) == 20 // n_envs
    quiet = make_model(DummyVecEnv([NoiseEnv] * n_envs), learning_starts=20)
    assert not (quiet.replay_buffer.actions[20 // n_envs : 40 // n_envs] == np.array([1, -1])).all()


# -- Logs --------------------------------------------------------------------------------------------------------------


def test_the_tensorboard_folder_is_named_for_the_algorithm(tmp_path: Path) -> None:
    model = CRCSAC("CnnPolicy", NoiseEnv(), buffer_size=50, tensorboard_log=str(tmp_path), policy_kwargs=POLICY_KWARGS)
    model.learn(2).learn(2).learn(2, reset_num_timesteps=False).learn(2, tb_log_name="mine")
    assert {path.name for path in tmp_path.iterdir()} == {"CRCSAC_1", "CRCSAC_2", "mine_1"}
    assert all(list(path.glob("events.out.tfevents.*")) for path in tmp_path.iterdir())
    assert inspect.signature(CRCSAC.learn).parameters["tb_log_name"].default == "CRCSAC"


def test_losses_reach_the_loggers_that_the_user_sets(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = make_model()
    model.set_logger(configure(str(tmp_path), ["csv", "json", "stdout"]))
    model.learn(20, log_interval=1, reset_num_timesteps=False)
    rows = [row for row in csv.DictReader((tmp_path / "progress.csv").open()) if row["train/n_updates"]]
    lines = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    names = {"train/critic_loss", "train/actor_loss", "train/ent_coef", "train/learning_rate", "time/total_timesteps"}
    names |= {f"representation/{name}" for name in ("contrastive", "reconstruction", "consistency", "loss")}
    assert len(rows) >= 1
    for entries in (rows[-1], lines[-1]):
        assert names <= entries.keys()
        assert all(math.isfinite(float(entries[name])) for name in names)
    assert float(rows[-1]["train/critic_loss"]) == pytest.approx(lines[-1]["train/critic_loss"])
    assert "critic_loss" in capsys.readouterr().out


# -- Prediction --------------------------------------------------------------------------------------------------------


def test_prediction_of_batches_and_of_single_observations(observations: np.ndarray) -> None:
    model = make_model()
    batch, _ = model.predict(observations, deterministic=True)
    assert batch.shape == (5, 2) and len(np.unique(batch, axis=0)) == 5
    assert np.array_equal(batch, model.predict(observations, deterministic=True)[0])
    for observation, action in zip(observations, batch, strict=True):
        single, _ = model.predict(observation, deterministic=True)
        assert single.shape == (2,)
        assert np.allclose(single, action, atol=1e-6)
        last, _ = model.predict(observation.transpose(1, 2, 0), deterministic=True)
        assert np.array_equal(last, single)  # SB3 transposes channel-last images
    assert not np.allclose(batch, model.predict(observations)[0], atol=1e-3)


def test_actions_are_scaled_to_the_action_space(observations: np.ndarray) -> None:
    class Wide(NoiseEnv):
        def __init__(self) -> None:
            super().__init__()
            self.action_space = gym.spaces.Box(np.array([-3, 2], np.float32), np.array([1, 7], np.float32))

    model = make_model(Wide())
    actions, _ = model.predict(np.repeat(observations, 20, axis=0))
    assert all(model.action_space.contains(action) for action in actions)
    assert actions[:, 1].min() > 2 and actions[:, 0].min() < -1
