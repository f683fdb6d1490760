"""What the callbacks do: auxiliary objectives on stock SB3 algorithms, reconstructions as images, schedules."""

import io
import json
import subprocess
import sys
import zipfile
from copy import deepcopy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from sb3_contrib import TQC
from stable_baselines3 import DQN, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback
from stable_baselines3.common.logger import Image, KVWriter, Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize, VecTransposeImage
from torch import nn

from sb3_crc import PixelEncoder
from sb3_crc.callbacks import (
    AuxiliaryLossCallback,
    NStepScheduleCallback,
    ObjectiveScheduleCallback,
    ReconstructionImageCallback,
)
from sb3_crc.objectives import AuxiliaryObjective
from sb3_crc.views import Views
from tests.conftest import POLICY_KWARGS, NoiseEnv, make_model

SIZE = 36  # the smallest that SB3's NatureCNN takes
TINY = {"net_arch": [16], "features_extractor_kwargs": {"features_dim": 16}}


class BlobEnv(NoiseEnv):
    """A square of random shade at a random place, on dark noise."""

    def _frame(self) -> np.ndarray:
        frame = self.np_random.integers(0, 60, self.observation_space.shape, dtype=np.uint8)
        row, column = self.np_random.integers(4, SIZE - 10, 2)
        frame[:, row : row + 6, column : column + 6] = self.np_random.integers(100, 255, (3, 1, 1))
        return frame


class ChannelLast(gym.ObservationWrapper[np.ndarray, Any, np.ndarray]):
    def __init__(self, env: gym.Env[Any, Any]):
        super().__init__(env)
        self.observation_space = gym.spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        return observation.transpose(1, 2, 0)


class Observe(gym.ObservationWrapper[Any, Any, Any]):
    """The frames as floats, or as a Dict."""

    def __init__(self, env: gym.Env[Any, Any], kind: str):
        super().__init__(env)
        self.kind = kind
        space = gym.spaces.Box(0, 1, (3, SIZE, SIZE), np.float32)
        self.observation_space = gym.spaces.Dict({"image": env.observation_space}) if kind == "dict" else space

    def observation(self, observation: np.ndarray) -> Any:
        return {"image": observation} if self.kind == "dict" else (observation / 255).astype(np.float32)


class Buttons(gym.ActionWrapper[np.ndarray, Any, Any]):
    def __init__(self, env: gym.Env[Any, Any]):
        super().__init__(env)
        self.action_space = gym.spaces.Discrete(3)

    def action(self, action: Any) -> np.ndarray:
        return np.full(2, action / 2, np.float32)


class BatchNormCNN(BaseFeaturesExtractor):
    """Has buffers, one of them of integers, and a layer that it does not use."""

    def __init__(self, observation_space: gym.spaces.Box, features_dim: int = 16):
        super().__init__(observation_space, features_dim)
        self.cnn = nn.Sequential(
            nn.Conv2d(3, 4, 5, 4), nn.BatchNorm2d(4), nn.ReLU(), nn.Flatten(), nn.LazyLinear(features_dim)
        )
        self.unused = nn.Linear(2, 2)
        self.modes: list[bool] = []
        self.largest = 0.0
        self(th.zeros(2, 3, SIZE, SIZE))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        self.modes.append(self.training)
        self.largest = max(self.largest, observations.max().item())
        features: th.Tensor = self.cnn(observations)
        return features


class ActionNorm(AuxiliaryObjective):
    """A user's objective, which reads actions and latents."""

    def forward(self, views: Views) -> th.Tensor:
        assert views.actions.shape[1] == self.action_dim
        return (views.anchor.latent.mean(dim=1) - views.actions.float().mean(dim=1)).square().mean()


def noise_env() -> NoiseEnv:
    return NoiseEnv(size=SIZE, channels=3, length=5)


def stock(algorithm: str = "sac", env: Any = None, **kwargs: Any) -> OffPolicyAlgorithm:
    """A tiny stock model whose own learning rate is zero: what moves, the auxiliary losses have moved."""
    name, _, shared = algorithm.partition("-")
    cls = {"sac": SAC, "td3": TD3, "tqc": TQC, "dqn": DQN}[name]
    policy_kwargs: dict[str, Any] = {**TINY, **kwargs.pop("policy_kwargs", {})}
    if shared:
        policy_kwargs["share_features_extractor"] = True
    if env is None:
        env = Buttons(noise_env()) if name == "dqn" else noise_env()
    settings = {"learning_rate": 0.0, "buffer_size": 100, "learning_starts": 12, "batch_size": 8, "train_freq": 1, "seed": 0}
    model: OffPolicyAlgorithm = cls("CnnPolicy", env, policy_kwargs=policy_kwargs, device="cpu", **{**settings, **kwargs})
    return model


def live_extractor(model: BaseAlgorithm) -> nn.Module:
    owner = model.q_net if isinstance(model, DQN) else model.critic  # type: ignore[attr-defined]
    extractor: nn.Module = owner.features_extractor
    return extractor


def weights(module: nn.Module) -> dict[str, th.Tensor]:
    return {name: tensor.clone() for name, tensor in module.state_dict().items()}


def moved(before: dict[str, th.Tensor], module: nn.Module) -> set[str]:
    return {name for name, tensor in module.state_dict().items() if not th.equal(tensor, before[name])}


def seed(value: int = 1) -> None:
    th.manual_seed(value)
    np.random.seed(value)


# -- AuxiliaryLossCallback: what it trains -----------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", ["sac", "sac-shared", "td3", "td3-shared", "tqc", "tqc-shared", "dqn"])
def test_the_auxiliary_loss_moves_the_extractor_and_nothing_else(algorithm: str) -> None:
    model = stock(algorithm)
    before = weights(model.policy)
    model.learn(16, callback=AuxiliaryLossCallback())
    changed = {name for name in moved(before, model.policy) if "target" not in name}  # targets follow, as they should

    own = "q_net.features_extractor" if algorithm == "dqn" else "critic.features_extractor"
    expected = {name for name in before if name.startswith(own)}
    if algorithm.endswith("shared"):
        expected |= {name for name in before if name.startswith("actor.features_extractor")}
    assert changed == expected


def test_without_the_callback_nothing_moves() -> None:
    model = stock()
    before = weights(model.policy)
    model.learn(16)
    assert not {name for name in moved(before, model.policy) if "target" not in name}  # targets move by rounding


def test_heads_see_the_trained_extractor_and_still_learn() -> None:
    model = stock(learning_rate=1e-3)
    before = weights(model.policy)
    model.learn(16, callback=AuxiliaryLossCallback())
    assert moved(before, model.policy) == set(before)


def test_it_starts_when_the_algorithm_does_and_a_batch_is_stored() -> None:
    for learning_starts, batch_size, updates in ((12, 8, 4), (4, 10, 7)):  # in 16 steps
        callback = AuxiliaryLossCallback(batch_size=batch_size)
        stock(learning_starts=learning_starts).learn(16, callback=callback)
        assert callback.learner is not None and callback.learner.n_updates == updates


def test_gradient_steps_count_per_rollout() -> None:
    callback = AuxiliaryLossCallback(gradient_steps=3)
    stock(train_freq=2).learn(16, callback=callback)
    assert callback.learner is not None and callback.learner.n_updates == 2 * 3


def test_all_three_losses_fall_on_frames_that_differ() -> None:
    model = stock(env=BlobEnv(size=SIZE, channels=3, length=5), policy_kwargs={"features_extractor_kwargs": {}}).learn(40)
    callback = AuxiliaryLossCallback(gradient_steps=25, batch_size=16)
    callback.init_callback(model)
    assert callback.learner is not None
    first, *_, last = [callback.learner.train() for _ in range(3)]
    for name in ("contrastive", "reconstruction", "consistency"):
        assert last[f"representation/{name}"] < 0.9 * first[f"representation/{name}"]


def test_the_key_encoder_follows_at_its_rate() -> None:
    model = stock().learn(16)
    for tau in (0.25, 1.0):
        callback = AuxiliaryLossCallback(encoder_tau=tau)
        callback.init_callback(model)
        learner = callback.learner
        assert learner is not None
        old = weights(learner.key_encoder)
        learner.train()
        live = live_extractor(model).state_dict()
        for name, tensor in learner.key_encoder.state_dict().items():
            th.testing.assert_close(tensor, tau * live[name] + (1 - tau) * old[name])


def test_augmentation_batch_size_and_learning_rate_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    from sb3_crc.augmentations import AUGMENTATIONS

    seen: list[tuple[int, ...]] = []

    def paint(images: th.Tensor, value: int) -> th.Tensor:
        seen.append(tuple(images.shape))
        return th.full_like(images, value)

    monkeypatch.setitem(AUGMENTATIONS, "paint", paint)
    callback = AuxiliaryLossCallback(
        {"reconstruction": 1.0}, learning_rate="lin_0.5", augmentation="paint", augmentation_kwargs={"value": 51}, batch_size=5
    )
    model = stock().learn(16)
    callback.init_callback(model)
    assert callback.learner is not None
    model._current_progress_remaining = 0.25
    metrics = callback.learner.train()
    assert seen[-1] == (5, 3, SIZE, SIZE)
    assert metrics["representation/reconstruction"] == pytest.approx(0.2**2, rel=1)  # a constant, painted by a new decoder
    assert callback.learner.optimizer.param_groups[0]["lr"] == 0.125


@pytest.mark.parametrize("n_envs", [1, 3])
def test_channel_last_frames_of_many_environments(n_envs: int) -> None:
    model = stock(env=DummyVecEnv([lambda: ChannelLast(noise_env())] * n_envs))
    assert isinstance(model.get_env(), VecTransposeImage)
    before = weights(live_extractor(model))
    model.learn(21, callback=AuxiliaryLossCallback())
    assert moved(before, live_extractor(model)) == set(before)


def test_train_mode_is_set_for_the_update_and_restored() -> None:
    model = stock(policy_kwargs={"features_extractor_class": BatchNormCNN}).learn(16)
    callback = AuxiliaryLossCallback()
    callback.init_callback(model)
    extractor = live_extractor(model)
    assert isinstance(extractor, BatchNormCNN) and callback.learner is not None
    for mode in (True, False):
        extractor.train(mode)
        extractor.modes.clear()
        unused = extractor.unused.weight.clone()
        callback.learner.train()
        assert extractor.modes == [True] and extractor.training is mode
        key = callback.learner.key_encoder
        assert key.modes[-1] is False and not key.training
        assert th.equal(key.cnn[1].running_mean, extractor.cnn[1].running_mean)
        assert th.equal(key.cnn[1].num_batches_tracked, extractor.cnn[1].num_batches_tracked)
        assert th.equal(unused, extractor.unused.weight)


@pytest.mark.parametrize(("normalize_images", "largest"), [(True, 1.0), (False, 255.0)])
def test_the_extractor_sees_the_policys_scale(normalize_images: bool, largest: float) -> None:
    policy_kwargs = {"features_extractor_class": BatchNormCNN, "normalize_images": normalize_images}
    model = stock(policy_kwargs=policy_kwargs).learn(16)
    callback = AuxiliaryLossCallback()
    callback.init_callback(model)
    extractor = live_extractor(model)
    assert isinstance(extractor, BatchNormCNN) and callback.learner is not None
    extractor.largest = 0.0
    callback.learner.train()
    assert extractor.largest == largest


def test_our_encoder_in_a_stock_algorithm_is_mirrored_and_may_be_cropped_to() -> None:
    encoder_kwargs = {"channels": [4, 6], "strides": [2, 2], "features_dim": 8, "image_size": 32}
    policy_kwargs = {"features_extractor_class": PixelEncoder, "features_extractor_kwargs": encoder_kwargs}
    model = stock(policy_kwargs=policy_kwargs)
    callback = AuxiliaryLossCallback(augmentation="random_crop", augmentation_kwargs={"size": 32})
    before = weights(live_extractor(model))
    model.learn(16, callback=callback)
    assert callback.learner is not None
    decoder = callback.learner.objectives["reconstruction"].decoder
    assert decoder.start_shape[0] == 6 and len(decoder.deconvolutions) == 2
    assert moved(before, live_extractor(model)) == set(before)


def test_objectives_settings_and_a_users_class() -> None:
    callback = AuxiliaryLossCallback(
        {f"{__name__}.ActionNorm": 0.5, "reconstruction": {"weight": 0.1, "channels": [8], "strides": [2]}}
    )
    model = stock("dqn")
    model.learn(16, callback=callback)
    assert callback.learner is not None
    assert set(callback.learner.objectives) == {"ActionNorm", "reconstruction"}
    assert len(callback.learner.objectives["reconstruction"].decoder.deconvolutions) == 1
    logged = model.logger.name_to_value
    assert logged["representation/loss"] == pytest.approx(
        0.5 * logged["representation/ActionNorm"] + 0.1 * logged["representation/reconstruction"], rel=1e-5
    )


def test_other_forms_of_the_objectives_work_on_any_extractor() -> None:
    forms = {
        "contrastive": {"weight": 1.0, "initialization": "uniform", "symmetric": False},
        "reconstruction": {"weight": 1.0, "bits": 5},
        "consistency": {"weight": 1.0, "predictor_side": "online", "predictor": "batch_norm", "normalize": True},
    }
    model = stock()
    before = weights(live_extractor(model))
    with pytest.warns(UserWarning, match="should sum to 1"):
        model.learn(16, callback=AuxiliaryLossCallback(forms))
    assert moved(before, live_extractor(model)) == set(before)


def test_it_logs_means_with_one_transfer(monkeypatch: pytest.MonkeyPatch) -> None:
    model = stock().learn(16)
    callback = AuxiliaryLossCallback(gradient_steps=3)
    callback.init_callback(model)
    assert callback.learner is not None
    calls: list[int] = []
    callback.learner._augment = lambda images: images  # type: ignore[method-assign]  # draws its offsets on the host
    monkeypatch.setattr(callback.learner.optimizer, "step", lambda: None)  # Adam counts its steps on the host
    for transfer in ("tolist", "item", "__float__", "__bool__"):
        monkeypatch.setattr(th.Tensor, transfer, _counted(getattr(th.Tensor, transfer), calls))
    metrics = callback.learner.train()
    assert len(calls) == 1
    assert {"representation/contrastive", "representation/loss", "representation/learning_rate"} <= set(metrics)


def _counted(function: Any, calls: list[int]) -> Any:
    def count(*args: Any, **kwargs: Any) -> Any:
        calls.append(1)
        return function(*args, **kwargs)

    return count


def test_a_loss_that_is_not_finite_stops_training() -> None:
    model = stock().learn(16)
    callback = AuxiliaryLossCallback()
    callback.init_callback(model)
    with th.no_grad():
        live_extractor(model).linear[0].bias.fill_(float("nan"))
    with pytest.raises(FloatingPointError, match="representation/contrastive is nan after 1 auxiliary updates"):
        callback.on_rollout_end()


# -- AuxiliaryLossCallback: what it saves ------------------------------------------------------------------------------

LOAD_WITHOUT_US = """
import sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "sb3_crc":
            raise ImportError("sb3_crc is blocked")
sys.meta_path.insert(0, Block())
import warnings
warnings.simplefilter("error")
import numpy as np, stable_baselines3
model = stable_baselines3.SAC.load(sys.argv[1], device="cpu")
print(model.predict(np.zeros((3, 36, 36), np.uint8), deterministic=True)[0].shape, "save" in vars(model))
assert not any(name.startswith("sb3_crc") for name in sys.modules)
"""


def test_the_models_zip_needs_nothing_of_ours(tmp_path: Path) -> None:
    model = stock()
    callback = AuxiliaryLossCallback()
    model.learn(16, callback=callback)
    model.save(tmp_path / "model", include=["save"])
    assert (tmp_path / "model.aux.zip").exists()
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        assert "save" not in json.loads(archive.read("data"))
        assert not any(b"sb3_crc" in archive.read(name) for name in archive.namelist())
    command = [sys.executable, "-c", LOAD_WITHOUT_US, str(tmp_path / "model.zip")]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.stdout.strip() == "(2,) False", result.stderr


def test_every_save_writes_the_file_beside_it(tmp_path: Path) -> None:
    model = stock()
    callbacks = [
        CheckpointCallback(8, str(tmp_path / "checkpoints")),
        EvalCallback(
            Monitor(noise_env()), n_eval_episodes=1, eval_freq=10, best_model_save_path=str(tmp_path / "best"), verbose=0
        ),
        AuxiliaryLossCallback(),
    ]
    model.learn(16, callback=callbacks)
    model.save(str(tmp_path / "after.zip"))
    model.save(tmp_path / "model.v2")
    zips = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert zips == {
        "checkpoints/rl_model_8_steps.zip",
        "checkpoints/rl_model_8_steps.aux.zip",
        "checkpoints/rl_model_16_steps.zip",
        "checkpoints/rl_model_16_steps.aux.zip",
        "best/best_model.zip",
        "best/best_model.aux.zip",
        "after.zip",
        "after.aux.zip",
        "model.v2",  # SB3 adds .zip to names without a dot only
        "model.v2.aux.zip",
    }
    for path in tmp_path.rglob("*.aux.zip"):
        AuxiliaryLossCallback.load(path)


def test_save_alone_streams_and_giving_save_back(tmp_path: Path) -> None:
    model = stock()
    callback = AuxiliaryLossCallback()
    with pytest.raises(RuntimeError, match="nothing to save"):
        callback.save(tmp_path / "model")
    model.learn(16, callback=callback)
    stream = io.BytesIO()
    with pytest.warns(UserWarning, match=r"AuxiliaryLossCallback.save\(path\)"):
        model.save(stream)
    assert stream.tell() > 0
    assert callback.save(tmp_path / "new" / "model.zip") == tmp_path / "new" / "model.aux.zip"
    del model.save  # type: ignore[method-assign]
    model.save(tmp_path / "plain")
    assert not (tmp_path / "plain.aux.zip").exists()


@pytest.mark.parametrize("algorithm", ["sac", "td3-shared", "tqc", "dqn"])
def test_after_loading_one_step_moves_the_live_extractor(algorithm: str, tmp_path: Path) -> None:
    model = stock(algorithm)
    model.learn(16, callback=AuxiliaryLossCallback())
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")

    loaded = type(model).load(tmp_path / "model", env=model.get_env(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    before = weights(live_extractor(loaded))
    callback = AuxiliaryLossCallback.load(tmp_path / "model")
    loaded.learn(1, callback=callback, reset_num_timesteps=False)
    assert callback.learner is not None and callback.learner.n_updates == 5
    assert moved(before, live_extractor(loaded)) == set(before)


EXTRACTORS: dict[str, dict[str, Any]] = {
    "nature": {},
    "batch_norm": {"features_extractor_class": BatchNormCNN},
    "pixel_encoder": {
        "features_extractor_class": PixelEncoder,
        "features_extractor_kwargs": {"channels": [4], "strides": [2], "features_dim": 8},
    },
}


@pytest.mark.parametrize("extractor", EXTRACTORS)
def test_continuation_is_equal_bit_for_bit(extractor: str, tmp_path: Path) -> None:
    model = stock(learning_rate=1e-3, policy_kwargs=EXTRACTORS[extractor])
    callback = AuxiliaryLossCallback(gradient_steps=2)
    model.learn(20, callback=callback)
    model.save(tmp_path / "model")
    loaded = SAC.load(tmp_path / "model", env=model.get_env(), device="cpu")
    loaded.replay_buffer = deepcopy(model.replay_buffer)
    loaded_callback = AuxiliaryLossCallback.load(tmp_path / "model")
    loaded_callback.init_callback(loaded)
    loaded.set_logger(model.logger)

    for one, its_callback in ((model, callback), (loaded, loaded_callback)):
        seed()
        for _ in range(3):
            its_callback.on_rollout_end()
            one.train(batch_size=8, gradient_steps=1)
        one.save(tmp_path / f"{id(its_callback)}")

    assert not moved(weights(model.policy), loaded.policy)
    first, second = (dict(each.learner._state()) for each in (callback, loaded_callback) if each.learner is not None)
    assert first.keys() == second.keys() and any(name.startswith("adam/encoder/") for name in first)
    assert all(th.equal(first[name], second[name]) for name in first)
    assert callback.settings == loaded_callback.settings


def test_a_second_learn_goes_on_and_another_model_starts_afresh(tmp_path: Path) -> None:
    callback = AuxiliaryLossCallback()
    model, other = stock(), stock()
    model.learn(16, callback=callback)
    first = callback.learner
    model.learn(4, callback=callback, reset_num_timesteps=False)
    assert callback.learner is first and first is not None and first.n_updates == 8
    before = weights(live_extractor(model))
    other.learn(16, callback=callback)
    assert callback.learner is not first and not moved(before, live_extractor(model))
    model.save(tmp_path / "model")  # each model goes on saving what is its own
    assert AuxiliaryLossCallback.load(tmp_path / "model")._loaded[0]["n_updates"] == 8  # type: ignore[index]


def test_loading_with_changes_and_what_does_not_fit(tmp_path: Path) -> None:
    model = stock()
    model.learn(16, callback=AuxiliaryLossCallback({"contrastive": 1.0}))
    model.save(tmp_path / "model")
    changed = AuxiliaryLossCallback.load(tmp_path / "model", gradient_steps=2, learning_rate=0.5)
    changed.init_callback(model)
    assert changed.settings.gradient_steps == 2 and changed.settings.objectives == {"contrastive": 1.0}

    wrong = AuxiliaryLossCallback.load(tmp_path / "model", objectives={"reconstruction": 1.0})
    with pytest.raises(ValueError, match="does not fit this model and these objectives"):
        wrong.init_callback(stock())
    with pytest.warns(UserWarning, match="saved after 4 updates of the model, this model has made 0"):
        AuxiliaryLossCallback.load(tmp_path / "model").init_callback(stock())
    with pytest.raises(FileNotFoundError, match="no auxiliary state at .*absent.aux.zip"):
        AuxiliaryLossCallback.load(tmp_path / "absent")

    saved = (tmp_path / "model.aux.zip").read_bytes()
    (tmp_path / "cut.aux.zip").write_bytes(saved[: len(saved) // 2])
    (tmp_path / "model.zip").rename(tmp_path / "other.aux.zip")
    for damaged in ("cut", "other"):
        with pytest.raises(ValueError, match=f"{damaged}.aux.zip is not an auxiliary state"):
            AuxiliaryLossCallback.load(tmp_path / damaged)


# -- AuxiliaryLossCallback: what it refuses ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"objectives": {}}, "objectives={} leaves nothing to train"),
        ({"objectives": {"contrastive": -1}}, "must be a finite number >= 0, got -1"),
        ({"gradient_steps": 0}, "gradient_steps=0 must be an integer of at least 1"),
        ({"gradient_steps": None}, "gradient_steps=None must be an integer of at least 1"),
        ({"batch_size": 2.5}, "batch_size=2.5 must be an integer of at least 1"),
        ({"encoder_tau": 0}, "encoder_tau=0 must be above 0 and at most 1"),
        ({"learning_rate": 0.0}, "learning_rate=0.0 must be finite and above 0"),
        ({"learning_rate": lambda progress: progress}, "must be a number or 'lin_x'"),
        ({"learning_rate": "linear"}, "unknown learning rate 'linear'"),
        ({"augmentation": "random_shfit"}, "unknown augmentation 'random_shfit'; did you mean 'random_shift'"),
        ({"augmentation_kwargs": {"pad": th.ones(1)}}, "settings must be plain values"),
    ],
)
def test_bad_arguments_are_refused_at_once(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        AuxiliaryLossCallback(**kwargs)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"objectives": {"contrastiv": 1.0}}, "unknown objective 'contrastiv'; did you mean 'contrastive'"),
        (
            {"augmentation": "random_crop", "augmentation_kwargs": {"size": 30}},
            r"turns images of \(3, 36, 36\) into \(3, 30, 30\)",
        ),
        ({"augmentation": "random_crop"}, r"augmentation_kwargs={} do not suit 'random_crop': .*missing.*'size'"),
        ({"augmentation_kwargs": {"padding": 2}}, "augmentation_kwargs 'padding'; did you mean 'pad'"),
        ({"batch_size": 101}, "batch_size=101 is more than the replay buffer holds: 100"),
    ],
)
def test_settings_that_do_not_go_with_the_model_are_refused_before_the_first_step(
    kwargs: dict[str, Any], message: str
) -> None:
    model = stock()
    with pytest.raises(ValueError, match=message):
        model.learn(16, callback=AuxiliaryLossCallback(**kwargs))
    assert model.num_timesteps == 0


def unsuitable(kind: str) -> BaseAlgorithm:
    if kind == "on-policy":
        return PPO("CnnPolicy", noise_env(), n_steps=8, batch_size=8, policy_kwargs=TINY, device="cpu")
    if kind == "crc_sac":
        return make_model()
    if kind == "dict":
        return SAC("MultiInputPolicy", Observe(noise_env(), "dict"), buffer_size=10, device="cpu")
    if kind == "float":
        return SAC("MlpPolicy", Observe(noise_env(), "float"), buffer_size=10, device="cpu")
    if kind == "state":
        return SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, device="cpu")
    if kind == "normalized":
        env = VecNormalize(DummyVecEnv([noise_env]), norm_obs=True)
        return SAC("MlpPolicy", env, buffer_size=10, device="cpu")
    assert kind == "flatten"
    return SAC("MlpPolicy", noise_env(), buffer_size=10, device="cpu")


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("on-policy", "PPO has no replay buffer"),
        ("crc_sac", r"CRCSAC trains objectives itself: .*CRCSAC\(objectives=...\)"),
        ("dict", "expected uint8 images .* got Dict"),
        ("float", "expected uint8 images .* got Box.*float32"),
        ("state", "expected uint8 images"),
        ("normalized", r"use VecNormalize\(norm_obs=False\)"),
        ("flatten", "FlattenExtractor has no trainable parameters"),
    ],
)
def test_unsuitable_models_are_refused_before_the_first_step(kind: str, message: str) -> None:
    model = unsuitable(kind)
    steps = model.num_timesteps
    with pytest.raises(ValueError, match=message):
        model.learn(steps + 1, callback=AuxiliaryLossCallback(), reset_num_timesteps=False)
    assert model.num_timesteps == steps
    assert "save" not in vars(model)


def test_normalised_rewards_are_fine() -> None:
    model = stock(env=VecNormalize(DummyVecEnv([noise_env]), norm_obs=False))
    before = weights(live_extractor(model))
    model.learn(16, callback=AuxiliaryLossCallback())
    assert moved(before, live_extractor(model))


def test_one_callback_per_model() -> None:
    with pytest.raises(ValueError, match="a model takes one AuxiliaryLossCallback"):
        stock().learn(16, callback=[AuxiliaryLossCallback(), AuxiliaryLossCallback()])


# -- ReconstructionImageCallback ---------------------------------------------------------------------------------------


class Recorder(KVWriter):
    """Keeps what a writer with images would get."""

    def __init__(self) -> None:
        self.images: list[Image] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        key = ReconstructionImageCallback.key
        if key in key_values:
            assert set(key_excluded[key]) == {"stdout", "log", "json", "csv"}
            self.images.append(key_values[key])

    def close(self) -> None:
        pass


@pytest.mark.parametrize("channels", [9, 4])
def test_reconstructions_reach_the_logger_as_images(channels: int) -> None:
    model = make_model(NoiseEnv(channels=channels))
    recorder = Recorder()
    model.set_logger(Logger(None, [recorder]))
    model.learn(40, callback=ReconstructionImageCallback(10, 3), log_interval=1)
    assert len(recorder.images) == 4  # episodes end every 10 steps
    side = model.critic.features_extractor.input_shape[1]
    image = recorder.images[0].image
    assert recorder.images[0].dataformats == "CHW"
    assert isinstance(image, th.Tensor) and image.dtype == th.uint8 and image.shape == (3, 2 * side, 3 * side)
    assert image[:, :side].float().std() > 30  # noise above, and grey below


@pytest.mark.parametrize("bits", [None, 5])
def test_the_picture_shows_the_newest_frame_and_the_decoders_output(bits: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(objectives={"reconstruction": {"weight": 1.0, "bits": bits}})
    callback = ReconstructionImageCallback(n_images=2)
    callback.init_callback(model)
    seed()
    assert model.replay_buffer is not None
    frames = model.replay_buffer.sample(2).observations
    top = left = (frames.shape[2] - 34) // 2
    expected = th.cat(list(frames[:, 6:, top : top + 34, left : left + 34]), dim=2)

    decoder = model.policy.objectives["reconstruction"].decoder
    monkeypatch.setattr(decoder, "forward", lambda latents: th.full((len(latents), 9, 34, 34), 0.4 if bits is None else -0.1))
    seed()
    picture = callback.picture()
    assert th.equal(picture[:, :34], expected)
    assert (picture[:, 34:] == round(0.4 * 255)).all()


@pytest.mark.parametrize("bits", [None, 5])
def test_a_standardised_decoder_that_knows_nothing_shows_the_mean_image(
    bits: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {"weight": 1.0, "bits": bits, "half_size": True, "standardize": True}
    encoder = {**POLICY_KWARGS["features_extractor_kwargs"], "frame_differences": 4.0}
    model = make_model(
        objectives={"reconstruction": settings}, policy_kwargs={**POLICY_KWARGS, "features_extractor_kwargs": encoder}
    )
    callback = ReconstructionImageCallback(n_images=2)
    callback.init_callback(model)
    decoder = model.policy.objectives["reconstruction"].decoder
    assert decoder(th.zeros(2, decoder.linear.in_features)).shape[2:] == (16, 16)  # of 34
    monkeypatch.setattr(decoder, "forward", lambda latents: th.zeros(len(latents), 9, 16, 16))
    seed()
    before = th.get_rng_state()
    picture = callback.picture()
    assert th.equal(th.get_rng_state(), before)
    assert picture.shape == (3, 68, 68)

    seed()
    assert model.replay_buffer is not None
    frames = model.replay_buffer.sample(64).observations  # noise: their mean image is almost grey
    top = left = (frames.shape[2] - 34) // 2
    mean = frames[:, 6:, top : top + 34, left : left + 34][:, :, 1:33:2, 1:33:2].float().mean(dim=0)
    expected = th.nn.functional.interpolate(mean[None], (34, 34))[0]
    for column in (0, 34):
        difference = picture[:, 34:, column : column + 34] - expected
        assert difference.abs().max() < (1 if bits is None else 5)  # 5 bits: levels of 8, dithered, over 64 frames


def test_pictures_do_not_change_the_run() -> None:
    results = []
    for callback in (None, ReconstructionImageCallback(5)):
        model = make_model()
        model.learn(20, callback=callback, reset_num_timesteps=False)  # past learning_starts
        results.append(weights(model.policy))
    assert all(th.equal(results[0][name], results[1][name]) for name in results[0])


def test_reconstruction_images_refusals() -> None:
    for kwargs, message in (
        ({"every": 0}, "every=0 must be at least 1"),
        ({"n_images": 0}, "n_images=0 must be at least 1"),
        ({"frame_channels": 2}, "frame_channels=2 must be 1, 3 or None"),
    ):
        with pytest.raises(ValueError, match=message):
            ReconstructionImageCallback(**kwargs)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="no reconstruction among the model's objectives"):
        make_model(objectives={"contrastive": 1.0}).learn(1, callback=ReconstructionImageCallback())
    with pytest.raises(ValueError, match="ReconstructionImageCallback is for CRCSAC, got SAC"):
        stock().learn(1, callback=ReconstructionImageCallback())


# -- ObjectiveScheduleCallback -----------------------------------------------------------------------------------------


def test_scheduled_weights_reach_the_loss() -> None:
    model = make_model()
    callback = ObjectiveScheduleCallback(
        {"contrastive": "lin_2", "reconstruction": lambda progress: 1 - progress, "consistency": 0}
    )
    for total in (10, 40):
        model.learn(total, callback=callback, reset_num_timesteps=False)
        logged = model.logger.name_to_value
        assert logged["representation/contrastive_weight"] == pytest.approx(0)  # the end of training
        assert logged["representation/reconstruction_weight"] == 1
        assert logged["representation/loss"] == pytest.approx(logged["representation/reconstruction"], rel=1e-4)


def test_after_training_the_models_own_values_hold() -> None:
    model = make_model()
    own_rate, own_weights = model._lr_schedules["encoder_learning_rate"], model._objective_weights
    model.learn(5, callback=ObjectiveScheduleCallback({"contrastive": 3.0}, encoder_learning_rate=0.5))
    assert model._lr_schedules["encoder_learning_rate"] is own_rate
    assert model._objective_weights == own_weights


def test_the_encoders_rate_is_scheduled() -> None:
    model = make_model()
    model.learning_starts = 0
    model.learn(10, callback=ObjectiveScheduleCallback(encoder_learning_rate=lambda progress: 0.5 * progress + 0.25))
    assert model.policy.encoder_optimizer is not None
    assert model.policy.encoder_optimizer.param_groups[0]["lr"] == 0.25
    assert model.actor.optimizer.param_groups[0]["lr"] == 1e-3
    assert model.logger.name_to_value["train/encoder_learning_rate"] == 0.25


def test_objective_schedule_refusals() -> None:
    with pytest.raises(ValueError, match="nothing to schedule"):
        ObjectiveScheduleCallback()
    with pytest.raises(ValueError, match="'contrastive': the value must be finite and >= 0, got -0.5 at progress 0.5"):
        ObjectiveScheduleCallback({"contrastive": lambda progress: progress - 1 if progress < 1 else 1})
    with pytest.raises(
        ValueError, match="no objective 'kontrastive' to schedule; the model has: contrastive, reconstruction, cons"
    ):
        make_model().learn(1, callback=ObjectiveScheduleCallback({"kontrastive": 1.0}))
    with pytest.raises(ValueError, match="the model has objectives={}"):
        make_model(objectives={}).learn(1, callback=ObjectiveScheduleCallback(encoder_learning_rate=1e-3))
    with pytest.raises(ValueError, match="ObjectiveScheduleCallback is for CRCSAC, got SAC"):
        stock().learn(1, callback=ObjectiveScheduleCallback({"contrastive": 1.0}))


# -- NStepScheduleCallback ---------------------------------------------------------------------------------------------


def test_returns_get_shorter_as_training_proceeds(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(n_steps=3, learning_starts=8, batch_size=4, gamma=0.5)
    seen = []
    sample = model.replay_buffer.sample_frames

    def spied(*args: Any, **kwargs: Any) -> Any:
        batch = sample(*args, **kwargs)
        seen.append((model.num_timesteps, 1.0 if batch.discounts is None else float(batch.discounts.min())))
        return batch

    monkeypatch.setattr(model.replay_buffer, "sample_frames", spied)
    model.learn(40, callback=NStepScheduleCallback({0.75: 1, 0.5: 2}))
    expected = [(3, 0.125) if step < 20 else (2, 0.25) if step < 30 else (1, 1.0) for step, _ in seen]
    assert [discount for _, discount in seen] == [discount for _, discount in expected]
    assert {number for number, _ in expected} == {1, 2, 3}
    assert model.replay_buffer.n_steps == 3  # its own again
    assert model.logger.name_to_value["train/n_steps"] == 1


def test_n_step_schedule_refusals() -> None:
    for steps, message in (
        ({}, "nothing to schedule"),
        ({1.0: 2}, "1.0 is no share of the training, from 0 to below 1"),
        ({-0.1: 2}, "-0.1 is no share"),
        ({0.5: 0}, "0 must be a whole number, at least 1"),
        ({0.5: 1.5}, "1.5 must be a whole number"),
    ):
        with pytest.raises(ValueError, match=message):
            NStepScheduleCallback(steps)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="needs a FrameReplayBuffer, the model has ReplayBuffer"):
        stock().learn(1, callback=NStepScheduleCallback({0.5: 1}))
