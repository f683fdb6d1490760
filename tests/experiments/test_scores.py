"""From the folders of runs to one table of scores."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from typer.testing import CliRunner

from sb3_crc import CRCSAC, make_dmc
from sb3_crc.cli import app
from sb3_crc.evaluation import FIRST_SEED as FIRST_EVALUATION
from sb3_crc.experiments import final
from sb3_crc.experiments.runs import FAILURE, FINAL, PROVENANCE, SPEC, Run, add_provenance, find_runs, read_json, write_json
from sb3_crc.experiments.scores import COLUMNS, MixedProtocols, final_means, one_protocol, read_scores, write_scores
from tests.test_zoo import ROOT, command, environment


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of train.py: 130 decisions of cartpole, two evaluations of two episodes."""
    folder = tmp_path_factory.mktemp("runs")
    flags = ["-n", "130", "--eval-freq", "65", "--eval-episodes", "2", "--verbose", "0"]
    subprocess.run(command(folder, *flags), cwd=ROOT, env=environment(), check=True, capture_output=True)
    return folder


@pytest.fixture
def folder(trained: Path, tmp_path: Path) -> Path:
    """A copy of it that a test may change: ``<tmp>/runs/crc/<env>_1``."""
    shutil.copytree(trained, tmp_path / "runs")
    return tmp_path / "runs"


def only_run(folder: Path) -> Run:
    (run,) = find_runs([folder])
    return run


def test_a_run_says_what_it_is(folder: Path) -> None:
    run = only_run(folder)
    assert (run.method, run.preset, run.task, run.seed) == ("crc", "crc", "cartpole-swingup", 1)
    assert (run.action_repeat, run.budget, run.status) == (8, 1_040, "unevaluated")
    assert run.settings["batch_size"] == 16 and run.env_kwargs["image_size"] == 36
    assert read_json(run.folder / PROVENANCE)["versions"]["torch"]


def test_the_final_policy_is_scored_on_fresh_episodes(folder: Path) -> None:
    run = only_run(folder)
    written = final.evaluate_final(run, episodes=2)
    assert written == read_json(run.folder / FINAL)
    model = CRCSAC.load(run.model)
    env = Monitor(make_dmc("cartpole-swingup", image_size=36, frame_stack=2, render_quality="fast", seed=final.FIRST_SEED))
    returns, _ = evaluate_policy(model, env, n_eval_episodes=2, return_episode_rewards=True)
    assert written["returns"] == returns
    assert (written["agent_steps"], written["environment_steps"], written["updates"]) == (130, 1_040, model._n_updates)
    assert only_run(folder).status == "finished"

    scores = read_scores([folder])
    assert list(scores.table.columns) == list(COLUMNS) and scores.missing == ()
    assert scores.final["return"].tolist() == returns
    with np.load(run.folder / "evaluations.npz") as data:
        current = scores.table[scores.table["policy"] == "current"]
        assert current["return"].tolist() == data["results"].ravel().tolist()
        assert current["environment_steps"].tolist() == [520, 520, 1_040, 1_040]
        assert current["first_seed"].nunique() == 2 and (current["first_seed"] > FIRST_EVALUATION).all()
        assert scores.final["seconds"].tolist() == [float(data["training_seconds"])] * 2
    assert set(scores.table["render_quality"]) == {"fast"} and "torch" in scores.table["versions"][0]


def test_an_environment_of_the_users_is_seeded_too(tmp_path: Path) -> None:
    run = tmp_path / "state_sac" / "Pendulum-v1_1"
    (run / "Pendulum-v1").mkdir(parents=True)
    (run / "Pendulum-v1" / "args.yml").write_text("{algo: state_sac, env: Pendulum-v1, seed: 0, n_timesteps: 10}")
    (run / "Pendulum-v1" / "config.yml").write_text("{env_kwargs: {g: 9.0}}")
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, device="cpu").save(run / "Pendulum-v1.zip")
    first, again, other = (final.final_returns(Run(run), episodes=2, seed=seed) for seed in (1, 1, 2))
    assert first == again != other and len(set(first)) == 2
    arguments = run / "Pendulum-v1" / "args.yml"
    arguments.write_text(arguments.read_text().replace("state_sac", "td3"))
    with pytest.raises(ValueError, match="'td3'"):
        final.final_returns(Run(run))


def test_scores_come_back_from_csv(folder: Path, tmp_path: Path) -> None:
    final.evaluate_final(only_run(folder), episodes=2)
    scores = read_scores([folder])
    write_scores(scores, tmp_path / "scores.csv")
    again = read_scores([tmp_path / "scores.csv"])
    assert again.table["return"].tolist() == pytest.approx(scores.table["return"].tolist())
    assert again.missing == ()
    assert len(read_scores([tmp_path / "scores.csv", folder]).table) == len(scores.table), "found twice, counted once"


def test_two_sources_that_disagree_about_a_run_are_refused(folder: Path, tmp_path: Path) -> None:
    final.evaluate_final(only_run(folder), episodes=2)
    path = tmp_path / "scores.csv"
    write_scores(read_scores([folder]), path)
    old = read_scores([path]).table
    (last,) = old[(old["policy"] == "final") & (old["episode"] == 1)].index
    before = float(old.loc[last, "return"])
    old.loc[last, "return"] = before - 5
    old.to_csv(path, index=False)
    for sources in ([path, folder], [folder, path]):
        with pytest.raises(
            ValueError, match=rf"crc/.*_1: episode 1 of its final .* {before - 5:.3f} in one .* {before:.3f} in an"
        ):
            read_scores(sources)


def test_runs_that_are_not_ready_are_skipped_and_named(folder: Path) -> None:
    first = only_run(folder)
    for name in ("before", "behind"):
        shutil.copytree(first.folder, folder / name / "crc" / first.folder.name)
    (folder / "before" / "crc" / first.folder.name / first.model.name).unlink()
    arguments = ["evaluate", str(folder), "--episodes", "1"]
    done = CliRunner().invoke(app, [*arguments, "--json"])
    document = json.loads(done.stdout)
    assert done.exit_code == 1 and len(document["runs"]) == 2
    (skipped,) = document["skipped"]
    assert "before" in skipped["folder"] and "training has not ended" in skipped["reason"]
    again = CliRunner().invoke(app, arguments)
    assert again.exit_code == 1 and again.stdout.count(" episodes)") == 2
    assert again.stderr.splitlines()[-1].startswith("skipped: ")
    assert CliRunner().invoke(app, ["evaluate", str(folder / "behind"), "--json"]).exit_code == 0


def test_a_run_that_went_on_names_every_revision(folder: Path) -> None:
    run = only_run(folder)
    once = read_json(run.folder / PROVENANCE)
    assert run.provenance == once and run.distinct("git_revision") == [once["git_revision"]]
    add_provenance({**once, "git_revision": "later", "machine": once["machine"] | {"cores": 999}}, run.folder)
    add_provenance({**once, "git_revision": "later"}, run.folder)
    table = read_scores([folder]).table
    assert set(table["git_revision"]) == {f"{once['git_revision']}; later"}
    assert len(run.distinct("machine")) == 2 and len(run.distinct("versions")) == 1
    assert "; " not in table["versions"][0] and "; " in table["machine"][0] and "cores 999" in table["machine"][0]
    assert read_json(run.folder / PROVENANCE)["time"] == once["time"]


def test_only_a_policy_after_exactly_the_budget_is_scored(folder: Path) -> None:
    run = only_run(folder)
    arguments = next(run.folder.glob("*/args.yml"))
    arguments.write_text(arguments.read_text().replace("- 130", "- 140"))
    with pytest.raises(ValueError, match="has seen 1040 environment steps, its budget is 1120"):
        final.evaluate_final(only_run(folder))
    run.model.unlink()
    with pytest.raises(FileNotFoundError, match="has not ended"):
        final.evaluate_final(only_run(folder))
    assert [str(one) for one in read_scores([folder]).missing] == ["crc on cartpole-swingup, seed 1: unfinished"]


def test_what_a_comparison_lacks_is_listed(folder: Path, tmp_path: Path) -> None:
    final.evaluate_final(only_run(folder), episodes=1)
    for number, (method, seed, failure) in enumerate((("sac", 1, False), ("rad", 1, True))):
        own = tmp_path / "runs" / f"planned_{number}"
        own.mkdir()
        write_json({"method": method, "task": "cartpole-swingup", "seed": seed}, own / SPEC)
        if failure:
            write_json({"exit_code": 1}, own / FAILURE)
    assert {str(one) for one in read_scores([folder]).missing} == {
        "sac on cartpole-swingup, seed 1: not begun",
        "rad on cartpole-swingup, seed 1: failed",
    }
    scores = read_scores([folder])
    second = scores.table.assign(method="rad", seed=2)
    path = tmp_path / "scores.csv"
    second.to_csv(path, index=False)
    lacking = {str(one) for one in read_scores([only_run(folder).folder, path]).missing}
    assert lacking == {"crc on cartpole-swingup, seed 2: absent", "rad on cartpole-swingup, seed 1: absent"}


def test_different_protocols_do_not_meet(folder: Path) -> None:
    final.evaluate_final(only_run(folder), episodes=1)
    table = read_scores([folder]).final
    for column, value in (("budget", 500), ("render_quality", "benchmark"), ("episodes", 5), ("first_seed", 3)):
        mixed = table._append(table.assign(**{"method": "rad", column: value}))
        with pytest.raises(MixedProtocols, match=f"{column} differs: .*crc.*rad|{column} differs: .*rad.*crc"):
            one_protocol(mixed)
        assert len(one_protocol(mixed, allow_mixed=True)) == 2
    states = table._append(table.assign(method="state_sac", render_quality="none"))
    assert len(one_protocol(states)) == 2, "states have no pictures that could differ"


def test_a_seed_that_was_run_twice_is_refused(folder: Path) -> None:
    final.evaluate_final(only_run(folder), episodes=2)
    table = read_scores([folder]).final
    assert final_means(table)["return"].tolist() == [pytest.approx(table["return"].mean())]
    with pytest.raises(ValueError, match="seed 1 was run more than once: .*another"):
        final_means(table._append(table.assign(run="another")))


def test_files_that_cannot_be_read_are_named(folder: Path, tmp_path: Path) -> None:
    run = only_run(folder)
    (run.folder / FINAL).write_text("{")
    with pytest.raises(ValueError, match=r"final\.json cannot be read"):
        read_scores([folder])
    (run.folder / FINAL).unlink()
    next(run.folder.glob("*/config.yml")).write_text("!!python/object/apply:os.system ['true']")
    with pytest.raises(ValueError, match=r"config\.yml cannot be read: .*os\.system"):
        read_scores([folder])
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match=r"other\.csv is no table of scores: it has no column method"):
        read_scores([tmp_path / "other.csv"])
    with pytest.raises(FileNotFoundError, match="nowhere is no folder"):
        read_scores([tmp_path / "nowhere"])
