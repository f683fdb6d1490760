"""The commands, on tiny trained models of crc, rad and stock SAC."""

import csv
import importlib.util
import shutil
from pathlib import Path
from typing import Any

import av
import pytest
from click.testing import Result
from typer.testing import CliRunner

from sb3_crc import CRCSAC, make_dmc
from sb3_crc.cli import app
from sb3_crc.experiments.runs import Run
from tests.analysis.conftest import ENV_KWARGS, NOISE, SHORT, make_run
from tests.analysis.test_reports import is_drawn
from tests.conftest import POLICY_KWARGS


def command(name: str, *arguments: object, output: Path, short: bool = True) -> Result:
    return CliRunner().invoke(app, [name, *map(str, arguments), *(SHORT if short else []), "-o", str(output)])


def read(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def written(done: Result, folder: Path) -> set[str]:
    assert done.exit_code == 0, (done.output, done.exception)
    names = {path.name for path in folder.iterdir()}
    for name in names:
        assert str(folder / name) in done.stdout
        assert not name.endswith(".png") or is_drawn(folder / name), name
    return names


def test_latents_of_all_kinds_of_models(runs: dict[str, Path], tmp_path: Path) -> None:
    done = command("latents", runs["crc"], runs["rad"], runs["sac"], output=tmp_path)
    assert written(done, tmp_path) == {"latents.png", "latents.csv", "latents.json", "latents.md"}
    assert "100 decisions" in done.stderr and "rollouts:" in done.stderr and "latents:" in done.stderr
    assert {row["method"] for row in read(tmp_path / "latents.csv")} == {"crc", "rad", "sac"}


def test_tsne_of_all_kinds_of_models(runs: dict[str, Path], tmp_path: Path) -> None:
    done = command("tsne", runs["crc"], runs["sac"], "--clusters", 3, output=tmp_path)
    assert written(done, tmp_path) == {"tsne.png", "tsne.html", "tsne.csv", "tsne.json", "tsne.md"}
    assert "tsne: " in done.stderr


def test_correlate_beside_the_null(runs: dict[str, Path], tmp_path: Path) -> None:
    done = command("correlate", runs["crc"], runs["rad"], "--null", runs["crc_4"], output=tmp_path)
    names = {"correlation.png", "similarity.png", "correlate.csv", "correlate.json", "correlate.md"}
    assert written(done, tmp_path) == names
    kinds = {(row["first"], row["second"]): row["kind"] for row in read(tmp_path / "correlate.csv")}
    assert kinds == {
        ("crc, seed 1", "rad, seed 2"): "two methods",
        ("crc, seed 1", "crc, seed 4"): "one method, two seeds",
        ("rad, seed 2", "crc, seed 4"): "two methods",
    }
    assert all(row["states"] == "300" for row in read(tmp_path / "correlate.csv"))
    assert "| one method, two seeds | 1 |" in (tmp_path / "correlate.md").read_text()


def test_correlate_without_a_null_and_with_latents_of_two_sizes(runs: dict[str, Path], tmp_path: Path) -> None:
    done = command("correlate", runs["crc"], runs["sac"], output=tmp_path)
    assert "correlation.png" not in written(done, tmp_path)
    text = (tmp_path / "correlate.md").read_text()
    assert "16 and 24 dimensions" in text and "none was given" in text
    (row,) = read(tmp_path / "correlate.csv")
    assert row["mean absolute correlation, between"] == "nan" and 0 < float(row["linear CKA"]) < 1


@pytest.mark.parametrize("own", [False, True])
def test_probe_beside_an_untrained_encoder_and_pixels(runs: dict[str, Path], tmp_path: Path, own: bool) -> None:
    done = command("probe", runs["crc"], runs["sac"], "--states", 120, *["--own-states"] * own, output=tmp_path)
    assert written(done, tmp_path) == {"probe.png", "probe.csv", "probe.json", "probe.md"}
    rows = read(tmp_path / "probe.csv")
    assert {row["model"] for row in rows} == {
        "crc, seed 1", "sac, seed 3", "untrained encoder", "untrained encoder 2", "PCA of pixels, 16", "PCA of pixels, 24",
    }  # fmt: skip
    assert {row["number"] for row in rows} > {"R^2 of all", "R^2 of position[0]", "R^2 of qvel.slider"}
    assert len(rows) == 6 * 10
    best = max(float(row["value"]) for row in rows if row["number"] == "R^2 of position[0]")
    assert 0.2 < best < 1
    assert ("no comparison" in (tmp_path / "probe.md").read_text()) == own


@pytest.mark.parametrize(("preset", "decodes"), [("crc", True), ("rad", False), ("sac", False)])
def test_a_film_has_a_picture_for_each_decision(runs: dict[str, Path], tmp_path: Path, preset: str, decodes: bool) -> None:
    done = command("film", runs[preset], "--episode", 1, output=tmp_path)
    assert written(done, tmp_path) == {"film.mp4", "film.png", "film.csv", "film.json", "film.md"}
    with av.open(str(tmp_path / "film.mp4")) as container:
        stream = container.streams.video[0]
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert stream.codec_context.name == "h264" and stream.width % 2 == stream.height % 2 == 0
        assert float(stream.average_rate) == pytest.approx(2.5)  # 40 simulator steps of 0.01 s
    assert len(pictures) == 25 and (pictures[0] != pictures[-1]).any() and pictures[0].std() > 10
    assert ("reconstruction" in (tmp_path / "film.md").read_text()) == decodes
    rows = read(tmp_path / "film.csv")
    assert len(rows) == 25 and all(float(row["saliency"]) > 0 for row in rows)


def test_numbers_over_the_checkpoints_of_a_run(runs: dict[str, Path], tmp_path: Path) -> None:
    run = tmp_path / "runs" / "crc" / "run_1"
    shutil.copytree(runs["crc"], run, ignore=shutil.ignore_patterns("analysis"))
    model = CRCSAC.load(Run(run).model, device="cpu")
    model.num_timesteps = 10
    model.critic.features_extractor.apply(lambda module: getattr(module, "reset_parameters", lambda: None)())
    model.save(run / "rl_model_10_steps.zip")
    for name, number in (("latents", "return"), ("tsne", "silhouette, latent"), ("probe", "R^2 of all")):
        flags = ["--clusters", 6] if name == "tsne" else []
        done = command(name, run, "--checkpoints", *flags, output=tmp_path / name)
        assert f"{name}_evolution.png" in written(done, tmp_path / name)
        rows = [row for row in read(tmp_path / name / f"{name}.csv") if row["number"] == number and row["file"]]
        assert [row["environment_steps"] for row in rows] == ["400", "1600"]
        assert len({row["value"] for row in rows}) == 2
    done = command("correlate", run, "--checkpoints", output=tmp_path / "correlate")
    assert "correlate_evolution.png" in written(done, tmp_path / "correlate")
    first, last = read(tmp_path / "correlate" / "correlate_evolution.csv")
    assert float(last["value"]) == pytest.approx(1) and float(first["value"]) < 0.99
    assert read(tmp_path / "correlate" / "correlate.csv")[0]["kind"] == "one run"


def test_an_environment_without_physics(tmp_path: Path) -> None:
    run = make_run(tmp_path / "runs", "rad", env_id=NOISE, env_kwargs={})
    done = command("latents", run, output=tmp_path / "latents")
    written(done, tmp_path / "latents")
    done = command("probe", run, output=tmp_path / "probe")
    assert done.exit_code == 2 and f"{NOISE} has no physics state" in done.stderr and not (tmp_path / "probe").exists()


def test_models_that_see_differently_cannot_be_compared(runs: dict[str, Path], tmp_path: Path) -> None:
    other = make_run(tmp_path / "runs", "rad", env_kwargs={**ENV_KWARGS, "frame_stack": 3}, train=0)
    env = make_dmc("cartpole-balance", **{**ENV_KWARGS, "frame_stack": 3})
    CRCSAC("CnnPolicy", env, policy_kwargs=POLICY_KWARGS, buffer_size=10, device="cpu").save(Run(other).model)
    for name in ("correlate", "probe"):
        done = command(name, runs["crc"], other, output=tmp_path / "out")
        assert done.exit_code == 2 and "(6, 36, 36)" in done.stderr and "(9, 36, 36)" in done.stderr
    noise = make_run(tmp_path / "noise", "rad", env_id=NOISE, env_kwargs={})
    done = command("correlate", runs["crc"], noise, output=tmp_path / "out")
    assert done.exit_code == 2 and "cartpole-balance" in done.stderr and NOISE in done.stderr


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("tsne", ["{crc}", "--clusters", "101"], "101 clusters need at least as many different actions"),
        ("tsne", ["{crc}", "--clusters", "1"], "1 clusters say nothing"),
        ("tsne", ["{crc}", "--neighbours", "80"], "80 neighbours from other episodes are more than there are: 75"),
        ("correlate", ["{crc}"], "at least 2 models, there is only crc, seed 1"),
        ("probe", ["{crc}", "--checkpoints"], "no rl_model_*_steps.zip in {crc}"),
        ("film", ["{crc}", "--episode", "9"], "no episode 9 in the rollout, only 0 to 3"),
        ("latents", ["{nowhere}"], "{nowhere} does not exist"),
        ("latents", ["{unfinished}"], "its training has not ended"),
        ("latents", ["{unknown}"], "unknown preset of {unknown}: 'crcc'; did you mean 'crc'?"),
        ("film", ["{folder}"], "contains several runs"),
    ],
)
def test_mistakes_are_one_line(runs: dict[str, Path], tmp_path: Path, name: str, arguments: list[str], message: str) -> None:
    places: dict[str, Any] = {**runs, "nowhere": tmp_path / "nowhere", "folder": runs["crc"].parents[2]}
    places["unfinished"] = make_run(tmp_path / "unfinished", "crc", train=0)
    places["unknown"] = make_run(tmp_path / "unknown", "crcc", train=0)
    shutil.copy(Run(runs["crc"]).model, Run(places["unknown"]).model)
    done = command(name, *(one.format(**places) for one in arguments), output=tmp_path / "out")
    assert done.exit_code == 2 and message.format(**places) in done.stderr, done.output
    assert isinstance(done.exception, SystemExit) and message.format(**places) in done.stderr.splitlines()[-1]
    assert not done.stdout  # before it stands progress
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("name", "package", "extra"), [("tsne", "plotly", "analysis"), ("film", "av", "video")])
def test_a_missing_extra_is_named(
    runs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, package: str, extra: str
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda one, *rest: None if one == package else find(one, *rest))
    done = command(name, runs["crc"], output=tmp_path)
    assert done.exit_code == 2 and f"pip install 'sb3-crc[{extra}]'" in done.stderr


def test_commands_are_named_in_the_help() -> None:
    done = CliRunner().invoke(app, ["--help"])
    assert all(name in done.stdout for name in ("latents", "tsne", "correlate", "probe", "film"))
