"""A training state, taken in one run and set in another, makes the other go on as the first did."""

import copy
from collections import defaultdict, deque
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, EveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecEnv

from sb3_crc import CRCSAC, make_dmc
from sb3_crc.checkpoints.environments import set_vec_env_state, vec_env_state
from sb3_crc.checkpoints.training import callback_state, set_callback_state, set_training_state, training_state
from sb3_crc.checkpoints.tree import copied, is_plain, read_tree, write_tree
from tests.conftest import POLICY_KWARGS, NoiseEnv, make_model

STEPS, MIDDLE = 60, 35


class Snapshot(BaseCallback):
    """Takes the state, through files, and a copy of the buffer where the rollout at MIDDLE starts; or sets what was taken."""

    def __init__(self, root: BaseCallback, folder: Path, taken: Any):
        super().__init__()
        self.root, self.folder, self.taken = root, folder, taken
        self.buffer: Any = None

    def _on_training_start(self) -> None:
        if self.taken is not None:
            self.model.replay_buffer = copy.deepcopy(self.taken)
            set_training_state(self.model, self.root, read_tree(self.folder))

    def _on_rollout_start(self) -> None:
        if self.model.num_timesteps == MIDDLE and self.taken is None:
            write_tree(training_state(self.model, self.root), self.folder)
            self.buffer = copy.deepcopy(self.model.replay_buffer)

    def _on_step(self) -> bool:
        return True


class Actions(BaseCallback):
    """Everything that happens."""

    def __init__(self) -> None:
        super().__init__()
        self.seen = {}  # not plain: its values are arrays of objects

    def _on_step(self) -> bool:
        self.seen[self.num_timesteps] = np.concatenate([self.locals["actions"].ravel(), self.locals["rewards"].ravel()])
        return True


def decisions(task: str, seed: int) -> gym.Env[Any, Any]:
    return Monitor(make_dmc(task, seed=seed, image_size=36, render_quality="fast", action_repeat=40 if "cart" in task else 20))


def run(make_env: Any, folder: Path, *, restore: Any = None, seed: int = 0, algorithm: Any = CRCSAC, **kwargs: Any) -> Any:
    th.manual_seed(seed)
    env = make_env(seed)
    evaluation = EvalCallback(make_env(seed + 100), n_eval_episodes=1, eval_freq=20, verbose=0)
    actions = Actions()
    root = CallbackList([evaluation, EveryNTimesteps(10, Actions()), actions])
    snapshot = Snapshot(root, folder, restore)
    root.callbacks.append(snapshot)
    settings: dict[str, Any] = {"batch_size": 16, "buffer_size": 50, "learning_starts": 20, "policy_kwargs": POLICY_KWARGS}
    model = algorithm("CnnPolicy", env, seed=seed, device="cpu", **{**settings, **kwargs})
    model.set_logger(configure(str(folder / f"log{seed}"), ["csv"]))
    model.learn(STEPS, callback=root, log_interval=1)
    return model, evaluation, actions.seen, snapshot.buffer


def assert_equal_runs(one: Any, other: Any) -> None:
    (model, evaluation, seen, _), (model_2, evaluation_2, seen_2, _) = one, other
    late = {step: values for step, values in seen.items() if step > MIDDLE}
    assert late and all(np.array_equal(values, seen_2[step]) for step, values in late.items())
    for name, value in model.policy.state_dict().items():
        assert th.equal(value, model_2.policy.state_dict()[name]), name
    assert evaluation.evaluations_results == evaluation_2.evaluations_results
    assert evaluation.evaluations_timesteps == evaluation_2.evaluations_timesteps
    assert evaluation.n_calls == evaluation_2.n_calls == STEPS
    assert list(model.ep_info_buffer) != [] and [e["r"] for e in model.ep_info_buffer] == [
        e["r"] for e in model_2.ep_info_buffer
    ]
    for name, values in model.replay_buffer.arrays().items():
        assert np.array_equal(values, model_2.replay_buffer.arrays()[name]), name


@pytest.mark.parametrize("task", ["cartpole-swingup", "finger-spin"])
def test_real_tasks_go_on_exactly(task: str, tmp_path: Path) -> None:
    def make_env(seed: int) -> gym.Env[Any, Any]:
        return decisions(task, seed)

    whole = run(make_env, tmp_path)
    resumed = run(make_env, tmp_path, restore=whole[-1], seed=7)  # another seed: everything comes from the state
    assert_equal_runs(whole, resumed)


def arrays_and_lists(tree: Any) -> list[Any]:
    if isinstance(tree, dict):
        return [part for value in tree.values() for part in arrays_and_lists(value)]
    if isinstance(tree, list | tuple | deque):
        return [tree] * isinstance(tree, list | deque) + [part for value in tree for part in arrays_and_lists(value)]
    return [tree] if isinstance(tree, np.ndarray | th.Tensor) else []


def test_a_state_shares_nothing_with_the_training(tmp_path: Path) -> None:
    """It is written by another thread while the training goes on."""

    class Compare(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_start(self) -> None:
            if self.num_timesteps == 25:
                self.state = training_state(self.model, self.locals["callback"])
                self.before = copied(self.state)

    compare = Compare()
    env = decisions("cartpole-swingup", 0)
    settings: dict[str, Any] = {"batch_size": 16, "buffer_size": 50, "learning_starts": 20, "policy_kwargs": POLICY_KWARGS}
    evaluation = EvalCallback(decisions("cartpole-swingup", 1), n_eval_episodes=1, eval_freq=20, verbose=0)
    CRCSAC("CnnPolicy", env, seed=0, device="cpu", **settings).learn(40, callback=[evaluation, compare])
    now, then = arrays_and_lists(compare.state), arrays_and_lists(compare.before)
    assert len(now) == len(then) > 60
    for one, other in zip(now, then, strict=True):
        if isinstance(one, list | deque):
            assert repr(one) == repr(other)
        else:
            assert np.array_equal(np.asarray(one), np.asarray(other))


def test_trees_survive_files(tmp_path: Path) -> None:
    tree = {
        "none": None,
        3: [1, 2.5, float("inf"), "text", True],
        "tuple": (1, (2, np.arange(6, dtype=np.uint8).reshape(2, 3))),
        "deque": deque([{"r": 1.5}], maxlen=4),
        "scalar": np.float32(0.1),
        "empty": np.empty((0, 3), np.uint32),
        "tensor": th.arange(24.0).view(1, 2, 3, 4).contiguous(memory_format=th.channels_last),
        "large": 2**100,
        "no dimension": np.array(2.5),
        "a/b": np.zeros(2),
        "a": {"b": np.ones(2), 3: np.ones(3), "3": np.zeros(3)},
    }
    assert is_plain(tree)
    write_tree(tree, tmp_path)
    again = read_tree(tmp_path)
    assert repr(again) == repr(tree)
    assert again["tensor"].is_contiguous(memory_format=th.channels_last)
    assert again["deque"].maxlen == 4 and type(again["scalar"]) is np.float32 and again["empty"].dtype == np.uint32
    assert not any(path.suffix in (".pkl", ".pt") for path in tmp_path.iterdir())


def test_what_is_no_plain_data_is_named(tmp_path: Path) -> None:
    assert not is_plain({"a": [object()]}) and not is_plain(np.array([None])) and not is_plain(np.str_("text"))
    with pytest.raises(TypeError, match="/a/1 is object, which is no plain data"):
        write_tree({"a": [1, object()]}, tmp_path)


@pytest.mark.parametrize("exact", [True, False])
def test_a_seed_for_the_next_reset_is_part_of_the_state(exact: bool) -> None:
    """Evaluation environments are often saved before their first episode."""

    def environment(seed: int) -> VecEnv:
        make = partial(make_dmc, "reacher-easy", seed=seed, image_size=36, render_quality="fast") if exact else NoiseEnv
        return make_vec_env(make, seed=seed)

    saved, other = environment(3), environment(4)
    other.reset()
    state = vec_env_state(saved)
    if exact:
        assert set_vec_env_state(other, state)
    else:
        with pytest.warns(UserWarning, match="no get_state"):
            set_vec_env_state(other, state)
    first = saved.reset()
    assert np.array_equal(other.reset(), first)
    assert not np.array_equal(environment(4).reset(), first)


class Pair(NamedTuple):
    first: int
    second: int


class Keeping(BaseCallback):
    """Keeps what plain types are the base of, and what is not plain."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: dict[str, int] = defaultdict(int)
        self.pair = Pair(0, 0)
        self.name = np.str_("")

    def _on_step(self) -> bool:
        return True


def test_attributes_of_callbacks_keep_their_types(tmp_path: Path) -> None:
    callback, other = Keeping(), Keeping()
    callback.counts["steps"] += 3
    callback.pair, callback.name = Pair(1, 2), np.str_("kept by nobody")
    write_tree(callback_state(callback), tmp_path)
    set_callback_state(other, read_tree(tmp_path))
    assert (other.counts, other.pair, other.name) == ({"steps": 3}, Pair(1, 2), "")
    assert other.counts["updates"] == 0 and other.pair.second == 2
    other.counts["steps"] += 1
    assert callback.counts["steps"] == 3


NOISE = NormalActionNoise(np.zeros(2), np.ones(2))


@pytest.mark.parametrize(
    ("saved", "own", "message"),
    [
        ({}, {"ent_coef": 0.1}, "ent_coef_optimizer: there is none"),
        ({"ent_coef": 0.1}, {}, "ent_coef_optimizer: there is none"),
        ({}, {"action_noise": NOISE}, "the action noise .* is not of the kind"),
        ({"action_noise": NOISE}, {}, "the action noise None is not of the kind"),
    ],
)
def test_what_does_not_fit_is_named(saved: dict[str, Any], own: dict[str, Any], message: str) -> None:
    state = training_state(make_model(**saved), Keeping())
    with pytest.raises(ValueError, match=message):
        set_training_state(make_model(**own), Keeping(), state)
