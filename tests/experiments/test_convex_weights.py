"""The triangle of the losses' weights."""

from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from sb3_crc.cli import app
from sb3_crc.configurations import CONFIGS
from sb3_crc.experiments.convex_weights import convex_weights, draw_weights
from sb3_crc.experiments.scores import Scores, write_scores
from tests.experiments.test_comparison_figures import REPS, is_drawn, scores_of

pytest.importorskip("rliable")


def test_the_convex_weights_of_the_second_ablation() -> None:
    weights = convex_weights(CONFIGS / "sweeps" / "ablation_2.yml")
    assert len(weights) == 10
    for name, shares in weights.items():
        assert sum(shares) == pytest.approx(1)
        assert [round(100 * share) for share in shares] == pytest.approx([int(part) for part in name.split("-")], abs=1)


def test_triangle_of_weights(tmp_path: Path) -> None:
    scores = scores_of({"c": 300, "r": 400, "k": 500, "equal": 600, "same": 620, "other": 1})
    third = (1 / 3, 1 / 3, 1 / 3)
    weights = {"c": (1.0, 0.0, 0.0), "r": (0.0, 1.0, 0.0), "k": (0.0, 0.0, 1.0), "equal": third, "same": third, "late": third}
    picture, text = draw_weights(scores, tmp_path / "new", weights, reps=REPS)
    assert is_drawn(picture)
    assert "| r | 0 | 1 | 0 | 402 (4" in text.read_text() and "- late: no final score" in text.read_text()
    assert "other" not in text.read_text()
    with pytest.raises(ValueError, match="weights of c are no shares of 1"):
        draw_weights(scores, tmp_path, {"c": (1.0, 1.0, 0.0)})
    with pytest.raises(ValueError, match="no triangle"):
        draw_weights(scores, tmp_path, {"late": third})


def test_the_command_lets_protocols_mix_here_too_and_reads_the_weights_first(tmp_path: Path) -> None:
    table = scores_of({"c": 300, "r": 400}, seeds=1, tasks=("cartpole-swingup",)).table
    table.loc[table["method"] == "r", "action_repeat"] = 4
    write_scores(Scores(table, ()), tmp_path / "scores.csv")
    variants = {"c": {"preset": "crc"}, "r": {"preset": "crc", "objectives.contrastive": 0.5}}
    sweep = {"tasks": ["cartpole-swingup"], "seeds": 1, "env_steps": 16_000, "variants": variants}
    (tmp_path / "sweep.yml").write_text(yaml.safe_dump(sweep))
    command = [
        "curves",
        str(tmp_path / "scores.csv"),
        "-o",
        str(tmp_path / "figures"),
        "--weights",
        str(tmp_path / "sweep.yml"),
    ]
    done = CliRunner().invoke(app, [*command, "--allow-mixed"])
    assert done.exit_code == 0 and (tmp_path / "figures" / "weights.md").exists(), done.output
    (tmp_path / "sweep.yml").write_text("tasks: []")
    done = CliRunner().invoke(app, [*command, "-o", str(tmp_path / "none")])
    assert done.exit_code == 2 and "is no sweep" in done.stderr and not (tmp_path / "none").exists()
