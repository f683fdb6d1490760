"""Exported policies act as the models that they come from; nothing else is read, whatever a file holds."""

import json
import pickle
import struct
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import psutil
import pytest
import safetensors.torch
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from torch import nn
from typer.testing import CliRunner

from sb3_crc import CRCSAC, make_dmc
from sb3_crc.cli import app
from sb3_crc.encoder import PixelEncoder
from sb3_crc.export import FORMAT, PolicyFileError, environment_of, export_policy, load_policy, load_weights
from tests.conftest import POLICY_KWARGS, NoiseEnv, make_model

ENCODER = POLICY_KWARGS["features_extractor_kwargs"]
CHANGES: dict[str, dict[str, Any]] = {
    "defaults": {},
    "heads": {"layer_norm": True, "activation_fn": nn.ELU, "net_arch": {"pi": [16], "qf": [24, 8]}, "n_critics": 3},
    "latent": {"actor_features": "latent", "log_std_bounds": (-5, 1)},
    "encoder": {"features_extractor_kwargs": {**ENCODER, "latent_activation": "tanh", "center_input": True}},
}


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export_policy(make_model(), tmp_path_factory.mktemp("exported") / "policy")


def rewritten(exported: Path, target: Path, change: Any = None, **metadata: str) -> Path:
    """The same file with another configuration, other weights or other metadata."""
    with safe_open(exported, framework="pt") as file:
        about, weights = dict(file.metadata()), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    configuration = json.loads(about["configuration"])
    if change is not None:
        change(configuration, weights)
    about["configuration"] = json.dumps(configuration)
    safetensors.torch.save_file(weights, target, {**about, **metadata})
    return target


@pytest.mark.parametrize("name", CHANGES)
def test_it_acts_as_the_model_does(tmp_path: Path, name: str) -> None:
    model = make_model(policy_kwargs={**POLICY_KWARGS, **CHANGES[name]})
    model.learn(4, reset_num_timesteps=False)
    policy = load_policy(export_policy(model, tmp_path / "policy.sb3crc"), "cpu")
    observations = np.random.default_rng(0).integers(0, 256, (5, *NoiseEnv().observation_space.shape), np.uint8)  # type: ignore[misc]
    assert np.array_equal(
        policy.predict(observations, deterministic=True)[0], model.predict(observations, deterministic=True)[0]
    )
    mine, theirs = policy.state_dict(), model.policy.state_dict()
    assert all(th.equal(mine[key], theirs[key]) for key in mine if key != "gradient_norms")
    assert not policy.training


def test_images_and_vectors(tmp_path: Path) -> None:
    env = make_dmc("cartpole-swingup", seed=0, image_size=36, frame_stack=2, render_quality="fast", observation="dict")
    model = CRCSAC("MultiInputPolicy", env, buffer_size=50, policy_kwargs=POLICY_KWARGS, device="cpu")
    observation, _ = env.reset()
    policy = load_policy(export_policy(model, tmp_path / "policy"), "cpu")
    assert np.array_equal(
        policy.predict(observation, deterministic=True)[0], model.predict(observation, deterministic=True)[0]
    )
    env.close()


@pytest.mark.parametrize(
    "box",
    [
        gym.spaces.Box(-np.finfo(np.float32).max, np.finfo(np.float32).max, (4,), np.float32),  # as Gymnasium's CartPole has
        gym.spaces.Box(-5, 5, (4,), np.int64),
        gym.spaces.Box(-np.inf, np.inf, (4,), np.float32),
    ],
    ids=["largest", "integers", "unbounded"],
)
def test_vectors_of_any_bounds_and_types(tmp_path: Path, box: gym.spaces.Box) -> None:
    class Beside(gym.ObservationWrapper[Any, Any, Any]):
        observation_space = gym.spaces.Dict({"image": NoiseEnv().observation_space, "vector": box})

        def observation(self, observation: Any) -> Any:
            return {"image": observation, "vector": np.ones(4, box.dtype)}

    model = CRCSAC("MultiInputPolicy", Beside(NoiseEnv()), buffer_size=50, policy_kwargs=POLICY_KWARGS, device="cpu")
    policy = load_policy(export_policy(model, tmp_path / "policy"), "cpu")
    assert policy.observation_space == model.observation_space
    observation, _ = Beside(NoiseEnv()).reset(seed=0)
    assert np.array_equal(
        policy.predict(observation, deterministic=True)[0], model.predict(observation, deterministic=True)[0]
    )


def test_what_could_not_be_read_again_is_not_written(tmp_path: Path) -> None:
    model = make_model(policy_kwargs={**POLICY_KWARGS, "log_std_bounds": (-1e7, 2)})
    with pytest.raises(PolicyFileError, match="-10000000.0 is more than 1048576"):
        export_policy(model, tmp_path / "policy.sb3crc")
    assert list(tmp_path.iterdir()) == []


def test_other_algorithms_are_refused_by_name(tmp_path: Path) -> None:
    model = SAC("CnnPolicy", NoiseEnv(), buffer_size=10, policy_kwargs={"net_arch": [8]}, device="cpu")
    for other in (model, model.policy):
        with pytest.raises(TypeError, match=f"a CRCSAC or its policy can be exported, {type(other).__name__} cannot"):
            export_policy(other, tmp_path / "policy")
    assert list(tmp_path.iterdir()) == []


def test_going_on_with_it(tmp_path: Path) -> None:
    model = make_model()
    path = export_policy(model, tmp_path / "policy")
    other = make_model(seed=5)
    assert not th.equal(other.actor.mu.weight, model.actor.mu.weight)
    load_weights(other, path)
    mine, theirs = other.policy.state_dict(), model.policy.state_dict()
    assert all(th.equal(mine[key], theirs[key]) for key in mine if key.split(".")[0] not in ("objectives", "gradient_norms"))
    other.learn(3, reset_num_timesteps=False)
    assert not th.equal(other.actor.mu.weight, model.actor.mu.weight)
    with pytest.raises(ValueError, match=r"actor.latent_pi.0.bias is \(32,\) there and \(20,\) in the model"):
        load_weights(make_model(policy_kwargs={**POLICY_KWARGS, "net_arch": [20, 20]}), path)


def test_where_it_acts(tmp_path: Path, exported: Path) -> None:
    path = export_policy(make_model(), tmp_path / "policy", task="cartpole-swingup", env_kwargs={"image_size": 64})
    assert environment_of(path) == ("cartpole-swingup", {"image_size": 64})
    with pytest.raises(PolicyFileError, match="does not say in which environment"):
        environment_of(exported)


def test_colleagues_may_read_it(tmp_path: Path, exported: Path) -> None:
    (mine := tmp_path / "mine").touch()
    assert exported.stat().st_mode == mine.stat().st_mode


def test_what_cannot_be_described(tmp_path: Path) -> None:
    class Own(PixelEncoder):
        pass

    with pytest.raises(ValueError, match="Own cannot be described"):
        export_policy(make_model(policy_kwargs={**POLICY_KWARGS, "features_extractor_class": Own}), tmp_path / "policy")
    with pytest.raises(ValueError, match="activation_fn=Softsign cannot be described"):
        export_policy(make_model(policy_kwargs={**POLICY_KWARGS, "activation_fn": nn.Softsign}), tmp_path / "policy")
    with pytest.raises(ValueError, match=r"env_kwargs: distraction is none of image_size"):
        export_policy(make_model(), tmp_path / "policy", task="cartpole-swingup", env_kwargs={"distraction": "color_easy"})
    assert not list(tmp_path.iterdir())


def to(*keys: str, value: Any) -> Any:
    def change(configuration: dict[str, Any], weights: dict[str, th.Tensor]) -> None:
        for key in keys[:-1]:
            configuration = configuration[key]
        configuration[keys[-1]] = value

    return change


def weight(value: Any) -> Any:
    def change(configuration: dict[str, Any], weights: dict[str, th.Tensor]) -> None:
        weights["actor.mu.weight"] = value(weights["actor.mu.weight"])

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (to("net_arch", value=[1 << 20, 1 << 20]), "asks for at least"),
        (to("net_arch", value=[1 << 40]), "is more than 1048576"),
        (to("n_critics", value=1 << 19), "asks for at least"),
        (to("features_extractor_kwargs", "features_dim", value=1 << 20), "asks for at least"),
        (to("features_extractor_kwargs", "channels", value=[1 << 20, 8]), "asks for at least"),
        (to("features_extractor_kwargs", "strides", value=[0, 1]), "no policy can be made"),
        (to("observation_space", "shape", value=[9, 1 << 20, 1 << 20]), "no space of shape"),
        (to("observation_space", "shape", value=[1, 7000, 7000]), "should be"),
        (to("observation_space", "dtype", value="O"), "no space of shape"),
        (to("observation_space", "dtype", value="f4,(2,"), "cannot be used"),
        (to("action_space", "shape", value=[5]), "should be"),
        (to("activation_fn", value="__import__"), "is none of ReLU"),
        (to("features_extractor_kwargs", value={"own": 1}), "must hold some of"),
        (to("net_arch", value="dict(pi=[])"), "no policy can be made"),
        (to("own", value=1), "own: missing, or not known"),
        (to("log_std_bounds", value=[float("nan"), 1]), "NaN is no number"),
        (to("log_std_bounds", value=[2, -10]), "the first must be less"),
        (to("log_std_bounds", value="ab"), "cannot be used"),
        (weight(lambda one: one * float("nan")), "not finite"),
        (weight(lambda one: one.double()), "float64"),
        (weight(lambda one: one[:, :-1].contiguous()), "actor.mu.weight is"),
    ],
)
def test_what_is_not_as_described_is_refused(exported: Path, tmp_path: Path, change: Any, message: str) -> None:
    before = psutil.Process().memory_info().rss
    with pytest.raises(PolicyFileError, match=message):
        load_policy(rewritten(exported, tmp_path / "policy", change), "cpu")
    assert psutil.Process().memory_info().rss - before < 400e6


def test_what_is_no_such_file(exported: Path, tmp_path: Path) -> None:
    path = tmp_path / "policy"
    with pytest.raises(FileNotFoundError, match="there is no file"):
        load_policy(path)
    ran = tmp_path / "ran"

    class Hostile:
        def __reduce__(self) -> Any:
            return Path.touch, (ran,)

    contents = {
        "pickle": pickle.dumps(Hostile()),
        "empty": b"",
        "truncated": exported.read_bytes()[:-10],
        "longer": exported.read_bytes() + b"more",
        "absurd header": struct.pack("<Q", 1 << 60) + b"{}",
    }
    for content in contents.values():
        path.write_bytes(content)
        with pytest.raises(PolicyFileError, match="no safetensors file, or is damaged"):
            load_policy(path)
    assert not ran.exists()
    with pytest.raises(PolicyFileError, match="'other' is not"):
        load_policy(rewritten(exported, path, format="other"))
    for configuration, message in (('{"n_critics": 1, "n_critics": 2}', "is there twice"), ("[" * 100_000, "cannot be used")):
        safetensors.torch.save_file({"a": th.zeros(1)}, path, {"format": FORMAT, "configuration": configuration})
        with pytest.raises(PolicyFileError, match=message):
            load_policy(path)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_damage_anywhere_is_found_or_harmless(
    exported: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    content = bytearray(exported.read_bytes())
    header = 8 + struct.unpack("<Q", content[:8])[0]
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, header - 1) | st.integers(0, len(content) - 1))
        content[place] ^= 1 << data.draw(st.integers(0, 7))
    path = tmp_path_factory.getbasetemp() / "damaged"
    path.write_bytes(bytes(content))
    try:
        policy = load_policy(path, "cpu")
    except PolicyFileError:
        return
    space: gym.spaces.Box = policy.observation_space  # type: ignore[assignment]
    action, _ = policy.predict(np.zeros(space.shape, space.dtype), deterministic=True)
    assert np.isfinite(action).all()


def test_export_and_enjoy(tmp_path: Path) -> None:
    env = make_dmc("cartpole-balance", seed=0, image_size=36, frame_stack=2, render_quality="fast", action_repeat=40)
    model = CRCSAC("CnnPolicy", env, buffer_size=50, policy_kwargs=POLICY_KWARGS, device="cpu")
    own = {"image_size": 36, "frame_stack": 2, "render_quality": "fast", "action_repeat": 40}
    run = tmp_path / "crc" / "dmc_pixels-cartpole-balance-v0_1"
    (run / "dmc_pixels-cartpole-balance-v0").mkdir(parents=True)
    arguments = {"algo": "crc", "env": "dmc_pixels/cartpole-balance-v0", "seed": 0, "n_timesteps": 25, "env_kwargs": own}
    (run / "dmc_pixels-cartpole-balance-v0" / "args.yml").write_text(json.dumps(arguments))
    (run / "dmc_pixels-cartpole-balance-v0" / "config.yml").write_text("{}")
    output, film = tmp_path / "policy.sb3crc", tmp_path / "film.mp4"
    done = CliRunner().invoke(app, ["export", str(run), str(output)])
    assert done.exit_code == 2 and "its training has not ended" in done.stderr
    model.save(run / "dmc_pixels-cartpole-balance-v0.zip")
    done = CliRunner().invoke(app, ["export", str(run), str(output)])
    assert done.exit_code == 0, done.stderr
    assert environment_of(output) == ("cartpole-balance", own)

    done = CliRunner().invoke(app, ["enjoy", str(output), "--episodes", "2", "--film", str(film)])
    assert done.exit_code == 0, done.stderr
    assert done.stdout.count("cartpole-balance, episode") == 2 and film.stat().st_size > 1_000
    expected, _ = evaluate_policy(
        model,
        make_vec_env(lambda: make_dmc("cartpole-balance", seed=0, **own), seed=0),
        n_eval_episodes=2,
        return_episode_rewards=True,
    )
    assert f"episode 1: {expected[1]:.1f}" in done.stdout  # type: ignore[index]

    path = rewritten(
        output, tmp_path / "other", environment='{"task": "cartpole-balance", "env_kwargs": {"distraction_data": "/"}}'
    )
    done = CliRunner().invoke(app, ["enjoy", str(path)])
    assert done.exit_code == 2 and "distraction_data is none of" in done.stderr
    env.close()
