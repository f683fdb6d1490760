"""The zoo with our algorithms, on real dm_control."""

import errno
import os
import signal
import subprocess
import sys
import time
from argparse import Namespace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import rl_zoo3
import yaml
from stable_baselines3.common.monitor import Monitor

from sb3_crc import CRCSAC, PRESETS, QBiasEvalCallback
from sb3_crc.envs.rendering import RenderingUnavailable
from sb3_crc.zoo import CRCExperimentManager, preset_class, register
from sb3_crc.zoo.resume import Plan
from tests.conftest import POLICY_KWARGS, NoiseEnv, make_model

ROOT = Path(__file__).parent.parent
ENV = "dmc_pixels/cartpole-swingup-v0"


def command(folder: Path, *flags: str, algo: str = "crc") -> list[str]:
    settings = ["--conf-file", str(ROOT / "tests" / "tiny.yml"), "-f", str(folder), "--seed", "1", "--device", "cpu"]
    return [sys.executable, "train.py", "--algo", algo, "--env", ENV, *settings, *flags]


def environment() -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1"}


def test_train_py_trains_on_real_dm_control_and_leaves_its_results(tmp_path: Path) -> None:
    flags = ["--eval-freq", "130", "--eval-episodes", "1", "--progress", "--verbose", "0", "-params", "gradient_steps:2"]
    run = subprocess.run(command(tmp_path, *flags), cwd=ROOT, env=environment(), capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-2000:]
    folder = tmp_path / "crc" / "dmc_pixels-cartpole-swingup-v0_1"
    final = folder / "dmc_pixels-cartpole-swingup-v0.zip"
    for name in ("best_model.zip", "progress.csv", "learning_curve.png", "policy.mp4"):
        assert (folder / name).stat().st_size > 100, name
    assert list(folder.glob("events.out.tfevents.*"))
    config = yaml.load((folder / "dmc_pixels-cartpole-swingup-v0" / "config.yml").read_text(), yaml.UnsafeLoader)
    assert config["gradient_steps"] == 2
    with np.load(folder / "evaluations.npz") as evaluations:
        assert evaluations["ep_lengths"].tolist() == [[125]]  # decisions: 1000 environment steps at repeat 8
    last_line = run.stdout.strip().splitlines()[-1]
    assert last_line.startswith(f"Training finished. To go on: {sys.executable} train.py --algo crc")
    assert f"-i {final}" in last_line

    model = CRCSAC.load(final)
    assert model._n_updates == 2 * 20
    assert model.policy.key_encoder.input_shape == (6, 30, 30)


@pytest.mark.slow
def test_ctrl_c_writes_everything_and_says_how_to_go_on(tmp_path: Path) -> None:
    flags = ["-n", "100000", "--eval-freq", "130", "--eval-episodes", "1", "--verbose", "0"]
    run = subprocess.Popen(command(tmp_path, *flags), cwd=ROOT, env=environment(), stdout=subprocess.PIPE, text=True)
    folder = tmp_path / "crc" / "dmc_pixels-cartpole-swingup-v0_1"
    deadline = time.time() + 100
    while not (folder / "best_model.zip").exists():
        assert run.poll() is None and time.time() < deadline
        time.sleep(0.2)
    run.send_signal(signal.SIGINT)
    output, _ = run.communicate(timeout=100)
    assert run.returncode == 0
    final = folder / "dmc_pixels-cartpole-swingup-v0.zip"
    for path in (final, folder / "learning_curve.png", folder / "policy.mp4", folder / "progress.csv"):
        assert path.stat().st_size > 100, path
    last_line = output.strip().splitlines()[-1]
    assert "stopped at" in last_line

    # and the line is true
    go_on = last_line.partition("To go on: ")[2].split()
    rest = ["-n", "130", "-f", str(tmp_path), "--eval-freq", "-1", "--seed", "2", "--verbose", "0"]
    resumed = subprocess.run([*go_on[:-2], *rest], cwd=ROOT, env=environment(), capture_output=True, text=True)
    assert resumed.returncode == 0, resumed.stderr[-2000:]
    assert "Loading pretrained agent" in resumed.stdout
    before = CRCSAC.load(final)._n_updates
    assert CRCSAC.load(tmp_path / "crc" / "dmc_pixels-cartpole-swingup-v0_2" / final.name)._n_updates == before + 10


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_are_algorithms_whose_zips_are_crcsacs(preset: str, tmp_path: Path) -> None:
    register()
    algorithm = rl_zoo3.ALGOS[preset]
    assert issubclass(algorithm, CRCSAC)
    small = {"buffer_size": 50, "batch_size": 8, "policy_kwargs": POLICY_KWARGS}
    model = algorithm("CnnPolicy", NoiseEnv(), **small)
    for name, value in {**PRESETS[preset], **small}.items():
        assert getattr(model, name) == value
    model.save(tmp_path / "model.zip")
    for loaded in (CRCSAC.load(tmp_path / "model.zip"), algorithm.load(tmp_path / "model.zip")):
        assert loaded.objectives == model.objectives
        assert loaded.policy.state_dict().keys() == model.policy.state_dict().keys()


def test_arguments_win_over_the_preset() -> None:
    model = preset_class("rad")("CnnPolicy", NoiseEnv(), objectives={"contrastive": 1.0}, buffer_size=50)
    assert model.objectives == {"contrastive": 1.0}
    assert model.augmentation == "random_crop"


def test_yaml_env_kwargs_reach_the_evaluation_environment(tmp_path: Path) -> None:
    """rl_zoo3 2.9.2 passes them to the training environment only."""
    register()
    config = str(ROOT / "tests" / "tiny.yml")
    env = "dmc_pixels/cartpole-balance-v0"
    manager = CRCExperimentManager(Namespace(), "crc", env, str(tmp_path), eval_freq=10, config=config, verbose=0)
    model, _ = manager.setup_experiment()
    try:
        evaluation = manager.create_envs(1, eval_env=True)
        assert evaluation.observation_space == model.observation_space
        assert evaluation.observation_space.shape == (6, 36, 36)
        assert evaluation.get_attr("action_repeat") == model.env.get_attr("action_repeat") == [40]
        evaluation.close()
    finally:
        model.env.close()


def test_runs_that_begin_at_the_same_moment_have_a_folder_each(tmp_path: Path) -> None:
    """rl_zoo3 names a run's folder long before it makes it."""
    managers = [CRCExperimentManager(Namespace(), "crc", ENV, str(tmp_path), verbose=0) for _ in range(3)]
    assert len({manager.save_path for manager in managers}) == 1
    for manager in managers:
        manager.create_log_folder()
    name = "dmc_pixels-cartpole-swingup-v0"
    runs = [tmp_path / "crc" / f"{name}_{number}" for number in (1, 2, 3)]
    assert [Path(manager.save_path) for manager in managers] == runs
    assert [Path(manager.params_path) for manager in managers] == [run / name for run in runs]
    assert all((run / name).is_dir() for run in runs)


def test_a_configuration_may_hold_what_one_preset_has_beside_the_others(tmp_path: Path) -> None:
    shared = {"n_timesteps": 10, "policy": "CnnPolicy", "batch_size": 8, "tau": 0.1, "gamma": 0.9}
    config = tmp_path / "config.yml"
    config.write_text(yaml.safe_dump({ENV: {**shared, "presets": {"crc": {"batch_size": 16, "tau": 0.2}}}}))

    def read(algo: str, **given: float) -> dict[str, Any]:
        args = (Namespace(), algo, ENV, str(tmp_path))
        consumed, saved = CRCExperimentManager(*args, config=str(config), hyperparams=given, verbose=0).read_hyperparameters()
        assert consumed == saved
        return saved

    assert read("rad") == shared
    assert read("crc") == {**shared, "batch_size": 16, "tau": 0.2}
    assert read("crc", tau=0.3) == {**shared, "batch_size": 16, "tau": 0.3}  # -params wins
    config.write_text(yaml.safe_dump({ENV: {**shared, "presets": {"carl": {}}}}))
    with pytest.raises(ValueError, match="unknown preset 'carl'; did you mean 'curl'"):
        read("rad")


def test_a_callback_that_cannot_work_is_refused_before_anything_is_made(tmp_path: Path) -> None:
    config = {"n_timesteps": 10, "policy": "CnnPolicy", "callback": [{"rl_zoo3.callbacks.ParallelTrainCallback": {}}]}
    (tmp_path / "config.yml").write_text(yaml.safe_dump({ENV: config}))
    manager = CRCExperimentManager(Namespace(), "crc", ENV, str(tmp_path), config=str(tmp_path / "config.yml"), verbose=0)
    with pytest.raises(ValueError, match="ParallelTrainCallback.*'crc'.*remove"):
        manager.setup_experiment()


def test_without_a_loadable_best_model_the_final_one_is_filmed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    manager = CRCExperimentManager(Namespace(), "crc", ENV, str(tmp_path), verbose=0)
    folder = Path(manager.save_path)
    folder.mkdir(parents=True)
    (folder / "best_model.zip").write_bytes(b"half of a zip")
    filmed = []

    def film(policy: object, environment: object, path: Path) -> None:
        filmed.append(policy)
        path.write_bytes(b"film")

    monkeypatch.setattr("sb3_crc.zoo.manager.film", film)
    model = make_model()
    model.env.render_mode = "rgb_array"
    manager._film(model, model.env)
    assert filmed == [model]
    assert (folder / "policy.mp4").read_bytes() == b"film"
    assert "best_model.zip cannot be loaded" in caplog.text and "final model" in caplog.text
    assert sorted(path.name for path in folder.iterdir()) == ["best_model.zip", "policy.mp4"]


def test_an_interrupted_film_leaves_the_one_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    manager = CRCExperimentManager(Namespace(), "crc", ENV, str(tmp_path), verbose=0)
    folder = Path(manager.save_path)
    folder.mkdir(parents=True)
    (folder / "policy.mp4").write_bytes(b"film")

    def film(policy: object, environment: object, path: Path) -> None:
        path.write_bytes(b"half of a film")
        raise KeyboardInterrupt

    monkeypatch.setattr("sb3_crc.zoo.manager.film", film)
    model = make_model()
    model.env.render_mode = "rgb_array"
    with pytest.raises(KeyboardInterrupt):
        manager._film(model, model.env)
    assert [(path.name, path.read_bytes()) for path in folder.iterdir()] == [("policy.mp4", b"film")]


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (None, "env_kwargs need render_mode: rgb_array"),
        (RenderingUnavailable("nothing draws"), "no policy.mp4: nothing draws"),
        (gym.error.DependencyNotInstalled("pygame is not installed"), "no policy.mp4: pygame is not installed"),
    ],
)
def test_without_pictures_there_is_no_film(
    error: Exception | None, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    manager = CRCExperimentManager(Namespace(), "crc", ENV, str(tmp_path), verbose=0)
    model = make_model()

    def render(mode: str) -> None:
        assert error is not None
        raise error

    if error is not None:
        model.env.render_mode = "rgb_array"
        monkeypatch.setattr(model.env, "render", render)
    manager._film(model, model.env)
    assert said in caplog.text and not list(tmp_path.rglob("*.mp4"))


@pytest.mark.parametrize("checkpoints", [True, False])
def test_a_disk_that_is_full_at_the_end_is_said_with_what_holds_the_training(
    checkpoints: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manager = CRCExperimentManager(Namespace(), "crc", ENV, str(tmp_path), verbose=0)
    manager.n_timesteps, manager.plan = 10, Plan([], 5 if checkpoints else None, None)
    monkeypatch.setattr(sys, "orig_argv", ["python", "train.py", "--algo", "crc"])
    monkeypatch.setattr(sys, "argv", ["train.py"])
    model = make_model()

    def full(*args: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(model, "save", full)
    with pytest.raises(SystemExit) as stopped:
        manager.save_trained_model(model)
    first, last = str(stopped.value).splitlines()
    assert first == f"The model could not be saved in {manager.save_path}: [Errno 28] No space left on device"
    resume = f"When the disk is writable again, from the last checkpoint: python train.py --resume {manager.save_path}"
    assert last == (resume if checkpoints else "Without --checkpoint-every nothing else holds the training.")


def test_a_film_that_does_not_fit_costs_no_more_than_the_film(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    manager = CRCExperimentManager(Namespace(), "crc", ENV, str(tmp_path), verbose=0)
    manager.n_timesteps, manager.normalize = 0, False
    Path(manager.save_path).mkdir(parents=True)
    model = make_model()
    model.env.render_mode = "rgb_array"
    monkeypatch.setattr(sys, "orig_argv", ["python", "train.py"])
    monkeypatch.setattr(manager, "create_envs", lambda *args, **kwargs: model.env)

    def full(*args: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("sb3_crc.zoo.manager.film", full)
    manager.save_trained_model(model)
    assert "could not be written: [Errno 28] No space left on device" in caplog.text
    assert (Path(manager.save_path) / f"{manager.env_name}.zip").exists() and "Training finished" in capsys.readouterr().out


class InterruptedEnv(NoiseEnv):
    """Ctrl-C after so many steps."""

    left = 10**9

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        InterruptedEnv.left -= 1
        if InterruptedEnv.left < 0:
            raise KeyboardInterrupt
        return super().step(action)


@pytest.mark.parametrize("moment", ["within an episode", "while writing", "while saving the best model"])
def test_ctrl_c_in_an_evaluation_leaves_what_was_evaluated(
    moment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = make_model()
    callback = QBiasEvalCallback(
        Monitor(InterruptedEnv(length=5)), log_path=str(tmp_path), best_model_save_path=str(tmp_path), eval_freq=10, verbose=0
    )
    monkeypatch.setattr(InterruptedEnv, "left", 10**9)
    model.learn(10, callback=callback)

    def interrupt(*args: object, **kwargs: object) -> None:
        raise KeyboardInterrupt

    callback.best_mean_reward = -np.inf
    if moment == "within an episode":
        InterruptedEnv.left = 12
    elif moment == "while saving the best model":
        monkeypatch.setattr(CRCSAC, "save", interrupt)
    else:
        real = np.savez
        calls = []

        def stopped(file: Any, **arrays: np.ndarray) -> None:
            assert hasattr(file, "write"), "a kill while SB3 writes to its path would leave half a file"
            calls.append(file)
            if len(calls) == 1:
                raise KeyboardInterrupt
            real(file, **arrays)

        monkeypatch.setattr(np, "savez", stopped)
    with pytest.raises(KeyboardInterrupt):
        model.learn(10, callback=callback, reset_num_timesteps=False)
    with np.load(tmp_path / "evaluations.npz") as evaluations:
        complete = 1 if moment == "within an episode" else 2
        assert evaluations["timesteps"].tolist() == [10, 20][:complete]
        assert evaluations["results"].shape == evaluations["ep_lengths"].shape == (complete, 5)
    assert not [path.name for path in tmp_path.iterdir() if path.name not in ("evaluations.npz", "best_model.zip")]
