"""What a saved model holds: all of it, or its policy, its parameters or its replay buffer alone."""

import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
import yaml

from sb3_crc import CRCSAC, PRESETS, CRCPolicy
from tests.compared_models import differences, flat, optimizers, state, train_on
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

# -- A whole model -----------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("overlap", [False, True])
def test_a_model_without_its_buffer_acts_until_a_batch_is_stored(overlap: bool, tmp_path: Path) -> None:
    model = make_model(overlap=overlap).learn(5, reset_num_timesteps=False)
    model.save(tmp_path / "model")
    loaded = CRCSAC.load(tmp_path / "model", env=NoiseEnv())
    updates = loaded._n_updates
    loaded.learn(15, reset_num_timesteps=False)
    assert loaded._n_updates == updates > 0
    loaded.learn(5, reset_num_timesteps=False)
    assert loaded._n_updates == updates + 5
    fresh = CRCSAC("CnnPolicy", NoiseEnv(), batch_size=16, buffer_size=50, learning_starts=5, policy_kwargs=POLICY_KWARGS)
    with pytest.raises(ValueError, match="batch_size=16 is more than the 6 transitions that are stored"):
        fresh.learn(20)
