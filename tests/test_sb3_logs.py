"""Where SB3's loggers find a training's numbers."""

import csv
import inspect
import json
import math
from pathlib import Path

import pytest
from stable_baselines3.common.logger import configure

from sb3_crc import CRCSAC
from tests.conftest import POLICY_KWARGS, NoiseEnv, make_model


def test_the_tensorboard_folder_is_named_for_the_algorithm(tmp_path: Path) -> None:
    model = CRCSAC("CnnPolicy", NoiseEnv(), buffer_size=50, tensorboard_log=str(tmp_path), policy_kwargs=POLICY_KWARGS)
    model.learn(2).learn(2).learn(2, reset_num_timesteps=False).learn(2, tb_log_name="mine")
    assert {path.name for path in tmp_path.iterdir()} == {"CRCSAC_1", "CRCSAC_2", "mine_1"}
    assert all(list(path.glob("events.out.tfevents.*")) for path in tmp_path.iterdir())
    assert inspect.signature(CRCSAC.learn).parameters["tb_log_name"].default == "CRCSAC"


def test_losses_reach_the_loggers_that_the_user_sets(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = make_model()
    model.set_logger(configure(str(tmp_path), ["csv", "json", "stdout"]))
    model.learn(20, log_interval=1, reset_num_timesteps=False)
    rows = [row for row in csv.DictReader((tmp_path / "progress.csv").open()) if row["train/n_updates"]]
    lines = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    names = {"train/critic_loss", "train/actor_loss", "train/ent_coef", "train/learning_rate", "time/total_timesteps"}
    names |= {f"representation/{name}" for name in ("contrastive", "reconstruction", "consistency", "loss")}
    assert len(rows) >= 1
    for entries in (rows[-1], lines[-1]):
        assert names <= entries.keys()
        assert all(math.isfinite(float(entries[name])) for name in names)
    assert float(rows[-1]["train/critic_loss"]) == pytest.approx(lines[-1]["train/critic_loss"])
    assert "critic_loss" in capsys.readouterr().out
