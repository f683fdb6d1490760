"""python -m sb3_crc.zoo: which command runs with which flags, and what each writes after a run of seconds."""

import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
import rl_zoo3
import rl_zoo3.enjoy

from sb3_crc import CRCSAC
from sb3_crc.envs.tasks import environment_id, task_names
from sb3_crc.zoo import main, preset_class
from sb3_crc.zoo.algorithms import watched
from sb3_crc.zoo.commands import COMMANDS
from sb3_crc.zoo.figures import figures, normalized_inputs, register_reference_scores
from tests.conftest import make_model
from tests.test_zoo import ROOT

BALANCE = "dmc_pixels/cartpole-balance-v0"
RUN = "dmc_pixels-cartpole-balance-v0"

# -- Arguments ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("arguments", "code"), [([], 2), (["--help"], 0)])
def test_without_a_command_there_is_usage(arguments: list[str], code: int, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == code
    usage = capsys.readouterr().out
    assert usage.startswith("usage: python -m sb3_crc.zoo <command>")
    assert all(f"\n  {command} " in usage for command in COMMANDS)


def test_an_unknown_command_is_met_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["record_vidoe", "--algo", "crc"])
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "unknown command 'record_vidoe'; did you mean 'record_video'?" in line


def test_train_takes_the_zoos_flags(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["train", "--help"])
    assert stop.value.code == 0
    assert "--max-total-trials" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("flags", "display", "implied", "reason"),
    [
        (["--env", "Pendulum-v1"], "", True, "There is no display"),
        (["--env", BALANCE], ":0", True, "open no window"),
        (["--env", "Pendulum-v1"], ":0", False, None),
        (["--env", BALANCE, "--no-render"], "", False, None),
    ],
)
def test_enjoy_opens_a_window_only_where_one_can_be(
    flags: list[str],
    display: str,
    implied: bool,
    reason: str | None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    seen: list[list[str]] = []
    monkeypatch.setattr(rl_zoo3.enjoy, "enjoy", lambda: seen.append(sys.argv[1:]))
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(sys, "argv", [])
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", display)
    main(["enjoy", *flags])
    assert seen == [[*flags, *["--no-render"] * implied]]
    output = capsys.readouterr().out
    assert (reason in output and "record_video" in output) if reason else output == ""


def test_who_only_watches_needs_no_replay_buffer(tmp_path: Path) -> None:
    make_model().save(tmp_path / "model.zip")
    assert preset_class("crc").load(tmp_path / "model.zip").buffer_size == 200
    model = watched(preset_class("crc")).load(tmp_path / "model.zip")
    assert model.buffer_size == 1
    assert isinstance(model, CRCSAC)


# -- Plots -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def pyplot() -> Iterator[Any]:
    backend = mpl.get_backend()
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    plt.close("all")
    yield plt
    plt.close("all")
    mpl.use(backend)


@pytest.mark.parametrize("given", [None, Path("elsewhere")])
def test_without_a_window_figures_become_files_that_name_the_unit(
    given: Path | None, pyplot: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shown: list[None] = []

    def show() -> None:
        shown.append(None)

    monkeypatch.setattr(pyplot, "show", show)
    with figures(given):
        pyplot.figure("Results of a/b")
        pyplot.plot([1, 2])
        pyplot.xlabel("Timesteps (in Million)")
        pyplot.show()
        assert pyplot.gca().get_xlabel() == "Agent steps (decisions) (in Million)"
    (written,) = tmp_path.rglob("*.png")
    assert written == tmp_path / (given or "figures") / "Results_of_a_b.png"
    assert written.stat().st_size > 1_000
    assert pyplot.show is show and not shown


@pytest.mark.parametrize("folder", [None, "given"])
def test_with_windows_figures_are_shown_unless_a_folder_is_given(
    folder: str | None, pyplot: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shown: list[str] = []
    monkeypatch.setattr(pyplot, "get_backend", lambda: "TkAgg")
    monkeypatch.setattr(pyplot, "show", lambda: shown.append(pyplot.gca().get_xlabel()))
    with figures(Path(folder) if folder else None):
        pyplot.figure("One")
        pyplot.xlabel("Timesteps")
        pyplot.show()
    assert shown == ([] if folder else ["Agent steps (decisions)"])
    assert [path.name for path in tmp_path.rglob("*.png")] == (["One.png"] if folder else [])


def test_every_task_of_the_suite_has_reference_scores() -> None:
    from rl_zoo3.plots import score_normalization

    register_reference_scores()
    count = len(score_normalization.reference_scores)
    register_reference_scores()
    assert len(score_normalization.reference_scores) == count
    for task in task_names():
        assert score_normalization.normalize_score(np.array([0.0, 250.0, 1000.0]), environment_id(task)).tolist() == [
            0,
            0.25,
            1,
        ]


def results(last: Any) -> dict[str, Any]:
    records = {"timesteps": np.array([30, 60]), "mean": np.array([100.0, 200.0]), "last_evals": last}
    return {"cartpole-balance-v0": {"CRC-logs": records}, "Ant": {"SAC-logs": records}, "results_table": {"headers": ["a"]}}


def test_rliable_gets_scores_of_suite_tasks_from_0_to_1(tmp_path: Path) -> None:
    (tmp_path / "results.pkl").write_bytes(pickle.dumps(results(np.array([400.0, 600.0]))))
    flags = ["-i", str(tmp_path / "results"), "-r", "-iqm", "--no-million", "--merge", str(tmp_path / "results.pkl")]
    with normalized_inputs(flags) as given:
        assert [flag for flag in given if not flag.endswith(".pkl")] == ["-i", "--merge", "-r", "-iqm", "--no-million"]
        for name in (flag for flag in given if flag.endswith(".pkl")):
            normalized = pickle.loads(Path(name).read_bytes())
            records = normalized["cartpole-balance-v0"]["CRC-logs"]
            assert records["timesteps"].tolist() == [30, 60]
            assert records["mean"].tolist() == [0.1, 0.2]
            assert records["last_evals"].tolist() == [0.4, 0.6]
            assert normalized["Ant"]["SAC-logs"]["mean"].tolist() == [100, 200]  # rl_zoo3 normalises its own
            assert normalized["results_table"] == {"headers": ["a"]}
    with normalized_inputs(["-i", "results", "-iqm"]) as given:
        assert given == ["-i", "results", "-iqm"]


def test_rliable_needs_two_runs_of_each_algorithm(tmp_path: Path) -> None:
    (tmp_path / "results.pkl").write_bytes(pickle.dumps(results(np.float64(400.0))))
    with (
        pytest.raises(SystemExit, match="two or more runs of each.*CRC-logs on dmc_pixels/cartpole-balance-v0"),
        normalized_inputs(["-i", str(tmp_path / "results"), "-r"]),
    ):
        pass


def test_plots_without_their_packages_name_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rl_zoo3.plots", None)
    with pytest.raises(SystemExit, match=r"all_plots needs the extra 'analysis'.*sb3-crc\[analysis\]"):
        main(["all_plots", "-a", "crc"])


# -- The commands themselves -------------------------------------------------------------------------------------------


def zoo(folder: Path, *arguments: str, **variables: str) -> str:
    headless = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    variables = {**headless, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), **variables}
    command = [sys.executable, "-m", "sb3_crc.zoo", *arguments]
    run = subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr[-3000:]
    return run.stdout


def train_flags(algo: str, *flags: str) -> list[str]:
    settings = ["--conf-file", str(ROOT / "tests" / "tiny.yml"), "-f", "logs", "--device", "cpu", "--verbose", "0"]
    return ["train", "--algo", algo, "--env", BALANCE, *settings, "--eval-freq", "30", "--eval-episodes", "2", *flags]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two tiny runs of each of two algorithms."""
    folder = tmp_path_factory.mktemp("zoo")
    for algo in ("crc", "rad"):
        for seed in ("1", "2"):
            zoo(folder, *train_flags(algo, "--seed", seed, *["--save-replay-buffer"] * (algo == "crc")))
    return folder


@pytest.mark.slow
def test_enjoy_prints_returns(runs: Path) -> None:
    flags = ["--algo", "crc", "--env", BALANCE, "-f", "logs", "--exp-id", "1", "-n", "55", "--load-best"]
    output = zoo(runs, "enjoy", *flags, "--reward-log", "watched")
    assert "There is no display: --no-render is implied" in output
    assert "best_model.zip" in output
    assert "2 Episodes\nMean reward: " in output
    _, header, *episodes = (runs / "watched" / "0.monitor.csv").read_text().splitlines()
    assert header == "r,l,t"
    assert [episode.split(",")[1] for episode in episodes] == ["25", "25"]  # decisions: the run's env_kwargs reached it


@pytest.mark.slow
def test_record_video_films_the_runs_own_environment(runs: Path) -> None:
    import av

    zoo(runs, "record_video", "--algo", "crc", "--env", BALANCE, "-f", "logs", "--exp-id", "1", "-n", "25", "-o", "films")
    (film,) = (runs / "films").glob("*.mp4")
    with av.open(str(film)) as container:
        video = container.streams.video[0]
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video)]
        assert (video.width, video.height) == (480, 480)
        assert float(video.average_rate) == pytest.approx(100 / 40)  # control steps a second / action_repeat
    assert len(pictures) == 26
    assert np.abs(pictures[0].astype(float) - pictures[-1]).max() > 50


@pytest.mark.slow
def test_plot_train_draws_the_training_episodes(runs: Path) -> None:
    output = zoo(runs, "plot_train", "-a", "crc", "-e", "cartpole-balance", "-f", "logs", "-w", "1", "--figures", "training")
    assert (runs / "training" / "Training_Episodic_Reward.png").stat().st_size > 10_000
    assert "Figure: training/Training_Episodic_Reward.png" in output


@pytest.mark.slow
def test_all_plots_and_rliable(runs: Path) -> None:
    flags = ["-a", "crc", "rad", "-e", "cartpole-balance-v0", "-f", "logs", "-o", "results", "--no-display", "--no-million"]
    output = zoo(runs, "all_plots", *flags, "-print")
    assert "cartpole-balance-v0-CRC-logs: 2" in output
    assert (runs / "figures" / "Results_cartpole-balance-v0.png").stat().st_size > 10_000
    gathered = pickle.loads((runs / "results.pkl").read_bytes())["cartpole-balance-v0"]
    for records in (gathered["CRC-logs"], gathered["RAD-logs"]):
        assert records["timesteps"].tolist() == [30, 60]
        assert records["last_evals"].shape == (2,)
    output = zoo(runs, "plot_from_file", "-i", "results", "-r", "-iqm", "-vs", "-o", "bars.svg", "--figures", "rliable")
    assert "divided by 1000" in output
    written = {path.name for path in (runs / "rliable").iterdir()}
    assert {"Rliable_metrics.png", "Performance_profiles.png", "Probability_of_Improvement.png"} <= written
    assert (runs / "bars.svg").stat().st_size > 1_000


@pytest.mark.slow
def test_resume_goes_on_with_networks_and_buffer(runs: Path) -> None:
    before = runs / "logs" / "crc" / f"{RUN}_1" / f"{RUN}.zip"
    output = zoo(runs, *train_flags("crc", "-i", str(before), "-n", "30", "-f", "resumed"))
    assert "Loading pretrained agent" in output and "Loading replay buffer" in output
    after = CRCSAC.load(runs / "resumed" / "crc" / f"{RUN}_1" / f"{RUN}.zip")
    assert after._n_updates == CRCSAC.load(before)._n_updates + 5  # agent steps 26 to 30: the warm-up counts anew
    assert after.num_timesteps == 30


@pytest.mark.slow
def test_wandb_offline_records_settings_and_metrics(tmp_path: Path) -> None:
    wandb_only = {"WANDB_MODE": "offline", "WANDB_SILENT": "true", "WANDB_DIR": str(tmp_path)}
    zoo(tmp_path, *train_flags("rad", "--track", "--wandb-project-name", "tests", "--log-interval", "1"), **wandb_only)
    (record,) = tmp_path.glob("wandb/offline-run-*/run-*.wandb")
    content = record.read_bytes()
    for name in (b"train/critic_loss", b"eval/mean_reward", b"saved_hyperparams", b"features_extractor_kwargs"):
        assert name in content, name
    shutil.rmtree(tmp_path / "wandb")
    assert list(tmp_path.rglob("progress.csv")) and list(tmp_path.rglob("runs/**/events.out.tfevents.*"))
