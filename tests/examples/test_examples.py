"""The scripts in examples/: what each claims is so, and each runs as its users run it."""

import os
import re
import subprocess
import sys
import warnings
from collections.abc import Iterator
from itertools import pairwise
from math import log
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_crc import CRCSAC, AuxiliaryLossCallback, FrameReplayBuffer, PixelEncoder
from sb3_crc.configurations import read_settings
from tests.examples.conftest import EXAMPLES

ROOT = EXAMPLES.parent


@pytest.fixture
def short_warm_up(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The examples' settings, with updates from the 40th decision on."""
    import custom_image_env

    monkeypatch.setitem(custom_image_env.SMALL, "learning_starts", 40)
    return custom_image_env.SMALL


def printed_by_main(module: Any, *flags: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    monkeypatch.setattr(sys, "argv", [module.__file__, *flags])
    module.main()
    return capsys.readouterr().out


# -- custom_image_env.py -----------------------------------------------------------------------------------------------


def test_the_track_is_an_environment_as_gymnasium_and_sb3_want_it() -> None:
    from custom_image_env import TrackEnv

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*render modes due to the environment not having a spec.*")
        gymnasium_check_env(TrackEnv())
        sb3_check_env(TrackEnv())


def test_pictures_show_the_road_where_it_is_and_move() -> None:
    from custom_image_env import TrackEnv

    env = TrackEnv()
    seen = []
    for seed in range(3):
        frame, _ = env.reset(seed=seed)
        assert np.array_equal(frame, TrackEnv().reset(seed=seed)[0])
        seen.append(frame)
        for _ in range(8):
            frame, *_ = env.step(np.array([0.3, 1.0], np.float32))
            seen.append(frame)
        assert frame.std() > 30 and len(np.unique(frame.reshape(-1, 3), axis=0)) >= 5
        # the row of the car: grass is green, road is not, and where it begins and ends the environment's geometry knows
        size, row = env.size, round(0.75 * env.size)
        left = 9 * (0.5 - np.arange(size) / size)
        across = np.stack([-np.sin(env.heading) * left, np.cos(env.heading) * left])
        on_road = env._distance(env.position[:, None] + across) < env.HALF_WIDTH
        green = frame[row, :, 1].astype(int) > frame[row, :, 0].astype(int) + 50
        assert 8 < on_road.sum() < 32 and np.array_equal(green, ~on_road)
        bar = (frame[-1] == 250).all(axis=1).mean()
        assert bar == pytest.approx(env.speed / env.TOP_SPEED, abs=1.5 / size)
    assert all((here != there).any() for here, there in pairwise(seen))


def drive(look: bool, seeds: range) -> float:
    """Per cent of a lap, at full speed: by looking where the road goes in the picture, or with random steering."""
    from custom_image_env import TrackEnv

    env, total = TrackEnv(), 0.0
    for seed in seeds:
        frame, _ = env.reset(seed=seed)
        rng, ended = np.random.default_rng(seed), False
        while not ended:
            ahead = frame[round(0.45 * env.size)]  # 2.7 ahead of the car
            (road,) = np.nonzero(ahead[:, 1].astype(int) < ahead[:, 0].astype(int) + 50)
            offset = 0.5 - road.mean() / env.size if len(road) else 0.0
            steering = np.clip(6 * offset, -1, 1) if look else rng.uniform(-1, 1)
            frame, reward, terminated, truncated, _ = env.step(np.array([steering, 1.0]))
            total += reward
            ended = terminated or truncated
    return total / len(seeds)


def test_who_looks_gets_round_and_who_does_not_leaves_the_road() -> None:
    assert drive(look=True, seeds=range(5)) > 65
    assert drive(look=False, seeds=range(20)) < 25


def test_crcsac_learns_the_frames_from_the_stack(
    short_warm_up: dict[str, Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import custom_image_env

    made: list[CRCSAC] = []
    monkeypatch.setattr(custom_image_env, "CRCSAC", lambda *args, **kwargs: made.append(CRCSAC(*args, **kwargs)) or made[-1])
    output = printed_by_main(custom_image_env, "--steps", "44", monkeypatch=monkeypatch, capsys=capsys)
    assert re.search(r"per cent of a lap .*: \d+\.\d untrained, \d+\.\d trained", output)
    (model,) = made
    assert isinstance(model.replay_buffer, FrameReplayBuffer) and model.replay_buffer.frame_channels == 3
    assert model.observation_space.shape == (9, 40, 40) and model._n_updates == 4
    assert model.get_env().env_is_wrapped(Monitor) == [True]


@pytest.mark.long
def test_the_track_is_learned() -> None:
    """Random steering and gas make 9 per cent of a lap; with this seed 60 were measured."""
    from custom_image_env import SMALL, make_track

    model = CRCSAC("CnnPolicy", make_track(0), seed=0, device="cpu", **SMALL).learn(2_500)
    score, _ = evaluate_policy(model, make_track(1_000), n_eval_episodes=10)
    assert score > 40


# -- td3_and_tqc.py ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["TD3", "TQC"])
def test_the_callback_trains_what_actor_and_critic_of_a_stock_algorithm_see_through(
    name: str, short_warm_up: dict[str, Any]
) -> None:
    import td3_and_tqc

    model = td3_and_tqc.make_model(td3_and_tqc.algorithms()[name])
    callback = AuxiliaryLossCallback(td3_and_tqc.OBJECTIVES, augmentation_kwargs={"pad": 2})
    model.learn(44, callback=callback)
    assert callback.learner is not None and callback.learner.n_updates >= 3
    assert isinstance(model.actor.features_extractor, PixelEncoder)
    assert model.actor.features_extractor is model.critic.features_extractor

    def parts() -> Iterator[tuple[str, th.Tensor]]:
        return ((key, value.clone()) for key, value in model.policy.named_parameters() if "target" not in key)

    before = dict(parts())
    metrics = callback.learner.train()
    moved = {key for key, value in parts() if not value.equal(before[key])}
    extractor = {key for key in before if "features_extractor" in key}
    assert moved == extractor and len(moved) > 4
    assert {"representation/contrastive", "representation/reconstruction"} <= metrics.keys()


def test_both_are_reported(
    short_warm_up: dict[str, Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import td3_and_tqc

    output = printed_by_main(td3_and_tqc, "--steps", "44", monkeypatch=monkeypatch, capsys=capsys)
    assert re.findall(r"^(\w+): \d+ auxiliary updates", output, re.MULTILINE) == ["TD3", "TQC"]
    assert output.count(f"latents that tell nothing: {log(short_warm_up['batch_size']):.2f}") == 2


# -- reward_objective.py -----------------------------------------------------------------------------------------------


def test_the_dotted_path_makes_the_loss_which_trains_its_weights_and_is_logged(short_warm_up: dict[str, Any]) -> None:
    import reward_objective

    objectives = {"reward_objective.RewardPrediction": {"weight": 1.0, "hidden_dim": 24}}
    (fresh, _), (model, logged) = (reward_objective.train(steps, objectives) for steps in (1, 52))
    predictor = model.policy.objectives["RewardPrediction"].predictor
    assert predictor[0].out_features == 24
    before = fresh.policy.objectives["RewardPrediction"].predictor.state_dict()
    assert not any(value.equal(before[name]) for name, value in predictor.state_dict().items())
    assert {name: len(values) for name, values in logged.items()} == {"RewardPrediction": 11, "RewardPrediction_explained": 11}
    assert logged["RewardPrediction"][-1] < logged["RewardPrediction"][0]


def test_the_configuration_names_the_same_class() -> None:
    import reward_objective

    settings = read_settings(EXAMPLES / "reward_objective.yml", "rad", "dmc_pixels/walker-walk-v0")
    space = gym.spaces.Box(0, 255, (9, 64, 64), np.uint8)
    env = type("Still", (gym.Env,), {"observation_space": space, "action_space": gym.spaces.Box(-1, 1, (6,))})()
    for name in ("n_timesteps", "env_kwargs", "learning_rate"):
        del settings[name]
    model = CRCSAC(settings.pop("policy"), env, **settings)
    assert isinstance(model.policy.objectives["RewardPrediction"], reward_objective.RewardPrediction)


@pytest.mark.slow
def test_with_the_loss_rewards_are_foreseen() -> None:
    import reward_objective

    _, logged = reward_objective.train(700, {"reward_objective.RewardPrediction": 1.0})
    explained = logged["RewardPrediction_explained"]
    assert np.mean(explained[:20]) < 0.2 and np.mean(explained[-40:]) > 0.4


@pytest.mark.slow
def test_the_zoo_trains_with_the_configuration(tmp_path: Path) -> None:
    flags = ["--algo", "rad", "--env", "dmc_pixels/walker-walk-v0", "--conf-file", str(EXAMPLES / "reward_objective.yml")]
    small = ["batch_size:8", "learning_starts:20", "buffer_size:100", "env_kwargs:dict(image_size=64, render_quality='fast')"]
    short = ["-n", "24", "--eval-freq", "-1", "--device", "cpu", "-f", "logs", "-params", *small]
    run("-m", "sb3_crc.zoo", "train", *flags, *short, folder=tmp_path)
    model = CRCSAC.load(tmp_path / "logs" / "rad" / "dmc_pixels-walker-walk-v0_1" / "dmc_pixels-walker-walk-v0.zip")
    (adam,) = {int(state["step"]) for state in model.policy.encoder_optimizer.state.values()}
    assert model._n_updates == 4 and adam == 3  # lin_0.001: at the last update the rate is 0, and the objectives rest
    assert model.policy.objectives["RewardPrediction"].predictor[0].out_features == 64


# -- proprioception.py -------------------------------------------------------------------------------------------------


def test_what_the_policy_goes_by_is_found_out() -> None:
    import proprioception

    class Only:
        """Acts by its positions."""

        def predict(self, observation: dict[str, np.ndarray], deterministic: bool) -> tuple[np.ndarray, None]:
            return 2 * observation["position"], None

    moments = [{"pixels": np.full(3, i), "position": np.array([float(i)])} for i in range(2)]
    assert proprioception.dependence(Only(), moments) == {"pixels": 0.0, "position": 2.0}  # type: ignore[arg-type]


def test_joints_are_felt_and_the_ball_is_seen(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    import proprioception

    monkeypatch.setitem(proprioception.SMALL, "learning_starts", 32)
    made: list[CRCSAC] = []
    monkeypatch.setattr(proprioception, "CRCSAC", lambda *args, **kwargs: made.append(CRCSAC(*args, **kwargs)) or made[-1])
    output = printed_by_main(proprioception, "--steps", "36", monkeypatch=monkeypatch, capsys=capsys)
    (model,) = made
    assert set(model.observation_space.spaces) == {"pixels", "position", "velocity"}  # not where the ball is
    assert "heads see 36 numbers: a latent of 32 and 4 of proprioception" in output
    assert model._n_updates == 4 and model.replay_buffer.frame_channels == 3
    changes = dict(re.findall(r"with (\w+) of another moment the mean action changes by (\d\.\d+)", output))
    assert changes.keys() == {"pixels", "position", "velocity"} and float(changes["pixels"]) > 0


# -- As users run them -------------------------------------------------------------------------------------------------


def run(*arguments: str, folder: Path) -> str:
    variables = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(EXAMPLES)}
    done = subprocess.run([sys.executable, *arguments], cwd=folder, env=variables, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "steps", "last_line"),
    [
        ("custom_image_env.py", 310, r"per cent of a lap .* untrained, .* trained"),
        ("td3_and_tqc.py", 340, r"  reconstruction loss 0\.\d+"),
        ("reward_objective.py", 310, r"representation/RewardPrediction_explained: .* in the last"),
        ("proprioception.py", 210, r"with velocity of another moment the mean action changes by .*"),
    ],
)
def test_each_script_runs_from_anywhere(script: str, steps: int, last_line: str, tmp_path: Path) -> None:
    output = run(str(EXAMPLES / script), "--steps", str(steps), folder=tmp_path)
    assert re.fullmatch(last_line, output.splitlines()[-1])
    assert list(tmp_path.iterdir()) == []  # nothing is left behind


@pytest.mark.parametrize("script", sorted(path.name for path in EXAMPLES.glob("*.py")))
def test_each_is_short_and_says_how_to_run_it(script: str) -> None:
    text = (EXAMPLES / script).read_text()
    assert len(text.splitlines()) <= 120
    assert f"    python examples/{script} --steps " in text.split('"""')[1]
