"""The page about runs: what stands in it, and that a browser shows it."""

import json
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image
from typer.testing import CliRunner

from sb3_crc.cli import app
from sb3_crc.experiments.report.contents import POINTS, all_contents, differing_settings, run_media
from sb3_crc.experiments.report.page import LARGEST, write_report
from sb3_crc.experiments.runs import FINAL, PROVENANCE, write_json

pytest.importorskip("plotly")
pytest.importorskip("rliable")
ENV = "dmc_pixels-cartpole-swingup-v0"
STEPS = 12_500


def make_run(
    root: Path, method: str = "crc", seed: int = 0, *, level: float = 800, ended: bool = True, **settings: Any
) -> Path:
    """The folder that ``train.py`` and ``sb3-crc evaluate`` leave, without training."""
    folder = root / f"{method}_{seed}" / method / f"{ENV}_1"
    described = folder / ENV
    described.mkdir(parents=True)
    arguments = {
        "algo": method,
        "env": "dmc_pixels/cartpole-swingup-v0",
        "seed": seed,
        "n_timesteps": STEPS,
        "env_kwargs": None,
    }
    (described / "args.yml").write_text(yaml.safe_dump(list(map(list, arguments.items()))))
    own = {"batch_size": 128, "policy_kwargs": {"net_arch": [256, 256]}, **settings}
    (described / "config.yml").write_text(yaml.safe_dump(list(map(list, own.items()))))
    (described / "command.txt").write_text(f"train.py --algo {method} --seed {seed} <quick & dirty>")
    steps = np.arange(1, 11) * STEPS // 10
    returns = np.linspace(100, level, 10)[:, None] + seed + np.arange(3)
    np.savez(folder / "evaluations.npz", timesteps=steps, results=returns, updates=2 * steps, seconds=steps * 0.2, seeds=steps)
    rows = ["time/total_timesteps,train/critic_loss,representation/effective_rank,other"]
    rows += [f"{step},{1 / step:.8f},{'' if step % 100 else step / 100},1" for step in range(50, STEPS, 25)]
    (folder / "progress.csv").write_text("\n".join(rows) + "\n")
    write_json({"machine": {"processor": "abacus", "gpu": None}, "versions": {"torch": "2.0"}}, folder / PROVENANCE)
    if ended:
        (folder / f"{ENV}.zip").touch()
        at = {"environment_steps": 100_000, "agent_steps": STEPS, "updates": 1, "seconds": 1.0, "first_seed": 10_000}
        write_json({**at, "returns": [level + seed, level + seed + 2]}, folder / FINAL)
    return folder


def picture(path: Path, side: int = 64) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (side, side, 3), np.uint8)).save(path)


def page_of(*sources: Path, output: Path, **options: Any) -> tuple[str, dict[str, Any]]:
    write_report(sources, output, **options)
    text = output.read_text(encoding="utf-8")
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    assert found
    return text, json.loads(found[1])


def test_the_page_holds_scores_curves_settings_and_commands(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    for seed in range(2):
        make_run(runs, "crc", seed, level=800)
        make_run(runs, "rad", seed, level=600, batch_size=64)
    make_run(runs, "curl", 0, ended=False)
    text, data = page_of(runs, output=tmp_path / "report.html")
    assert '<td class="ours">802 ± 1 (2 seeds)</td>' in text  # 801 and 802, the means of their episodes
    assert "813 ± 45" in text  # what CRC-RL's paper has
    assert "curl on cartpole-swingup, seed 0: unfinished" in text
    assert "train.py --algo rad --seed 1 &lt;quick &amp; dirty&gt;" in text and "processor abacus" in text

    (task,) = data["tasks"]
    curve = task["curves"]["environment_steps"]["crc"]
    assert curve["x"][-1] == 100_000 and curve["y"][-1] == pytest.approx(801.5) and curve["seeds"] == 2
    assert curve["low"][-1] <= curve["y"][-1] <= curve["high"][-1]
    assert {(run["method"], run["seed"]) for run in task["runs"]} == {(m, s) for m in ("crc", "rad") for s in (0, 1)} | {
        ("curl", 0)
    }
    assert task["runs"][0]["seconds"][-1] == STEPS * 0.2
    assert len(set(data["colours"].values())) == 3


def test_instruments_are_thinned_and_empty_cells_left_out(tmp_path: Path) -> None:
    make_run(tmp_path, "crc")
    (contents,) = all_contents([tmp_path])
    assert set(contents.instruments) == {"train/critic_loss", "representation/effective_rank"}
    steps, values = contents.instruments["train/critic_loss"]
    assert len(steps) == len(values) == POINTS and (steps[0], steps[-1]) == (50, STEPS - 25)
    steps, values = contents.instruments["representation/effective_rank"]
    assert all(value == step / 100 for step, value in zip(steps, values, strict=True))


def test_settings_that_differ_are_shown_flat(tmp_path: Path) -> None:
    make_run(tmp_path, "crc", 0, tau=0.01)
    make_run(tmp_path, "crc", 1, tau=0.02, policy_kwargs={"net_arch": [256, 256], "layer_norm": True})
    contents = all_contents([tmp_path])
    assert differing_settings(contents) == {"tau": ["0.01", "0.02"], "policy_kwargs.layer_norm": ["", "True"]}


def test_runs_of_one_name_are_told_apart(tmp_path: Path) -> None:
    folders = [make_run(tmp_path / name, "crc", 0) for name in ("first", "second")]
    assert [contents.name for contents in all_contents([tmp_path])] == [
        f"crc, cartpole-swingup, seed 0 ({one})" for one in folders
    ]


def test_pictures_films_and_reconstructions_are_in_the_page(tmp_path: Path) -> None:
    tensorboard = pytest.importorskip("torch.utils.tensorboard")
    run = make_run(tmp_path / "runs", "crc")
    picture(run / "analysis" / "latents.png")
    picture(run / "learning_curve.png")  # drawn anew
    picture(tmp_path / "runs" / "tsne" / "tsne.png", side=3_000)
    (run / "policy.mp4").write_bytes(b"film")
    with tensorboard.SummaryWriter(str(run)) as writer:
        for step in range(20):
            writer.add_image("representation/painted", np.full((3, 8, 8), 10 * step, np.uint8), step)
    (contents,) = all_contents([tmp_path / "runs"])
    captions = [medium.caption.removeprefix(f"{contents.name}: ") for medium in run_media(contents)]
    painted = [caption for caption in captions if caption.startswith("representation/painted")]
    assert len(painted) == 8 and painted[-1] == "representation/painted after 19 agent steps"
    assert [caption for caption in captions if caption not in painted] == ["policy", "latents"]
    text, _ = page_of(tmp_path / "runs", output=tmp_path / "report.html")
    assert text.count("<figure>") == 11 and text.count("<video") == 1 and "tsne/tsne" in text


def test_what_would_make_the_page_too_large_is_left_out_and_named(tmp_path: Path) -> None:
    run = make_run(tmp_path / "runs", "crc")
    (run / "policy.mp4").write_bytes(bytes(3_000_000))
    picture(run / "small.png")
    room = 6_500_000
    left_out = write_report([tmp_path / "runs"], tmp_path / "report.html", largest=room)
    assert len(left_out) == 1 and left_out[0].endswith("policy (4.0 MB)")
    text = (tmp_path / "report.html").read_text()
    assert left_out[0] in text and ": small</figcaption>" in text and len(text.encode()) <= room


def test_scores_of_other_budgets_and_of_mixed_protocols_stand_apart(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    make_run(runs, "crc")
    make_run(runs, "rad", env_kwargs={"render_quality": "fast"})
    text, _ = page_of(runs, output=tmp_path / "report.html")
    assert "render_quality differs: benchmark (crc); fast (rad)" in text
    assert "<td>crc</td><td>cartpole-swingup</td><td>100,000</td><td>benchmark</td><td>1</td><td>801</td>" in text
    assert "<td>rad</td><td>cartpole-swingup</td><td>100,000</td><td>fast</td>" in text


def test_mistakes_are_one_line_and_leave_what_was_there(tmp_path: Path) -> None:
    runner, output = CliRunner(), tmp_path / "report.html"
    output.write_text("the last one")
    (tmp_path / "empty").mkdir()
    half = make_run(tmp_path / "half", "crc")
    (half / "evaluations.npz").write_bytes(b"PK\3\4 half")
    torn = make_run(tmp_path / "torn", "crc")
    (torn / "torn.png").write_bytes(b"half")
    for source, message in (
        ("nowhere", "nowhere is no folder"),
        ("empty", "no run and no score in"),
        ("half", "evaluations.npz cannot be read"),
        ("torn", "torn.png is no picture"),
    ):
        result = runner.invoke(app, ["report", str(tmp_path / source), "-o", str(output)])
        assert result.exit_code == 2 and message in result.output.replace("\n", "")
        assert output.read_text() == "the last one"
    result = runner.invoke(app, ["report", str(tmp_path / "empty"), "-o", str(tmp_path / "missing" / "report.html")])
    assert result.exit_code == 2 and "missing is no folder" in result.output.replace("\n", "")


# -- In a browser ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.alone
def test_thirty_runs_in_a_browser(tmp_path: Path, browser: Any) -> None:
    runs = tmp_path / "runs"
    for seed in range(10):
        for method, level in (("crc", 800), ("rad", 600), ("curl", 700)):
            run = make_run(runs, method, seed, level=level, batch_size=64 + seed)
            (run / "policy.mp4").write_bytes(np.random.default_rng(seed).bytes(150_000))
    output = tmp_path / "report.html"
    assert write_report([runs], output) == [] and output.stat().st_size <= LARGEST
    for width, scheme in ((1200, "light"), (390, "dark")):
        page = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme)
        said: list[str] = []
        asked: list[str] = []
        page.on("console", lambda message, said=said: said.append(message.text))
        page.on("pageerror", lambda error, said=said: said.append(str(error)))
        page.on("request", lambda request, asked=asked: asked.append(request.url))
        seconds = []
        for _ in range(3):
            begun = time.perf_counter()
            page.goto(output.as_uri())
            seconds.append(time.perf_counter() - begun)
        assert min(seconds) <= 2, seconds
        assert page.evaluate("document.documentElement.scrollWidth") <= width  # nothing sticks out
        theme = "document.documentElement.dataset.theme"
        assert page.evaluate(theme) == scheme
        page.click("#theme")
        assert page.evaluate(theme) == ("dark" if scheme == "light" else "light")

        lines, title = "document.querySelectorAll('#curves-0 .scatterlayer .trace').length", "#curves-0 .xtitle"
        both = page.evaluate(lines)
        assert both == 30 + 2 * 3  # runs; of each method the interval and the mean
        page.click("#each")
        assert page.evaluate(lines) == 2 * 3
        assert page.text_content(title) == "environment steps"
        page.click("[data-axis=seconds]")
        assert page.text_content(title).startswith("hours")
        page.select_option("#metric", "representation/effective_rank")
        assert page.text_content("#logged .gtitle") == "representation/effective_rank"
        colours = (
            "new Set([...document.querySelectorAll('#curves-0 .scatterlayer .trace path')].map(p => p.style.stroke)).size"
        )
        assert page.evaluate(colours) >= 3
        picture_of = page.screenshot(full_page=True)
        assert len(picture_of) > 30_000
        said = [line for line in said if "DEMUXER" not in line]  # the films are noise
        assert not said, said
        assert all(url.startswith(("file:", "data:", "blob:")) for url in asked)
        page.close()
