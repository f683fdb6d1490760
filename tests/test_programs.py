"""Programs act as the policies that they come from, scaling and cropping of the pixels included."""

from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch as th

from sb3_crc import CRCSAC, make_dmc
from sb3_crc.programs import DeterministicActions, export_program
from tests.conftest import POLICY_KWARGS, NoiseEnv, make_model

ENCODER = POLICY_KWARGS["features_extractor_kwargs"]


def pixels(n: int) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (n, *NoiseEnv().observation_space.shape), np.uint8)  # type: ignore[misc]


def run(path: Path, observations: np.ndarray) -> np.ndarray:
    if path.suffix == ".pt2":
        actions: np.ndarray = th.export.load(path).module()(th.as_tensor(observations)).detach().numpy()
        return actions
    return np.asarray(onnxruntime.InferenceSession(path).run(None, {"observations": observations})[0])


@pytest.mark.parametrize("suffix", [".onnx", ".pt2"])
@pytest.mark.parametrize(
    "changes",
    [{}, {"layer_norm": True, "features_extractor_kwargs": {**ENCODER, "center_input": True, "latent_activation": "tanh"}}],
    ids=["defaults", "laptop"],
)
def test_a_program_acts_as_the_policy(tmp_path: Path, suffix: str, changes: dict[str, Any]) -> None:
    model = make_model(policy_kwargs={**POLICY_KWARGS, **changes})
    model.learn(4, reset_num_timesteps=False)
    model.policy.set_training_mode(True)
    path = export_program(model, tmp_path / f"policy{suffix}")
    assert model.policy.training and list(tmp_path.iterdir()) == [path]
    for size in (1, 7):
        expected, _ = model.predict(pixels(size), deterministic=True)
        assert np.allclose(run(path, pixels(size)), expected, atol=1e-5)
    model.learn(2, reset_num_timesteps=False)  # the model still learns


def test_a_program_that_acts_differently_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_crc.programs._run_torch", lambda path, observations: th.full((len(observations), 1), 2.0))
    with pytest.raises(ValueError, match="the program's actions differ from the policy's"):
        export_program(make_model(), tmp_path / "policy.pt2")
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_a_program(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"ends in \.onnx or \.pt2"):
        export_program(make_model(), tmp_path / "policy.tflite")
    env = make_dmc("cartpole-swingup", seed=0, image_size=36, frame_stack=2, render_quality="fast", observation="dict")
    with pytest.raises(ValueError, match="a program takes images alone"):
        export_program(CRCSAC("MultiInputPolicy", env, policy_kwargs=POLICY_KWARGS), tmp_path / "policy.onnx")
    env.close()


def test_actions_lie_in_the_space() -> None:
    model = make_model()
    with th.no_grad():
        actions = DeterministicActions(model.policy)(th.as_tensor(pixels(3)))
    assert actions.shape == (3, *model.action_space.shape)  # type: ignore[misc]
    assert all(model.action_space.contains(action) for action in actions.numpy())
