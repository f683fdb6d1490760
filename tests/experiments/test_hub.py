"""Sharing a policy: what the page says of a run, what would be uploaded, and that what was shared acts as before."""

import json
import re
import shutil
import subprocess
import sys
from collections import OrderedDict
from pathlib import Path
from typing import Any

import huggingface_hub
import numpy as np
import pytest
import yaml
from huggingface_hub import ModelCard
from typer.testing import CliRunner

import sb3_crc.experiments.hub as hub
from sb3_crc import CRCSAC, make_dmc
from sb3_crc.cli import app
from sb3_crc.experiments.final import evaluate_final
from sb3_crc.experiments.hub import upload, write_repository
from sb3_crc.experiments.runs import Run
from sb3_crc.zoo import main
from tests.conftest import POLICY_KWARGS
from tests.test_zoo import ROOT

ENV = "dmc_pixels/cartpole-balance-v0"
NAME = "dmc_pixels-cartpole-balance-v0"
ENV_KWARGS = {"image_size": 36, "frame_stack": 2, "render_quality": "fast", "action_repeat": 40}
SETTINGS = {
    "n_timesteps": 30,
    "policy": "CnnPolicy",
    "env_kwargs": ENV_KWARGS,
    "learning_starts": 25,
    "buffer_size": 100,
    "batch_size": 16,
    "policy_kwargs": POLICY_KWARGS,
}


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run as train.py leaves it, not evaluated, with a film and a best model that are none of the final policy's."""
    run = tmp_path_factory.mktemp("logs") / "crc" / f"{NAME}_1"
    (run / NAME).mkdir(parents=True)
    learning = {key: value for key, value in SETTINGS.items() if key not in ("n_timesteps", "policy", "env_kwargs")}
    model = CRCSAC("CnnPolicy", make_dmc("cartpole-balance", seed=3, **ENV_KWARGS), seed=3, device="cpu", **learning)
    model.learn(30)
    model.save(run / f"{NAME}.zip")
    flags = {"algo": "crc", "env": ENV, "seed": 3, "n_timesteps": -1, "env_kwargs": None, "eval_episodes": 2}
    private = {"log_folder": "/home/somebody/logs", "wandb_entity": "somebody"}
    for name, content in {"args.yml": {**flags, **private}, "config.yml": SETTINGS}.items():
        (run / NAME / name).write_text(yaml.dump(OrderedDict(sorted(content.items()))))
    np.savez(run / "evaluations.npz", timesteps=[30], results=[[123.4, 123.4]])
    (run / "progress.csv").write_text("train/critic_loss\n1.0\n")
    (run / "policy.mp4").write_bytes(b"of the best policy")
    shutil.copy(run / f"{NAME}.zip", run / "best_model.zip")
    return run


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Run:
    copy = tmp_path / "logs" / "crc" / trained.name
    shutil.copytree(trained, copy)
    return Run(copy)


class FakeHub:
    """Keeps what is uploaded, as HfApi would send it."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, dict[str, Any]]] = []
        self.files: dict[str, bytes] = {}

    def create_repo(self, repo_id: str, **kwargs: Any) -> str:
        self.calls.append(("create_repo", {"repo_id": repo_id, **kwargs}))
        return f"https://huggingface.co/{repo_id}"

    def upload_folder(self, *, folder_path: Path, **kwargs: Any) -> None:
        self.calls.append(("upload_folder", kwargs))
        self.files = {path.name: path.read_bytes() for path in Path(folder_path).iterdir()}


@pytest.fixture
def fake_hub(monkeypatch: pytest.MonkeyPatch) -> FakeHub:
    fake = FakeHub()
    monkeypatch.setattr(huggingface_hub, "HfApi", lambda: fake)
    monkeypatch.setattr(huggingface_hub, "get_token", lambda: "hf_token")
    return fake


def shell(*arguments: str) -> tuple[int, str]:
    outcome = CliRunner().invoke(app, arguments)
    return outcome.exit_code, outcome.output


# -- The page ----------------------------------------------------------------------------------------------------------


def test_without_an_evaluation_the_page_has_no_score(run: Run, tmp_path: Path) -> None:
    write_repository(run, tmp_path / "page", "me/policy", filmed=False)
    card = ModelCard.load(tmp_path / "page" / "README.md")
    assert "**Not evaluated.**" in card.text
    assert "+/-" not in card.content and "123.4" not in card.content  # evaluations during training are no score
    assert card.data.eval_results is None
    assert card.data.library_name == "stable-baselines3"
    assert {ENV, "reinforcement-learning", "stable-baselines3"} <= set(card.data.tags)


def test_with_one_the_hub_reads_mean_and_deviation_of_the_final_policy(run: Run, tmp_path: Path) -> None:
    returns = evaluate_final(run, episodes=3)["returns"]
    write_repository(run, tmp_path / "page", "me/policy", filmed=False)
    card = ModelCard.load(tmp_path / "page" / "README.md")
    (result,) = card.data.eval_results
    assert (result.task_type, result.dataset_type, result.metric_type) == ("reinforcement-learning", ENV, "mean_reward")
    mean, deviation = map(float, result.metric_value.split(" +/- "))
    assert (mean, deviation) == pytest.approx((np.mean(returns), np.std(returns)), abs=0.006)
    assert "of 3 fresh episodes" in card.text and ", ".join(f"{value:.1f}" for value in returns) in card.text
    assert "after exactly 1,200 environment steps" in card.text and "seed was 10000" in card.text
    assert "cannot be compared with published ones" in card.text  # render_quality="fast"


def test_a_training_that_was_stopped_says_how_much_it_has_seen(run: Run, tmp_path: Path) -> None:
    (run.folder / NAME / "config.yml").write_text(yaml.dump({**SETTINGS, "n_timesteps": 50}))
    write_repository(Run(run.folder), tmp_path / "page", "me/policy", filmed=False)
    text = (tmp_path / "page" / "README.md").read_text()
    assert "It has seen 1,200 environment steps (30 decisions); it was meant for 2,000." in text


def test_the_pages_program_runs_the_policy(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_repository(run, tmp_path / "page", "me/policy", filmed=False)
    (program,) = re.findall(r"```python\n(.*?)```", (tmp_path / "page" / "README.md").read_text(), re.DOTALL)
    asked: list[tuple[str, str]] = []

    def download(repo_id: str, filename: str) -> str:
        asked.append((repo_id, filename))
        return str(tmp_path / "page" / filename)

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", download)
    printed: list[float] = []
    exec(program, {"print": printed.append})
    assert asked == [("me/policy", "policy.sb3crc")]
    env = make_dmc("cartpole-balance", **ENV_KWARGS)
    model, (observation, _), total, ended = CRCSAC.load(run.model, device="cpu"), env.reset(seed=0), 0.0, False
    while not ended:
        observation, reward, _, ended, _ = env.step(model.predict(observation, deterministic=True)[0])
        total += float(reward)
    assert printed == [pytest.approx(total)]


def test_the_film_is_of_the_final_policys_first_episode(run: Run, tmp_path: Path) -> None:
    import av

    first = evaluate_final(run, episodes=2)["returns"][0]
    write_repository(run, tmp_path / "page", "me/policy")
    assert f"with a return of {first:.1f}" in (tmp_path / "page" / "README.md").read_text()
    with av.open(str(tmp_path / "page" / "replay.mp4")) as container:
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(pictures) == 25 and pictures[0].std() > 10
    assert np.abs(pictures[0].astype(float) - pictures[-1]).max() > 50


# -- The files ---------------------------------------------------------------------------------------------------------


def test_settings_are_plain_and_nothing_private_leaves(run: Run, tmp_path: Path) -> None:
    page = tmp_path / "page"
    write_repository(run, page, "me/policy", filmed=False)
    assert yaml.safe_load((page / "config.yml").read_text()) == SETTINGS
    assert yaml.safe_load((page / "args.yml").read_text()) == {
        "algo": "crc",
        "env": ENV,
        "seed": 3,
        "n_timesteps": -1,
        "eval_episodes": 2,
        "env_kwargs": ENV_KWARGS,
    }
    for path in page.iterdir():
        assert b"somebody" not in path.read_bytes(), path.name
    named = set(re.findall(r"^\| `(.*?)` \|", (page / "README.md").read_text(), re.MULTILINE))
    assert named == {path.name for path in page.iterdir()} - {"README.md"}


def test_a_folder_in_which_there_is_something_is_left_alone(run: Run, tmp_path: Path) -> None:
    (tmp_path / "page").mkdir()
    (tmp_path / "page" / "thesis.tex").write_text("years of work")
    with pytest.raises(ValueError, match="must be a new or an empty folder"):
        write_repository(run, tmp_path / "page", "me/policy")
    assert [path.name for path in (tmp_path / "page").iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize("repo_id", ["policy", "me/", "/policy", "me/policies/one"])
def test_repositories_have_an_owner_and_a_name(repo_id: str, run: Run, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="must have the form user/name"):
        write_repository(run, tmp_path / "page", repo_id)


# -- Uploads -----------------------------------------------------------------------------------------------------------


def test_push_uploads_what_output_writes(run: Run, tmp_path: Path, fake_hub: FakeHub) -> None:
    code, output = shell("push", str(run.folder), "--repo-id", "me/policy", "--no-film", "-o", str(tmp_path / "page"))
    assert code == 0 and fake_hub.calls == []
    assert "not evaluated, and the page says so" in output
    code, output = shell("push", str(run.folder), "--repo-id", "me/policy", "--no-film", "-o", str(tmp_path / "too"), "--json")
    document = json.loads(output[output.index("{") :])
    assert document["address"] is None and document["files"].keys() == {path.name for path in (tmp_path / "page").iterdir()}
    code, output = shell("push", str(run.folder), "--repo-id", "me/policy", "--no-film", "--private", "-m", "First")
    assert code == 0, output
    assert "https://huggingface.co/me/policy" in output
    assert fake_hub.calls == [
        ("create_repo", {"repo_id": "me/policy", "private": True, "exist_ok": True}),
        ("upload_folder", {"repo_id": "me/policy", "commit_message": "First"}),
    ]
    assert fake_hub.files.keys() == {path.name for path in (tmp_path / "page").iterdir()}
    for name in ("README.md", "config.yml", f"crc-{NAME}.zip"):
        assert fake_hub.files[name] == (tmp_path / "page" / name).read_bytes()


def test_a_training_that_has_not_ended_is_not_shared(run: Run, fake_hub: FakeHub) -> None:
    run.model.unlink()
    code, output = shell("push", str(run.folder), "--repo-id", "me/policy")
    assert code == 2 and "its training has not ended" in output and fake_hub.calls == []


def test_without_a_token_a_line_says_how_to_get_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(huggingface_hub, "get_token", lambda: None)
    with pytest.raises(ValueError, match="no access token of Hugging Face: log in by `hf auth login`, or set HF_TOKEN"):
        upload(tmp_path, "me/policy")


def test_without_hugging_face_the_extra_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(hub.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"needs the extra 'zoo': pip install 'sb3-crc\[zoo\]'"):
        upload(tmp_path, "me/policy")


def test_without_a_network_a_line_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(huggingface_hub, "get_token", lambda: "hf_token")
    api = huggingface_hub.HfApi
    monkeypatch.setattr(huggingface_hub, "HfApi", lambda: api(endpoint="http://127.0.0.1:9"))  # nobody listens there
    with pytest.raises(ConnectionError, match=r"me/policy could not be uploaded: .*(refused|connect)"):
        upload(tmp_path, "me/policy")


# -- The zoo's commands ------------------------------------------------------------------------------------------------


def test_what_push_to_hub_writes_becomes_a_run_again(
    run: Run, tmp_path: Path, fake_hub: FakeHub, monkeypatch: pytest.MonkeyPatch
) -> None:
    flags = ["--algo", "crc", "--env", ENV, "-orga", "me"]
    main(["push_to_hub", *flags, "-f", str(run.folder.parents[1]), "--no-render"])
    (_, created), _ = fake_hub.calls
    assert created["repo_id"] == f"me/crc-{NAME}"

    def download(repo_id: str, filename: str, **_: Any) -> str:
        if filename not in fake_hub.files:
            response = type("Response", (), {"headers": {}, "request": None, "status_code": 404})()
            raise huggingface_hub.errors.RemoteEntryNotFoundError(f"404: {filename}", response=response)
        (tmp_path / "cache").mkdir(exist_ok=True)
        (tmp_path / "cache" / filename).write_bytes(fake_hub.files[filename])
        return str(tmp_path / "cache" / filename)

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", download)
    monkeypatch.delenv("TRUST_REMOTE_CODE", raising=False)
    with pytest.raises(SystemExit, match="sb3_crc.load_policy"):
        main(["load_from_hub", *flags, "-f", str(tmp_path / "theirs")])
    monkeypatch.setenv("TRUST_REMOTE_CODE", "True")
    main(["load_from_hub", *flags, "-f", str(tmp_path / "theirs")])

    theirs = Run(tmp_path / "theirs" / "crc" / f"{NAME}_1")
    assert (theirs.preset, theirs.seed, theirs.budget, theirs.env_kwargs) == ("crc", 3, 1_200, ENV_KWARGS)
    assert theirs.settings == SETTINGS
    assert evaluate_final(theirs, episodes=2)["returns"] == evaluate_final(run, episodes=2)["returns"]
    assert (theirs.folder / "evaluations.npz").exists() and (theirs.folder / "progress.csv").exists()


@pytest.mark.parametrize("command", ["push_to_hub", "load_from_hub"])
def test_both_have_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    assert "--organization" in capsys.readouterr().out


def test_a_run_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"crc.* was not found"):
        main(["push_to_hub", "--algo", "crc", "--env", ENV, "-f", str(tmp_path), "-orga", "me"])


@pytest.mark.slow
def test_the_pages_settings_train_again(run: Run, tmp_path: Path) -> None:
    write_repository(run, tmp_path / "page", "me/policy", filmed=False)
    text = (tmp_path / "page" / "README.md").read_text()
    (settings,), (command,) = (
        re.findall(pattern, text, re.DOTALL) for pattern in (r"```yaml\n(.*?)```", r"(python train.py.*?)\n")
    )
    (tmp_path / "settings.yml").write_text(settings)
    program = [sys.executable, str(ROOT / "train.py"), *command.split()[2:], "--device", "cpu", "--verbose", "0"]
    done = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-2000:]
    again = Run(tmp_path / "logs" / "crc" / f"{NAME}_1")
    assert json.dumps(again.settings, sort_keys=True) == json.dumps(SETTINGS, sort_keys=True) and again.seed == 3
