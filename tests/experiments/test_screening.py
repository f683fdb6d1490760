"""What a configuration's settings get from states."""

from pathlib import Path
from typing import Any

import pytest
from stable_baselines3 import SAC
from torch import nn
from typer.testing import CliRunner

from sb3_crc.cli import app
from sb3_crc.configurations import read_settings
from sb3_crc.experiments import screening
from sb3_crc.experiments.screening import screened_state_sac

LAPTOP = Path("zoo_configs/laptop.yml")


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[SAC]:
    """The models that are trained."""
    models = []
    learn = screening.learning_curve

    def watched(model: SAC, *args: Any) -> Any:
        models.append(model)
        return learn(model, *args)

    monkeypatch.setattr(screening, "learning_curve", watched)
    return models


def test_the_configurations_settings_are_trained_with(trained: list[SAC]) -> None:
    settings = read_settings(LAPTOP, "rad", "dmc_pixels/finger-spin-v0") | {"n_steps": 3, "reward_scale": 0.1}
    measured = screened_state_sac("finger-spin", {**settings, "n_timesteps": 540}, evaluations=2, episodes=2)
    (model,) = trained
    assert (model.n_steps, model.batch_size, model.tau, model.gamma, model.buffer_size) == (3, 128, 0.02, 0.99, 50_000)
    assert model._n_updates == (540 - 500) / 2  # one for two decisions, from the end of the warm-up on
    assert model.actor.optimizer.param_groups[0]["lr"] == pytest.approx(0.0, abs=1e-3 * 2 / 540)  # falls to 0
    assert model.ent_coef_optimizer is not None and model.ent_coef_optimizer.param_groups[0]["lr"] == 1e-3  # does not
    assert sum(isinstance(layer, nn.LayerNorm) for layer in model.actor.modules()) == 2
    assert [point["environment_steps"] for point in measured["curve"]] == [540, 1080]
    assert measured["settings"]["reward_scale"] == 0.1 and measured["settings"]["ent_coef_learning_rate"] == 1e-3


def test_rewards_are_scaled_in_training_and_not_in_evaluations(trained: list[SAC]) -> None:
    settings = {"n_timesteps": 120, "learning_starts": 100, "reward_scale": 0.1}
    returns = screened_state_sac("cartpole-balance", settings, evaluations=1, episodes=2)["curve"][0]["mean"]
    assert trained[0].replay_buffer is not None
    rewards = trained[0].replay_buffer.rewards[:120]
    assert rewards.max() <= 0.8 < 8 * rewards.max() < returns  # eight environment steps of at most 1 each, in 125 decisions


def test_what_cannot_be_screened_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="n_timesteps"):
        screened_state_sac("finger-spin", {})
    heads = {"net_arch": [64, 32], "layer_norm": True}
    with pytest.raises(ValueError, match=r"net_arch=\[64, 32\] with layer_norm: layers of one width"):
        screened_state_sac("finger-spin", {"n_timesteps": 10, "policy_kwargs": heads})
    for change, message in (("tua=1", "did you mean 'tau'"), ("tau", "'tau' is not name=value")):
        result = CliRunner().invoke(
            app, ["ladder", "screen", "finger-spin", "--set", change, "--output", str(tmp_path / "no")]
        )
        assert result.exit_code == 2 and message in result.output + result.stderr
    assert not list(tmp_path.iterdir())


def test_the_command_changes_settings(tmp_path: Path) -> None:
    changes = ["n_timesteps=520", "learning_starts=510", "n_steps=1", "policy_kwargs.net_arch=[32, 32]"]
    command = ["ladder", "screen", "finger-spin", "--evaluations", "1", "--output", str(tmp_path / "screened.json")]
    result = CliRunner().invoke(app, [*command, *(word for change in changes for word in ("--set", change))])
    assert result.exit_code == 0, result.output
    assert "settings.n_steps: 1\n" in result.stdout and "settings.policy_kwargs.net_arch: [32, 32]\n" in result.stdout
    assert "curve.0.environment_steps: 1040\n" in result.stdout and (tmp_path / "screened.json").exists()
