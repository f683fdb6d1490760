"""Returns where a policy was not trained."""

import importlib.util
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
import yaml
from matplotlib.image import imread
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from typer.testing import CliRunner

from sb3_crc import make_dmc
from sb3_crc.analysis import generalization_report
from sb3_crc.analysis.generalization import RECORDS, GeneralizationCallback, ModeReturns, generalize, read_records
from sb3_crc.analysis.generalization_report import Generalization, read_published, write_generalization
from sb3_crc.analysis.policies import SavedPolicy
from sb3_crc.cli import app
from sb3_crc.evaluation import FIRST_SEED, SEED_STEP
from sb3_crc.experiments.final import final_returns
from sb3_crc.experiments.runs import Run
from tests.analysis.conftest import ENV_KWARGS, NOISE, TASK, make_model, make_run


@pytest.fixture
def policy(runs: dict[str, Path], tmp_path: Path) -> SavedPolicy:
    """A copy, whose folder may be written to."""
    folder = tmp_path / "rad" / runs["rad"].name
    shutil.copytree(runs["rad"], folder, ignore=shutil.ignore_patterns("analysis"))
    run = Run(folder)
    return SavedPolicy(run, run.model)


def test_where_it_was_trained_the_returns_are_those_of_the_final_score(policy: SavedPolicy) -> None:
    (result,) = generalize(policy, ["none"], episodes=2)
    assert result == ModeReturns("none", "none", tuple(final_returns(policy.run, episodes=2)))


def test_a_mode_shows_what_it_says(policy: SavedPolicy) -> None:
    none, colours, video = generalize(policy, ["none", "color_hard", "video_hard"], episodes=2)
    assert len({none.returns, colours.returns, video.returns}) == 3  # the same initial states, other pictures
    assert "generated" in colours.label and "procedural" in video.label


def test_what_was_measured_is_not_measured_again(policy: SavedPolicy, monkeypatch: pytest.MonkeyPatch) -> None:
    first = generalize(policy, ["none", "color_easy"], episodes=1)
    loads = []
    load = SavedPolicy.load
    monkeypatch.setattr(SavedPolicy, "load", lambda self: loads.append(self.file) or load(self))
    assert generalize(policy, ["color_easy", "none"], episodes=1) == first[::-1]
    assert loads == []
    generalize(policy, ["none"], episodes=2)  # other episodes
    assert len(loads) == 1
    model = load(policy)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(1.0)
    model.save(policy.file)
    generalize(policy, ["none"], episodes=2)  # another model
    assert len(loads) == 2


@pytest.mark.parametrize(
    ("modes", "message"), [(["video_medium"], "mode 'video_medium'.*video_hard"), ([], "no mode is given")]
)
def test_unknown_modes_are_refused(policy: SavedPolicy, modes: Sequence[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        generalize(policy, modes)
    with pytest.raises(ValueError, match=message):
        GeneralizationCallback(10, modes)


def test_other_environments_are_refused(tmp_path: Path) -> None:
    run = Run(make_run(tmp_path, "rad", env_id=NOISE, env_kwargs={}, train=0))
    with pytest.raises(ValueError, match=f"{NOISE}.*only dm_control"):
        generalize(SavedPolicy(run, run.model))


def test_an_environment_that_rl_zoo3_has_wrapped_is_not_taken_for_another(policy: SavedPolicy) -> None:
    (config,) = policy.run.folder.glob("*/config.yml")
    config.write_text(yaml.dump({"env_kwargs": ENV_KWARGS, "env_wrapper": ["a.Wrapper"]}))
    run = Run(policy.run.folder)
    with pytest.raises(ValueError, match="was trained with env_wrapper="):
        final_returns(run)
    with pytest.raises(ValueError, match="was trained with env_wrapper="):
        generalize(SavedPolicy(run, run.model), ["none"])


def trained(callback: GeneralizationCallback | None) -> Any:
    return make_model("rad", 3).learn(60, callback=callback)


def test_the_callback_evaluates_and_leaves_the_training_alone(tmp_path: Path) -> None:
    callback = GeneralizationCallback(990, ["none", "color_hard"], episodes=2, folder=tmp_path)
    model, plain = trained(callback), trained(None)
    for one, other in zip(model.policy.parameters(), plain.policy.parameters(), strict=True):
        assert th.equal(one, other)
    records = read_records(tmp_path)
    assert records["timesteps"].tolist() == [25, 50]
    assert records["none"].shape == records["color_hard"].shape == (2, 2)
    assert not np.array_equal(records["none"], records["color_hard"])


def test_the_callback_has_the_seeds_of_the_other_evaluations(tmp_path: Path) -> None:
    trained(GeneralizationCallback(20 * 40, ["none"], episodes=2, folder=tmp_path))
    model = make_model("rad", 3)  # as it is before it learns anything, at the first evaluation
    env = DummyVecEnv([lambda: Monitor(make_dmc(TASK, **ENV_KWARGS))])
    env.seed(FIRST_SEED + SEED_STEP)
    returns, _ = evaluate_policy(model, env, n_eval_episodes=2, return_episode_rewards=True)
    assert read_records(tmp_path)["none"][0].tolist() == returns


def test_the_callback_refuses_what_it_cannot_distract(tmp_path: Path) -> None:
    model = make_model("rad", 0, NOISE, {})
    with pytest.raises(ValueError, match="make_dmc"):
        model.learn(60, callback=GeneralizationCallback(10, folder=tmp_path))
    with pytest.raises(ValueError, match="eval_every=0"):
        GeneralizationCallback(0)


def test_unreadable_records_are_named(tmp_path: Path) -> None:
    assert read_records(tmp_path) == {}
    (tmp_path / RECORDS).write_bytes(b"PK\x03\x04, and the rest is missing")
    with pytest.raises(ValueError, match="cannot be read"):
        read_records(tmp_path)
    (tmp_path / RECORDS).write_bytes(b"no archive")
    with pytest.raises(ValueError, match=RECORDS):
        read_records(tmp_path)


def named(run: Path) -> SavedPolicy:
    return SavedPolicy(Run(run), Run(run).model)


def test_the_report(runs: dict[str, Path], tmp_path: Path) -> None:
    def results(none: float, hard: float) -> list[ModeReturns]:
        return [
            ModeReturns("none", "none", (none, none)),
            ModeReturns("video_hard", "video_hard (procedural)", (hard, hard + 2)),
        ]

    evaluated = [
        Generalization(named(runs["crc"]), 320, results(100, 49)),
        Generalization(named(runs["crc_4"]), 320, results(200, 99)),
        Generalization(named(runs["rad"]), 320, results(80, 19)),
    ]
    written = {path.name for path in write_generalization(evaluated, tmp_path)}
    assert written == {"generalization.csv", "generalization.json", "generalization.md", "generalization.png"}
    text = (tmp_path / "generalization.md").read_text()
    assert "| crc | 320 | 2 | 150 ± 71 | 75 ± 35 (50%) |" in text
    assert "| rad | 320 | 1 | 80 | 20 (25%) |" in text
    assert "video_hard (procedural)" in text
    assert len((tmp_path / "generalization.csv").read_text().splitlines()) == 1 + 3 * 2 * 2


def test_curves_over_training(runs: dict[str, Path], policy: SavedPolicy, tmp_path: Path) -> None:
    np.savez(policy.run.folder / RECORDS, timesteps=[25, 50], video_easy=[[1.0, 2.0], [3.0, 4.0]])
    one = Generalization(policy, 320, [ModeReturns("none", "none", (1.0,))])
    assert "over_training.png" in {path.name for path in write_generalization([one], tmp_path / "report")}


def test_curves_are_drawn_where_all_trainings_of_a_method_were_evaluated(
    runs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr(generalization_report, "save", lambda figure, path: drawn.append(figure) or path)
    watched = []
    for number, (timesteps, returns) in enumerate([([10, 20, 30, 40], [1.0, 2.0, 3.0, 4.0]), ([20, 40], [6.0, 8.0])]):
        folder = tmp_path / str(number) / runs["rad"].name
        shutil.copytree(runs["rad"], folder)
        np.savez(folder / RECORDS, timesteps=timesteps, video_easy=np.array(returns)[:, None])
        watched.append(Run(folder))
    generalization_report._draw_curves(watched, tmp_path / "over_training.png")
    (line,) = drawn[0].axes[0].lines
    assert line.get_xdata().tolist() == [20 * 40, 40 * 40] and line.get_ydata().tolist() == [4.0, 6.0]


def test_a_report_speaks_of_nothing_that_is_not_in_it(runs: dict[str, Path], tmp_path: Path) -> None:
    write_generalization([Generalization(named(runs["rad"]), 320, [ModeReturns("none", "none", (80.0,))])], tmp_path)
    text = (tmp_path / "generalization.md").read_text()
    assert "Shown" not in text and "ublished" not in text


def test_published_scores() -> None:
    rows = read_published()
    at = {(row["method"], row["task"], row["mode"]): (row["mean"], row["std"]) for row in rows}
    assert len(at) == len(rows) == 5 * 8 + 5 * 9 + 5 * 5  # tasks x methods of color_hard, video_easy, video_hard
    assert at["SODA (conv)", "cartpole-swingup", "video_easy"] == ("474", "143")  # what CRC-RL's table has in its SODA column
    assert at["SGQN", "finger-spin", "video_hard"] == ("540", "53")


def test_command(runs: dict[str, Path], tmp_path: Path) -> None:
    command = ["generalize", str(runs["crc"]), str(runs["sac"]), "--modes", "none,video_hard", "--episodes", "1"]
    result = CliRunner().invoke(app, [*command, "-o", str(tmp_path)])
    assert result.exit_code == 0, result.output
    text = (tmp_path / "generalization.md").read_text()
    assert "| crc | 1600 | 1 |" in text and "| sac | 1600 | 1 |" in text
    assert "video_hard (procedural)" in text
    refused = CliRunner().invoke(app, ["generalize", str(runs["crc"]), "--modes", "video_hrad"])
    assert refused.exit_code == 2
    assert "mode 'video_hrad'" in refused.output


@pytest.mark.parametrize("name", ["generalize", "contact-sheet"])
def test_a_missing_extra_is_named_before_anything_acts(
    runs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda one, *rest: None if one == "matplotlib" else find(one, *rest))
    models = [str(runs["rad"])] if name == "generalize" else []
    done = CliRunner().invoke(app, [name, *models, "-o", str(tmp_path / "out")])
    assert (
        done.exit_code == 2
        and done.stderr == "this needs matplotlib, of the extra 'analysis': pip install 'sb3-crc[analysis]'\n"
    )


def test_contact_sheet(tmp_path: Path) -> None:
    sheet = tmp_path / "new" / "sheet.png"
    command = ["contact-sheet", "--tasks", "cartpole-swingup", "--render-quality", "fast", "-o", str(sheet)]
    result = CliRunner().invoke(app, [*command, "--modes", "color_hard,video_hard"])
    assert result.exit_code == 0, result.output
    pixels = (imread(sheet)[..., :3] * 255).astype(int)
    panels = [pixels[:, side * pixels.shape[1] // 3 : (side + 1) * pixels.shape[1] // 3] for side in range(3)]
    assert len({int(panel.sum()) for panel in panels}) == 3  # as it is, other colours, a video
    assert CliRunner().invoke(app, [*command, "--modes", "color_hrad"]).exit_code == 2
