"""The measurements under learning from pixels, on budgets of seconds."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from sb3_crc.cli import app
from sb3_crc.experiments.ladder import _frames, linear_probe, overfit_one_batch, probe_random_encoder, state_sac, teach_encoder

BEST = Path(__file__).parents[2] / "results/laptop/final/cartpole-swingup/rad/seed_23/policy.sb3crc"
SMALL = {"channels": [8, 8], "strides": [2, 2], "features_dim": 16}


def test_a_probe_reads_what_is_linear_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    inputs = rng.normal(size=(500, 10))
    inputs[:, 3] = 1e-9 * rng.normal(size=500)  # dead
    assert linear_probe(inputs, inputs[:, :2] @ np.array([[1.0, 2.0], [3.0, 4.0]])) > 0.999
    assert linear_probe(inputs, rng.normal(size=(500, 2))) < 0.1
    constant = np.column_stack([inputs[:, 0], np.ones(500)])
    assert linear_probe(inputs, constant) > 0.999  # a coordinate that does not vary cannot be explained


def test_an_untrained_encoder_is_probed() -> None:
    measured = probe_random_encoder("cartpole-swingup", SMALL, frames=1_500, image_size=36)
    assert set(measured["r2"]["latent"]) == set(measured["r2"]["convolutions"]) == {"position", "velocity"}
    assert measured["r2"]["convolutions"]["position"] > measured["r2"]["latent"]["position"]


def test_a_taught_encoder_sees_more_than_an_untrained_one() -> None:
    measured = {n: teach_encoder("cartpole-swingup", SMALL, updates=n, frames=800, image_size=36)["r2"] for n in (1, 150)}
    assert set(measured[1]) == {"position", "velocity"}
    assert measured[150]["position"] > max(measured[1]["position"], 0.3)


def test_a_policy_leads_to_frames_that_random_actions_do_not_reach() -> None:
    """From its frames an encoder is taught the whole swing; the errors are in the task's units, of each coordinate."""
    taught = teach_encoder("cartpole-swingup", SMALL, updates=40, frames=130, image_size=36, policy=BEST)
    assert [len(taught["rmse"][name]) for name in ("position", "velocity")] == [3, 2]
    assert 0 < taught["rmse"]["position"][1] < 1  # the cosine of the pole's angle
    assert taught["policy"] == BEST.as_posix()
    _, by_policy = _frames("cartpole-swingup", 125, 36, 0, BEST)
    _, by_chance = _frames("cartpole-swingup", 125, 36, 0)
    assert by_policy["position"][-50:, 1].min() > 0.9 and by_chance["position"][-50:, 1].min() < 0  # the pole's height
    with pytest.raises(ValueError, match="policy for cartpole-swingup, not for finger-spin"):
        teach_encoder("finger-spin", SMALL, frames=250, policy=BEST)


def test_state_sac_reports_its_curve() -> None:
    measured = state_sac("cartpole-swingup", agent_steps=520, evaluations=2, episodes=2)
    assert [point["environment_steps"] for point in measured["curve"]] == [2080, 4160]
    assert all(0 <= point["min"] <= point["mean"] <= 1000 for point in measured["curve"])


def test_a_loss_is_overfitted_with_the_critic_standing_still() -> None:
    kwargs = {"net_arch": [16], "features_extractor_kwargs": SMALL}
    measured = overfit_one_batch("cartpole-swingup", "contrastive", kwargs, updates=30, batch_size=16, image_size=36)
    assert measured["last"] < measured["first"] < 1.1 * np.log(16)
    assert 0 < measured["pixel_variance"] < 0.1


def test_the_command_writes_json_and_names_the_rungs(tmp_path: Path) -> None:
    runner = CliRunner()
    config = tmp_path / "small.yml"
    config.write_text(f"default: {{policy_kwargs: {{features_extractor_kwargs: {json.dumps(SMALL)}}}}}")
    result = runner.invoke(app, ["ladder", "stairs", "--config", str(config)])
    assert result.exit_code == 2 and "state, screen, seen, probe, teach, overfit" in result.output
    result = runner.invoke(app, ["ladder", "teach", "--config", str(config), "--set", "stride=[2]"])
    assert result.exit_code != 0 and "strides" in f"{result.stderr}{result.exception}"
    result = runner.invoke(app, ["ladder", "probe", "--config", str(config), "--policy", str(BEST)])
    assert result.exit_code == 2 and "--policy is an option of teach; this is rung probe" in result.stderr.replace("\n", "")
    config.write_text("default: {policy: CnnPolicy}")
    result = runner.invoke(app, ["ladder", "probe", "--config", str(config)])
    assert result.exit_code == 2 and "has no policy_kwargs for cartpole-swingup" in result.stderr.replace("\n", "")


@pytest.mark.slow
def test_state_sac_solves_the_task() -> None:
    """The environment can be learned: stock SAC from its states gets what the pixels could give."""
    assert state_sac("cartpole-swingup", agent_steps=5_000, evaluations=1)["curve"][-1]["mean"] >= 800
