"""Rollouts: what is in them, and when they are used again."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
import yaml
from stable_baselines3 import SAC
from stable_baselines3.common.preprocessing import preprocess_obs

from sb3_crc import CRCSAC, make_dmc
from sb3_crc.analysis.networks import encode, min_q_values, reconstruct, untrained_extractor
from sb3_crc.analysis.policies import SavedPolicy, find_policies, unique_names
from sb3_crc.analysis.rollouts import FOLDER, SEED, Rollout, make_environment, rollout_of
from sb3_crc.analysis.saliency import q_saliency
from sb3_crc.experiments.runs import Run
from tests.analysis.conftest import ENV_KWARGS, NOISE, make_model, make_run
from tests.conftest import POLICY_KWARGS


def rolled(run: Path, **options: int) -> tuple[Rollout, list[str]]:
    said: list[str] = []
    (policy,) = find_policies([run])
    return rollout_of(policy, **{"decisions": 30, "episodes": 2, **options}, report=said.append), said


@pytest.mark.parametrize("preset", ["crc", "rad", "sac"])
def test_a_rollout_holds_what_the_networks_say(runs: dict[str, Path], preset: str) -> None:
    rollout, _ = rolled(runs[preset])
    (policy,) = find_policies([runs[preset]])
    model = policy.load()
    assert rollout.observations.shape == (50, 6, 36, 36) and rollout.observations.dtype == np.uint8  # two whole episodes
    assert rollout.episodes.tolist() == [0] * 25 + [1] * 25 and rollout.steps.tolist() == [*range(25)] * 2
    assert np.array_equal(rollout.newest_frames, rollout.observations[:, 3:])

    actions, _ = model.predict(rollout.observations, deterministic=True)
    assert np.allclose(rollout.actions, actions, atol=1e-5)
    tensor = th.from_numpy(rollout.observations)
    with th.no_grad():
        values = th.cat(model.critic(tensor, th.from_numpy(rollout.actions)), dim=1).min(dim=1).values.numpy()
        features = model.critic.extract_features(tensor, model.critic.features_extractor)
        again = min_q_values(model, preprocess_obs(tensor, model.observation_space), th.from_numpy(rollout.actions))  # type: ignore[arg-type]
    assert np.allclose(rollout.values, values, atol=1e-4) and np.allclose(again.numpy(), values, atol=1e-4)
    assert np.allclose(rollout.latents, features.numpy(), atol=1e-5)
    assert rollout.latents.shape[1] == (24 if preset == "sac" else 16) and rollout.latents.std() > 0

    assert rollout.returns[0] == pytest.approx(rollout.rewards[:25].sum())
    discounted = (0.9 ** np.arange(25)) @ rollout.rewards[25:]
    assert rollout.discounted_returns[25] == pytest.approx(discounted) and rollout.rewards.max() > 0
    assert rollout.about["environment_steps"] == 40 * 40 and rollout.about["frame_channels"] == 3


def test_physics_is_named_and_belongs_to_the_observation(runs: dict[str, Path]) -> None:
    rollout, _ = rolled(runs["crc"])
    state = dict(zip(rollout.physics_names, rollout.physics.T, strict=True))
    assert list(state) == [
        "position[0]", "position[1]", "position[2]", "velocity[0]", "velocity[1]",
        "qpos.slider", "qpos.hinge_1", "qvel.slider", "qvel.hinge_1",
    ]  # fmt: skip
    assert np.allclose(state["position[1]"], np.cos(state["qpos.hinge_1"])) and np.allclose(
        state["velocity[0]"], state["qvel.slider"]
    )
    assert np.array_equal(state["position[0]"], state["qpos.slider"]) and state["qpos.slider"].std() > 0
    assert np.count_nonzero(rollout.physics[0] != rollout.physics[25]) > 0


def test_all_policies_of_a_task_meet_the_same_initial_states(runs: dict[str, Path]) -> None:
    one, other = rolled(runs["crc"])[0], rolled(runs["sac"])[0]
    for row in (0, 25):
        assert np.array_equal(one.observations[row], other.observations[row])
        assert np.array_equal(one.physics[row], other.physics[row])
    assert not np.array_equal(one.physics[24], other.physics[24])


def test_a_rollout_is_read_again_until_model_or_settings_change(tmp_path: Path, runs: dict[str, Path]) -> None:
    run = tmp_path / "crc" / "run_1"
    shutil.copytree(runs["crc"], run, ignore=shutil.ignore_patterns(FOLDER))
    model = Run(run).model
    first, said = rolled(run)
    assert "rolled in" in said[0]
    (kept,) = (run / FOLDER).iterdir()
    again, said = rolled(run)
    assert f"from {kept}" in said[0]
    assert np.array_equal(first.latents, again.latents) and again.about == first.about

    assert "rolled in" in rolled(run, episodes=3)[1][0]  # another file beside it
    assert len(list((run / FOLDER).iterdir())) == 2 and "from" in rolled(run)[1][0]

    kept.write_bytes(kept.read_bytes()[:5000])
    assert "rolled in" in rolled(run)[1][0] and "from" in rolled(run)[1][0]

    shutil.copy(Run(runs["crc_4"]).model, model)
    other, said = rolled(run)
    assert "rolled in" in said[0] and not np.array_equal(other.latents, first.latents)
    assert len(list((run / FOLDER).iterdir())) == 2  # in the place of the one that it outdates


def test_a_rollout_that_cannot_be_kept_is_used_all_the_same(tmp_path: Path, runs: dict[str, Path]) -> None:
    run = tmp_path / "crc" / "run_1"
    shutil.copytree(runs["crc"], run, ignore=shutil.ignore_patterns(FOLDER))
    (run / FOLDER).write_text("a file where the folder should be")
    rollout, said = rolled(run)
    assert len(rollout) == 50 and "is not kept" in said[-1]


def test_an_environment_without_physics_and_one_of_another_shape(tmp_path: Path) -> None:
    run = make_run(tmp_path / "one", "rad", env_id=NOISE, env_kwargs={"size": 36, "channels": 3}, train=0)
    make_model("rad", 0, NOISE, {}).learn(5).save(Run(run).model)  # trained on 9 x 40 x 40
    with pytest.raises(ValueError, match=r"\(3, 36, 36\)"):
        rolled(run)
    good = make_run(tmp_path / "two", "rad", env_id=NOISE, env_kwargs={})
    rollout, _ = rolled(good)
    assert rollout.physics.shape == (30, 0) and rollout.physics_names.size == 0 and rollout.episodes.max() == 2
    again, _ = rolled(good, episodes=4)  # random frames, so equal only if the seed reaches the environment
    assert np.array_equal(again.observations[:10], rollout.observations[:10])


@pytest.mark.parametrize(
    ("name", "value"), [("env_wrapper", ["a.Wrapper"]), ("frame_stack", 4), ("vec_env_wrapper", "a.B"), ("normalize", True)]
)
def test_an_environment_that_rl_zoo3_has_wrapped_is_not_taken_for_another(tmp_path: Path, name: str, value: Any) -> None:
    run = Run(make_run(tmp_path, "rad", train=0))
    (config,) = run.folder.glob("*/config.yml")
    config.write_text(yaml.dump({"env_kwargs": ENV_KWARGS, name: value}))
    with pytest.raises(ValueError, match=f"was trained with {name}="):
        make_environment(run, 0)


def test_what_the_decoder_paints_is_a_picture(runs: dict[str, Path]) -> None:
    policies = {preset: find_policies([runs[preset]])[0].load() for preset in ("crc", "rad", "sac")}
    rollout, _ = rolled(runs["crc"])
    painted = reconstruct(policies["crc"], rollout.observations)
    assert painted is not None and painted.shape == (50, 6, 30, 30) and 0 <= painted.min() < painted.max() <= 1
    env = make_dmc("cartpole-balance", **ENV_KWARGS)
    objectives = {"reconstruction": {"weight": 1.0, "standardize": True, "half_size": True}}
    standardized = CRCSAC("CnnPolicy", env, objectives=objectives, policy_kwargs=POLICY_KWARGS, buffer_size=10, device="cpu")
    painted = reconstruct(standardized, rollout.observations)
    assert painted is not None and painted.shape == (50, 6, 30, 30)
    seen = rollout.observations[:, :, 3:33, 3:33].mean() / 255  # what is put back: the mean image
    assert painted.mean() == pytest.approx(seen, rel=0.15) and seen > 0.1
    assert reconstruct(policies["rad"], rollout.observations) is None
    assert reconstruct(policies["sac"], rollout.observations) is None


def test_an_untrained_encoder_has_the_architecture_and_other_weights(runs: dict[str, Path]) -> None:
    rollout, _ = rolled(runs["crc"])
    for preset in ("crc", "sac"):
        model = find_policies([runs[preset]])[0].load()
        drawn = [encode(model, rollout.observations, untrained_extractor(model, seed)) for seed in (0, 0, 1)]
        assert drawn[0].shape == encode(model, rollout.observations).shape
        assert np.array_equal(drawn[0], drawn[1]) and not np.allclose(drawn[0], drawn[2])
        assert not np.allclose(drawn[0], encode(model, rollout.observations))
        with pytest.raises(ValueError, match=r"observations \(3, 36, 36\).*sees \(6, 36, 36\)"):
            encode(model, rollout.newest_frames)


def test_checkpoints_stand_before_the_final_policy(tmp_path: Path) -> None:
    run = make_run(tmp_path, "crc", 3, train=0)
    with pytest.raises(FileNotFoundError, match=r"has no final policy: .*-v0.zip is missing"):
        find_policies([run])
    with pytest.raises(ValueError, match="no rl_model_\\*_steps.zip in .*--save-freq"):
        find_policies([run], checkpoints=True)
    for name in ("rl_model_1000_steps.zip", "rl_model_200_steps.zip", "best_model.zip", Run(run).model.name):
        (run / name).touch()
    found = find_policies([tmp_path, run / "rl_model_200_steps.zip", run / "best_model.zip"], checkpoints=True)
    assert [policy.file.name for policy in found] == [
        "rl_model_200_steps.zip", "rl_model_1000_steps.zip", Run(run).model.name, "best_model.zip",
    ]  # fmt: skip
    assert [policy.name for policy in found] == [
        "crc, seed 3, 8000 steps",
        "crc, seed 3, 40000 steps",
        "crc, seed 3",
        "crc, seed 3, best_model",
    ]
    assert [policy.name for policy in find_policies([run])] == ["crc, seed 3"]
    twice = [
        SavedPolicy(Run(run), Run(run).model),
        found[-1],
        SavedPolicy(Run(make_run(tmp_path / "b", "crc", 3, train=0)), run),
    ]
    assert len(set(unique_names(twice[:2]))) == 2


def test_what_is_no_policy_is_named(tmp_path: Path, runs: dict[str, Path]) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "model.zip").touch()
    (tmp_path / "notes.txt").touch()
    for path, error, message in (
        (tmp_path / "nowhere", FileNotFoundError, "nowhere does not exist"),
        (tmp_path / "empty", FileNotFoundError, "no run of train.py in .*empty"),
        (tmp_path / "empty" / "model.zip", FileNotFoundError, "empty is no run of train.py"),
        (tmp_path / "notes.txt", ValueError, "notes.txt is no saved model"),
    ):
        with pytest.raises(error, match=message):
            find_policies([path])
    stranger = make_run(tmp_path / "ppo", "ppo", train=0)
    shutil.copy(Run(runs["crc"]).model, Run(stranger).model)
    with pytest.raises(ValueError, match="unknown preset of .*'ppo'"):
        find_policies([stranger])[0].load()
    Run(stranger).model.write_text("no zip")
    broken = make_run(tmp_path / "broken", "crc", train=0)
    Run(broken).model.write_text("no zip")
    with pytest.raises(ValueError, match="zip"):
        find_policies([broken])[0].load()


def test_policies_that_see_no_pictures_are_refused(tmp_path: Path) -> None:
    run = make_run(tmp_path, "state_sac", env_kwargs={**ENV_KWARGS, "observation": "state"}, train=0)
    SAC("MlpPolicy", make_dmc("cartpole-balance", observation="state"), device="cpu").save(Run(run).model)
    with pytest.raises(ValueError, match="does not see pictures"):
        find_policies([run])[0].load()


def test_vectors_beside_the_picture_reach_the_value_but_not_the_latent(tmp_path: Path) -> None:
    env_kwargs = {**ENV_KWARGS, "observation": "dict"}
    run = make_run(tmp_path, "rad", env_kwargs=env_kwargs, train=0)
    env = make_dmc("cartpole-balance", **env_kwargs)
    CRCSAC("MultiInputPolicy", env, policy_kwargs=POLICY_KWARGS, buffer_size=10, device="cpu").save(Run(run).model)
    rollout, _ = rolled(run)
    model = find_policies([run])[0].load()
    assert rollout.latents.shape == (50, 16) and rollout.observations.shape == (50, 6, 36, 36)
    observation, _ = env.reset(seed=SEED)
    tensors, _ = model.policy.obs_to_tensor(observation)
    q_values = th.cat(model.critic(tensors, th.from_numpy(rollout.actions[:1])), dim=1)
    assert rollout.values[0] == pytest.approx(q_values.min().item(), abs=1e-4)
    with pytest.raises(ValueError, match="policies that see pictures alone"):
        q_saliency(model, rollout.observations, rollout.actions, 3)
