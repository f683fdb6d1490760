"""A training that is stopped goes on to the end that it would have had, whatever stopped it."""

import csv
import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_crc import CRCSAC, AuxiliaryLossCallback, FrameReplayBuffer, PixelEncoder, make_dmc
from sb3_crc.checkpoints.callback import DONE, TrainingCheckpoint
from sb3_crc.checkpoints.signals import TrainingStopped
from sb3_crc.checkpoints.store import MANIFEST, CheckpointError, CheckpointStore
from tests.conftest import POLICY_KWARGS, ClockEnv, NoiseEnv

STEPS = 60
SETTINGS: dict[str, Any] = {
    "batch_size": 16,
    "buffer_size": 40,  # the ring wraps around
    "learning_starts": 20,
    "policy_kwargs": POLICY_KWARGS,
    "device": "cpu",
}


class StoppedError(RuntimeError):
    """What :class:`Stop` raises."""


class Stop(BaseCallback):
    """Ends the training as an error in the environment would."""

    def __init__(self, at: int | None):
        super().__init__()
        self.at = at

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            raise StoppedError
        return True


def cartpole(seed: int) -> gym.Env[Any, Any]:
    return Monitor(make_dmc("cartpole-swingup", seed=seed, image_size=36, render_quality="fast", action_repeat=50))


def train(
    folder: Path,
    *,
    seed: int = 0,
    stop: int | None = None,
    steps: int = STEPS,
    make_env: Any = cartpole,
    overlap: bool = False,
    **own: Any,
) -> CRCSAC:
    model = CRCSAC("CnnPolicy", make_env(seed), seed=seed, overlap=overlap, **SETTINGS)
    checkpoint = TrainingCheckpoint(folder, **{"every": 10, **own})
    try:
        model.learn(steps, callback=[checkpoint, Stop(stop)])
    except StoppedError:
        checkpoint.close()  # what a kill does to an unfinished one is another test's
    return model


def assert_equal(model: CRCSAC, other: CRCSAC) -> None:
    for name, value in model.policy.state_dict().items():
        assert th.equal(value, other.policy.state_dict()[name]), name
    assert [episode["r"] for episode in model.ep_info_buffer] == [episode["r"] for episode in other.ep_info_buffer]
    for name, values in model.replay_buffer.arrays().items():
        assert np.array_equal(values, other.replay_buffer.arrays()[name]), name
    assert (model.num_timesteps, model._n_updates) == (other.num_timesteps, other._n_updates)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> CRCSAC:
    return train(tmp_path_factory.mktemp("whole"))


@pytest.mark.parametrize("stops", [(15,), (47,), (12, 33, 59)])
def test_stopped_and_run_again_it_ends_the_same(stops: tuple[int, ...], whole: CRCSAC, tmp_path: Path) -> None:
    for number, stop in enumerate(stops):
        train(tmp_path, seed=number, stop=stop)  # only the first one's seed counts: later all comes from the checkpoint
        assert not (tmp_path / DONE).exists()
    assert_equal(train(tmp_path, seed=9), whole)
    assert (tmp_path / DONE).read_text() == "60\n"


def test_updates_made_during_steps_go_on_too(whole: CRCSAC, tmp_path: Path) -> None:
    for number, stop in enumerate((25, 47)):
        train(tmp_path, seed=number, stop=stop, overlap=True)
    assert_equal(train(tmp_path, seed=9, overlap=True), whole)


class Signal(BaseCallback):
    """Sends signals to this process."""

    def __init__(self, signum: int, at: int):
        super().__init__()
        self.signum, self.at = signum, at

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            os.kill(os.getpid(), self.signum)
        return True


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_and_stops(signum: int, whole: CRCSAC, tmp_path: Path) -> None:
    before = signal.getsignal(signum)
    model = CRCSAC("CnnPolicy", cartpole(0), seed=0, **SETTINGS)
    with pytest.raises(TrainingStopped, match=signal.Signals(signum).name) as stop:
        model.learn(STEPS, callback=[Signal(signum, 33), TrainingCheckpoint(tmp_path, every=10)])
    assert isinstance(stop.value, KeyboardInterrupt)
    assert CheckpointStore(tmp_path).names()[0] == "000000000033"  # not 30: nothing of what was done is lost
    assert signal.getsignal(signum) is before
    model = CRCSAC("CnnPolicy", cartpole(7), seed=7, **SETTINGS)
    assert_equal(model.learn(STEPS, callback=[Signal(signum, 0), TrainingCheckpoint(tmp_path, every=10)]), whole)


def test_a_signal_need_not_wait_for_long_updates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_crc.checkpoints.signals.GRACE", 0.2)
    model = CRCSAC("CnnPolicy", cartpole(0), seed=0, **{**SETTINGS, "initial_updates": 100_000})
    threading.Timer(6.0, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(TrainingStopped):
        model.learn(STEPS, callback=TrainingCheckpoint(tmp_path, every=10))
    assert 0 < model._n_updates < 100_000
    assert CheckpointStore(tmp_path).names()[0] == "000000000020"  # the last one before those updates
    TrainingCheckpoint(tmp_path)._take_lock()


def test_a_stock_algorithm_is_saved_while_checkpoints_are_made(tmp_path: Path) -> None:
    model = SAC(
        "CnnPolicy",
        NoiseEnv(channels=3),
        learning_starts=100,
        replay_buffer_class=FrameReplayBuffer,
        replay_buffer_kwargs={"frame_channels": 3},
        buffer_size=100,
        policy_kwargs={"features_extractor_class": PixelEncoder, "net_arch": [8]},
    )
    best = EvalCallback(NoiseEnv(channels=3), eval_freq=10, best_model_save_path=str(tmp_path), verbose=0, warn=False)
    model.learn(15, callback=[best, TrainingCheckpoint(tmp_path / "checkpoints", every=5)])
    assert SAC.load(tmp_path / "best_model").num_timesteps == 10


def test_it_costs_nothing_to_the_run(whole: CRCSAC, tmp_path: Path) -> None:
    """A run without checkpoints draws the same random numbers."""
    model = CRCSAC("CnnPolicy", cartpole(0), seed=0, **SETTINGS)
    assert_equal(model.learn(STEPS), whole)


def test_a_finished_run_can_be_prolonged(tmp_path: Path, whole: CRCSAC) -> None:
    train(tmp_path, steps=30)
    assert (tmp_path / DONE).exists()
    assert train(tmp_path, steps=STEPS).num_timesteps == STEPS


def test_only_the_newest_stay_and_segments_that_they_need(tmp_path: Path) -> None:
    train(tmp_path, keep=2)
    store = CheckpointStore(tmp_path)
    assert store.names() == ["000000000060", "000000000050"]
    needed = {name for checkpoint in store.names() for name in store._needed(checkpoint)}
    assert {path.name for path in store.segments.iterdir()} == needed
    assert not list(tmp_path.glob(".unfinished*"))


def damage(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))


@pytest.mark.parametrize("file", ["arrays.safetensors", "structure.json", "replay.npz", MANIFEST, "segment"])
def test_a_damaged_checkpoint_is_reported_and_the_one_before_used(file: str, tmp_path: Path, whole: CRCSAC) -> None:
    train(tmp_path, stop=45)
    store = CheckpointStore(tmp_path)
    newest, before = store.names()
    assert (newest, before) == ("000000000040", "000000000030")
    if file == "segment":  # one that only the newest needs
        (name,) = set(store._needed(newest)) - set(store._needed(before))
        damage(store.segments / name)
    elif file == MANIFEST:
        (tmp_path / newest / MANIFEST).write_text("{")
    else:
        damage(tmp_path / newest / file)
    with pytest.warns(UserWarning, match="000000000040 is damaged"):
        model = train(tmp_path, seed=5)
    assert_equal(model, whole)


def test_where_all_are_damaged_nothing_is_lost_silently(tmp_path: Path) -> None:
    train(tmp_path, stop=45)
    for name in CheckpointStore(tmp_path).names():
        (tmp_path / name / "structure.json").unlink()
    with (
        pytest.warns(UserWarning, match="is damaged"),
        pytest.raises(CheckpointError, match="all checkpoints in .* are damaged"),
    ):
        train(tmp_path)


def test_a_later_format_is_refused(tmp_path: Path) -> None:
    train(tmp_path, stop=45)
    manifest = tmp_path / "000000000040" / MANIFEST
    manifest.write_text(json.dumps({**json.loads(manifest.read_text()), "format": 99}))
    with pytest.raises(CheckpointError, match="has format 99, this version of sb3_crc reads up to 1"):
        train(tmp_path)


def test_a_folder_in_use_is_refused_with_its_owner(tmp_path: Path) -> None:
    CRCSAC("CnnPolicy", NoiseEnv(), **SETTINGS)
    first = TrainingCheckpoint(tmp_path)
    first._take_lock()
    with pytest.raises(ValueError, match=rf"in use by another training: .*{os.getpid()}"):
        train(tmp_path)
    first._lock.release()
    train(tmp_path, steps=10)


def test_other_networks_are_refused(tmp_path: Path) -> None:
    train(tmp_path, stop=45)
    model = CRCSAC("CnnPolicy", cartpole(0), **{**SETTINGS, "policy_kwargs": {**POLICY_KWARGS, "net_arch": [8]}})
    with pytest.raises(ValueError, match="policy is not the one that was saved"):
        model.learn(STEPS, callback=TrainingCheckpoint(tmp_path))


def test_environments_without_a_state_go_on_at_a_new_episode(tmp_path: Path) -> None:
    def clock(seed: int) -> gym.Env[Any, Any]:
        return Monitor(ClockEnv(terminates=False))

    train(tmp_path, stop=43, make_env=clock)
    with pytest.warns(UserWarning, match=r"no get_state.*not be bit for bit"):
        model = train(tmp_path, make_env=clock)
    assert model.num_timesteps == STEPS
    assert not model.replay_buffer.dones.all() and model.replay_buffer.full


def test_a_stock_algorithm_with_auxiliary_losses_goes_on_exactly(tmp_path: Path) -> None:
    def run(folder: Path, seed: int, stop: int | None) -> tuple[SAC, AuxiliaryLossCallback]:
        extractor = {
            "features_extractor_class": PixelEncoder,
            "features_extractor_kwargs": POLICY_KWARGS["features_extractor_kwargs"],
        }
        model = SAC(
            "CnnPolicy",
            cartpole(seed),
            replay_buffer_class=FrameReplayBuffer,
            replay_buffer_kwargs={"frame_channels": 3},
            action_noise=OrnsteinUhlenbeckActionNoise(np.zeros(1), 0.1 * np.ones(1)),
            seed=seed,
            **{**SETTINGS, "policy_kwargs": {"net_arch": [16], **extractor}},
        )
        auxiliary = AuxiliaryLossCallback(augmentation_kwargs={"pad": 1})
        checkpoint = TrainingCheckpoint(folder, every=10)
        try:
            model.learn(STEPS, callback=[auxiliary, Stop(stop), checkpoint])
        except StoppedError:
            checkpoint.close()
        return model, auxiliary

    whole, losses = run(tmp_path / "whole", 0, None)
    run(tmp_path / "stopped", 0, 45)
    again, losses_2 = run(tmp_path / "stopped", 8, None)
    for name, value in whole.policy.state_dict().items():
        assert th.equal(value, again.policy.state_dict()[name]), name
    for name, value in losses.learner.state()[1].items():
        assert th.equal(value, losses_2.learner.state()[1][name]), name


def test_files_of_the_log_go_on_where_the_checkpoint_was(tmp_path: Path) -> None:
    """What a stopped run wrote after its last checkpoint is cut off; all but times equals the uninterrupted run's."""

    def run(folder: Path, seed: int, stop: int | None) -> None:
        folder.mkdir(exist_ok=True)
        env = Monitor(cartpole(seed).env, str(folder / "monitor.csv"))
        model = CRCSAC("CnnPolicy", env, seed=seed, **SETTINGS)
        model.set_logger(configure(str(folder), ["csv", "json"]))
        evaluation = EvalCallback(cartpole(seed + 1), log_path=str(folder), n_eval_episodes=1, eval_freq=20, verbose=0)
        checkpoint = TrainingCheckpoint(folder / "checkpoints", every=10)
        try:
            model.learn(80, callback=[evaluation, Stop(stop), checkpoint], log_interval=1)
        except StoppedError:
            checkpoint.close()
        model.logger.close()

    def timeless(folder: Path) -> tuple[Any, ...]:
        with (folder / "progress.csv").open() as file:
            progress = [
                {key: value for key, value in row.items() if not key.startswith("time/") or "total" in key}
                for row in csv.DictReader(file)
            ]
        lines = [json.loads(line) for line in (folder / "progress.json").read_text().splitlines()]
        monitor = [line.rsplit(",", 1) for line in (folder / "monitor.csv").read_text().splitlines()[1:]]
        times = [float(time) for _, time in monitor[1:]]
        assert times == sorted(times)
        with np.load(folder / "evaluations.npz") as data:
            evaluations = {name: data[name].tolist() for name in data.files if "seconds" not in name}
        return (
            progress,
            [line["rollout/ep_rew_mean"] for line in lines if "rollout/ep_rew_mean" in line],
            [r for r, _ in monitor],
            evaluations,
        )

    run(tmp_path / "whole", 0, None)
    for seed, stop in ((0, 38), (4, 55), (5, None)):
        run(tmp_path / "stopped", seed, stop)
    whole, stopped = timeless(tmp_path / "whole"), timeless(tmp_path / "stopped")
    assert len(whole[0]) == 8 and len(whole[2]) == 5 and len(whole[3]["timesteps"]) == 4
    assert stopped == whole


@pytest.mark.slow  # each process imports everything
def test_environments_in_other_processes_go_on_with_their_files(tmp_path: Path) -> None:
    def run(folder: Path, seed: int, stop: int | None) -> None:
        env = make_vec_env(
            partial(make_dmc, "cartpole-swingup", image_size=36, render_quality="fast", action_repeat=50),
            n_envs=2,
            seed=seed,
            monitor_dir=str(folder),
            vec_env_cls=SubprocVecEnv,
        )
        model = CRCSAC("CnnPolicy", env, seed=seed, **SETTINGS)
        checkpoint = TrainingCheckpoint(folder / "checkpoints", every=10, monitor_dir=folder)
        try:
            model.learn(100, callback=[Stop(stop), checkpoint])
        except StoppedError:
            checkpoint.close()
        env.close()

    def episodes(folder: Path) -> list[list[str]]:
        files = [(folder / f"{rank}.monitor.csv").read_text().splitlines() for rank in (0, 1)]
        times = [[float(line.rsplit(",", 1)[1]) for line in lines[2:]] for lines in files]
        assert all(own == sorted(own) for own in times)
        return [[line.rsplit(",", 1)[0] for line in lines[1:]] for lines in files]

    run(tmp_path / "whole", 0, None)
    for seed, stop in ((0, 54), (4, 86), (5, None)):  # 54: each has ended one episode, which a new file would not show
        run(tmp_path / "stopped", seed, stop)
    assert [len(lines) for lines in episodes(tmp_path / "whole")] == [3, 3]
    assert episodes(tmp_path / "stopped") == episodes(tmp_path / "whole")


def test_bad_arguments_and_other_buffers_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="every=0 must be at least 1"):
        TrainingCheckpoint(tmp_path, every=0)
    with pytest.raises(ValueError, match="keep=0 must be at least 1"):
        TrainingCheckpoint(tmp_path, keep=0)
    model = SAC("CnnPolicy", NoiseEnv(), buffer_size=20, policy_kwargs={"net_arch": [4]})
    with pytest.raises(ValueError, match="the model has a ReplayBuffer: replay_buffer_class=FrameReplayBuffer"):
        model.learn(10, callback=TrainingCheckpoint(tmp_path))


class Full(OSError):
    pass


@pytest.mark.parametrize(
    "function", ["numpy.lib.format.write_array", "safetensors.torch.save_file", "numpy.savez", "os.replace"]
)
@pytest.mark.parametrize("call", [1, 3])
def test_a_training_outlives_a_disk_that_is_full(
    function: str, call: int, whole: CRCSAC, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At any file of any checkpoint: the user is told, the next checkpoint is whole, and the same script goes on from it."""
    from sb3_crc.checkpoints import tree

    calls = 0

    def failing(original: Any) -> Any:
        def wrapper(*args: Any, **kwargs: Any) -> Any:
            nonlocal calls
            calls += 1
            if calls == call:
                raise Full("no space left")
            return original(*args, **kwargs)

        return wrapper

    with monkeypatch.context() as patch:
        if function == "safetensors.torch.save_file":
            patch.setattr(tree, "save_file", failing(tree.save_file))
        else:
            module, _, name = function.rpartition(".")
            target = {"numpy.lib.format": np.lib.format, "numpy": np, "os": os}[module]
            patch.setattr(target, name, failing(getattr(target, name)))
        with pytest.warns(UserWarning, match="could not be written") as told:
            train(tmp_path, seed=0, stop=45)
    assert sum("could not be written: no space left. Training goes on" in str(one.message) for one in told) == 1
    assert CheckpointStore(tmp_path).names()[0] == "000000000040"
    assert_equal(train(tmp_path, seed=0), whole)


def test_a_disk_that_stays_full_is_told_of_at_the_end(whole: CRCSAC, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train(tmp_path, seed=0, stop=25)
    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", full)
        with pytest.warns(UserWarning, match="could not be written") as told:
            assert_equal(train(tmp_path, seed=1), whole)
    messages = [str(one.message) for one in told]
    assert (
        messages[-1]
        == f"4 checkpoints of this training could not be written; the last whole one is {tmp_path / '000000000020'}"
    )
    assert len([message for message in messages if "Training goes on, " in message]) == 4
    assert not (tmp_path / DONE).exists() and not list(tmp_path.glob(".*unfinished*"))
    assert CheckpointStore(tmp_path).names() == ["000000000020", "000000000010"]
    assert_equal(train(tmp_path, seed=2), whole)  # there is room again
    assert (tmp_path / DONE).exists()


def full(*args: Any, **kwargs: Any) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


SCRIPT = """
import sys, hashlib
from pathlib import Path
import torch as th
from stable_baselines3.common.callbacks import EvalCallback
from tests.checkpoints.test_callback import SETTINGS, cartpole
from sb3_crc import CRCSAC
from sb3_crc.checkpoints.callback import TrainingCheckpoint

th.set_num_threads(1)
model = CRCSAC("CnnPolicy", cartpole(0), seed=0, **SETTINGS)
evaluation = EvalCallback(cartpole(100), n_eval_episodes=1, eval_freq=50, verbose=0)
model.learn(300, callback=[evaluation, TrainingCheckpoint(sys.argv[1], every=20)])
digest = hashlib.sha256()
for name, value in model.policy.state_dict().items():
    digest.update(value.numpy().tobytes())
print(digest.hexdigest(), evaluation.evaluations_results, evaluation.evaluations_timesteps)
"""


@pytest.mark.slow
def test_kills_at_random_moments(tmp_path: Path) -> None:
    """SIGKILL, which nothing can catch, wherever it falls: also while a checkpoint is being written."""

    def start(folder: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", SCRIPT, str(tmp_path / folder)]
        return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2])

    begin = time.monotonic()
    whole, _ = start("whole").communicate()
    duration = time.monotonic() - begin
    random = np.random.default_rng()
    kills = 0
    for _ in range(30):
        process = start("killed")
        try:
            result, _ = process.communicate(timeout=float(random.uniform(0.3, 0.8)) * duration)
            break
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.communicate()
            kills += 1
    print(f"{kills} kills, {duration:.0f} s for the whole run")
    assert kills > 0 and whole
    assert result == whole
