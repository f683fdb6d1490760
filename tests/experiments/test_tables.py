"""The paper's tables with ours beside: figures by hand, what is refused, and what is listed instead of averaged."""

import io
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import trim_mean
from typer.testing import CliRunner

from sb3_crc.cli import app
from sb3_crc.experiments.published import SIX_TASKS
from sb3_crc.experiments.scores import COLUMNS, Missing, MixedProtocols, Scores, write_scores
from sb3_crc.experiments.table_formats import CSV_COLUMNS, FORMATS, MISSING, render
from sb3_crc.experiments.tables import SIX_TASK_MEAN, paper_table

CARTPOLE, QUADRUPED = "cartpole-swingup", "quadruped-walk"


def run(
    method: str, seed: int, returns: Sequence[float], *, task: str = CARTPOLE, policy: str = "final", **other: Any
) -> list[dict[str, Any]]:
    """Rows of one evaluation, an episode each"""
    row = dict.fromkeys(COLUMNS) | {
        "method": method,
        "preset": method,
        "task": task,
        "seed": seed,
        "policy": policy,
        "budget": 100_000,
        "environment_steps": 100_000,
        "first_seed": 10_000,
        "episodes": len(returns),
        "action_repeat": 8,
        "render_quality": "benchmark",
        "run": f"runs/{method}/{task}/{seed}",
    }
    return [row | other | {"episode": episode, "return": float(value)} for episode, value in enumerate(returns)]


def scores_of(*runs: list[dict[str, Any]], missing: tuple[Missing, ...] = ()) -> Scores:
    return Scores(pd.DataFrame([row for rows in runs for row in rows], columns=list(COLUMNS)), missing)


@pytest.fixture
def scores() -> Scores:
    return scores_of(
        run("state_sac", 0, [900, 800], render_quality="none"),
        run("rad", 0, [500, 700]),
        run("rad", 1, [400, 500]),
        run("curl", 0, [500, 500]),
        run("crc", 0, [700, 900]),
        run("crc", 1, [500, 700]),
        missing=(Missing("crc", CARTPOLE, 2, "failed"), Missing("curl", CARTPOLE, 1, "not begun")),
    )


def test_figures_by_hand(scores: Scores) -> None:
    table = paper_table(scores, "100k")
    crc = table.ours["crc"][CARTPOLE]
    assert (crc.mean, crc.std, crc.seeds) == (700, pytest.approx(np.sqrt(20_000)), 2)
    assert (crc.lowest, crc.highest, crc.iqm, crc.budgets) == (600, 800, 700, (100_000,))
    assert crc.percent_over_our_curl == pytest.approx(40)
    assert crc.percent_over_published_curl == pytest.approx(100 * (700 / 582 - 1))
    curl = table.ours["curl"][CARTPOLE]
    assert (curl.mean, curl.std, curl.seeds, curl.percent_over_our_curl) == (500, None, 1, None)
    assert table.published["CURL"][CARTPOLE].mean == 582 and table.published["CURL"][CARTPOLE].std == 146


def test_the_iqm_is_that_of_rliable() -> None:
    returns = [0.0, 400.0, 500.0, 800.0, 900.0]
    table = paper_table(scores_of(*(run("crc", seed, [value]) for seed, value in enumerate(returns))), "100k")
    assert table.ours["crc"][CARTPOLE].iqm == pytest.approx(trim_mean(returns, 0.25))
    assert table.ours["crc"][CARTPOLE].iqm != table.ours["crc"][CARTPOLE].mean


def test_presets_in_their_order_then_stock_methods(scores: Scores) -> None:
    variant = run("crc with shifts", 0, [600, 600], preset="crc")
    both = scores_of(variant, scores.table.to_dict("records"))
    assert list(paper_table(both, "100k").ours) == ["crc", "crc with shifts", "curl", "rad", "state_sac"]


def test_only_final_policies_count(scores: Scores) -> None:
    others = [run("crc", seed, [1000, 1000], policy=policy) for seed in range(3) for policy in ("current", "best")]
    more = scores_of(scores.table.to_dict("records"), *others)
    assert paper_table(more, "100k").ours == paper_table(scores, "100k").ours


def six_tasks(method: str, seeds: dict[int, float], **other: Any) -> list[list[dict[str, Any]]]:
    """On task number t, a seed's return is 10 t more than on the first"""
    return [
        run(method, seed, [value + 10 * place], task=task, **other)
        for place, task in enumerate(SIX_TASKS)
        for seed, value in seeds.items()
    ]


def test_the_mean_of_six_tasks_needs_all_six() -> None:
    crc = six_tasks("crc", {0: 400, 1: 600})
    rad = six_tasks("rad", {0: 300})[:-1]
    table = paper_table(scores_of(*crc, *rad, *six_tasks("curl", {0: 350})), "100k")
    assert table.rows[-1] == SIX_TASK_MEAN
    mean = table.ours["crc"][SIX_TASK_MEAN]
    assert (mean.mean, mean.seeds, mean.lowest, mean.highest) == (525, 2, 425, 625)
    assert mean.std == pytest.approx(np.std([425, 625], ddof=1))
    assert mean.iqm == pytest.approx(trim_mean([base + 10 * place for base in (400, 600) for place in range(6)], 0.25))
    assert mean.percent_over_our_curl == pytest.approx(40)
    assert mean.percent_over_published_curl == pytest.approx(100 * (525 / table.published["CURL"][SIX_TASK_MEAN].mean - 1))
    assert SIX_TASK_MEAN not in table.ours["rad"] and SIX_TASK_MEAN not in table.published["SODA"]
    assert table.published["CRC-RL"][SIX_TASK_MEAN].mean == pytest.approx((793 + 813 + 636 + 355 + 490 + 832) / 6)


def test_the_mean_of_six_tasks_says_when_seeds_differ() -> None:
    runs = six_tasks("crc", {0: 400, 1: 600})
    table = paper_table(scores_of(*runs[:-1]), "100k")
    mean = table.ours["crc"][SIX_TASK_MEAN]
    assert (mean.seeds, mean.std, mean.iqm) == (None, None, None)
    assert mean.mean == pytest.approx((500 + 510 + 520 + 530 + 540 + 450) / 6)
    assert "(seeds differ)" in render(table, "text")


@pytest.mark.parametrize("format", ["text", "markdown", "latex"])
def test_what_is_missing_is_listed(scores: Scores, format: str) -> None:
    text = render(paper_table(scores, "100k"), format)
    _, listed = text.split(MISSING)
    named = f"crc on {CARTPOLE}, seed 2: failed", f"curl on {CARTPOLE}, seed 1: not begun"
    assert all(name in listed for name in named)
    assert "(1 seed)" in text and "(2 seeds)" in text
    assert MISSING not in render(paper_table(scores_of(run("crc", 0, [1])), "100k"), format)


@pytest.mark.parametrize(
    ("column", "value"), [("render_quality", "fast"), ("first_seed", 7), ("action_repeat", 4), ("episodes", 2)]
)
def test_mixed_protocols_are_refused_unless_asked_for(column: str, value: Any) -> None:
    returns = [600, 600] if column == "episodes" else [600]
    mixed = scores_of(run("crc", 0, [700]), run("rad", 0, returns, **{column: value}))
    with pytest.raises(MixedProtocols, match=rf"{CARTPOLE}: {column} differs: (?=.*\(crc\))(?=.*\(rad\))"):
        paper_table(mixed, "100k")
    table = paper_table(mixed, "100k", allow_mixed=True)
    assert table.ours["rad"][CARTPOLE].mean == 600
    (note,) = [note for note in table.notes if note.startswith(f"Ours on {CARTPOLE}")]
    assert f"{column.replace('_', ' ')} " in note and f"{value} (rad)" in note and "(crc)" in note


def test_other_budgets_are_refused_unless_asked_for() -> None:
    short = scores_of(run("crc", 0, [700]), run("rad", 0, [600], budget=50_000))
    with pytest.raises(ValueError, match=f"100,000 environment steps, .*: rad on {CARTPOLE}: 50,000"):
        paper_table(short, "100k")
    table = paper_table(short, "100k", allow_mixed=True)
    assert table.ours["rad"][CARTPOLE].percent_over_published_curl is None, "CURL's figure is of twice the steps"
    assert any("50,000 (rad) and 100,000 (crc)" in note for note in table.notes)
    with pytest.raises(ValueError, match="the table 500k takes runs of 500,000"):
        paper_table(scores_of(run("crc", 0, [700])), "500k")


def test_harder_tasks_at_500k_take_300k_too() -> None:
    early = [run(name, 0, [80], task=QUADRUPED, budget=300_000, action_repeat=2) for name in ("crc", "curl")]
    table = paper_table(scores_of(*early), "500k")
    crc = table.ours["crc"][QUADRUPED]
    assert (crc.percent_over_our_curl, crc.percent_over_published_curl) == (0, None)
    assert table.published["CRC-RL"][QUADRUPED].environment_steps == 300_000
    assert any(QUADRUPED in note and "300,000" in note for note in table.notes)
    (row,) = [line for line in render(table, "markdown").splitlines() if line.startswith(f"| {QUADRUPED} | 88")]
    assert row.startswith(f"| {QUADRUPED} | 88 ± 51 at 300k | 39 ± 22 |") and "| 80 (1 seed) at 300k |" in row
    late = paper_table(scores_of(run("crc", 0, [78], task=QUADRUPED, budget=500_000)), "500k")
    assert late.ours["crc"][QUADRUPED].percent_over_published_curl == pytest.approx(100)
    with pytest.raises(MixedProtocols, match="budget differs"):
        paper_table(scores_of(early[0], run("rad", 0, [80], task=QUADRUPED, budget=500_000, action_repeat=2)), "500k")
    with pytest.raises(MixedProtocols, match=f"crc on {CARTPOLE}: 300,000"):
        paper_table(scores_of(run("crc", 0, [80], budget=300_000)), "500k")


def test_a_seed_that_was_run_twice_is_refused() -> None:
    twice = scores_of(run("crc", 0, [700]), run("crc", 0, [900], run="elsewhere"))
    with pytest.raises(ValueError, match=f"crc on {CARTPOLE}, seed 0 was run more than once: runs/.*, elsewhere"):
        paper_table(twice, "100k", allow_mixed=True)


def test_a_half_written_evaluation_is_refused() -> None:
    with pytest.raises(ValueError, match="runs/crc/.*/0 is not whole: 1 of 3 episodes"):
        paper_table(scores_of(run("crc", 0, [1, 2, 3])[:1]), "100k")
    with pytest.raises(ValueError, match="an episode without a return"):
        paper_table(scores_of(run("crc", 0, [1, float("nan"), 3])), "100k")


def test_states_have_no_render_quality_to_differ_in(scores: Scores) -> None:
    assert paper_table(scores, "100k").ours["state_sac"][CARTPOLE].mean == 850


def test_tasks_that_the_paper_has_not_get_a_row() -> None:
    table = paper_table(scores_of(run("crc", 0, [700], task="walker-stand")), "100k")
    assert table.tasks == (*SIX_TASKS, "walker-stand")


@pytest.mark.parametrize("name", ["100k", "500k"])
@pytest.mark.parametrize("format", list(FORMATS))
def test_without_runs_the_published_table_is_left(name: str, format: str) -> None:
    text = render(paper_table(scores_of(), name), format)
    assert "MLR" in text and "no run with a score" in re.sub(r"\s+", " ", text)


def test_csv_comes_back(scores: Scores) -> None:
    table = paper_table(scores, "100k")
    read = pd.read_csv(io.StringIO(render(table, "csv")))
    assert tuple(read.columns) == CSV_COLUMNS and set(read["kind"]) == {"published", "ours", "missing", "note"}
    (crc,) = read[(read["kind"] == "ours") & (read["method"] == "crc")].to_dict("records")
    ours = table.ours["crc"][CARTPOLE]
    assert all(
        crc[name] == pytest.approx(getattr(ours, name)) for name in ("mean", "std", "seeds", "iqm", "lowest", "highest")
    )
    assert crc["percent_over_published_curl"] == pytest.approx(ours.percent_over_published_curl)
    of_drq = read[(read["method"] == "DrQ [K=1,M=1]") & (read["task"] == CARTPOLE)]
    assert of_drq["mean"].tolist() == [537] and of_drq["source"].str.contains("2004.13649").all()
    missing = read[read["kind"] == "missing"]
    assert missing[["method", "task", "seed", "note"]].values.tolist() == [
        ["crc", CARTPOLE, 2, "failed"],
        ["curl", CARTPOLE, 1, "not begun"],
    ]
    assert tuple(read[read["kind"] == "note"]["note"]) == table.notes


def test_markdown_has_a_cell_for_each_column(scores: Scores) -> None:
    named = scores_of(run("crc | wide", 0, [700, 900], preset="crc"), scores.table.to_dict("records"))
    text = render(paper_table(named, "100k"), "markdown")
    blocks = [block.splitlines() for block in text.split("\n\n") if block.startswith("|")]
    assert len(blocks) == 2
    for block in blocks:
        assert len({len(re.findall(r"(?<!\\)\|", row)) for row in block}) == 1
    header, _, first, *_ = blocks[0]
    cells = dict(zip(header.strip("| ").split(" | "), first.strip("| ").split(" | "), strict=True))
    assert (cells["task"], cells["CRC-RL"], cells["ours: rad"]) == (CARTPOLE, "813 ± 45", "525 ± 106 (2 seeds)")


def test_latex_is_balanced(scores: Scores) -> None:
    named = scores_of(
        run("a_b & 50 % {c} #1 \\", 0, [700, 900], preset="crc"), scores.table.to_dict("records"), missing=scores.missing
    )
    text = render(paper_table(named, "100k"), "latex")
    tabulars = re.findall(r"\\begin\{tabular\}\{([lr]+)\}\n(.*?)\\end\{tabular\}", text, re.S)
    assert len(tabulars) == 2 and text.count(r"\begin{itemize}") == text.count(r"\end{itemize}") == 2
    for columns, body in tabulars:
        rows = [row for row in body.splitlines() if row not in (r"\toprule", r"\midrule", r"\bottomrule")]
        assert all(row.endswith(r" \\") for row in rows)
        assert {len(re.findall(r"(?<!\\)&", row)) for row in rows} == {len(columns) - 1}
    prose = "\n".join(text.splitlines()[1:])
    assert r"a\_b \& 50 \% \{c\} \#1 \textbackslash{}" in prose and r"813 $\pm$ 45" in prose
    assert not re.search(r"(?<!\\)[_%#^]", prose) and "±" not in prose
    assert len(re.findall(r"(?<!\\)\{", prose)) == len(re.findall(r"(?<!\\)\}", prose))
    assert len(re.findall(r"(?<!\\)\$", prose)) % 2 == 0


def test_text_has_a_line_for_each_row(scores: Scores) -> None:
    lines = render(paper_table(scores, "100k"), "text").splitlines()
    (row,) = [line for line in lines if line.split()[:1] == [CARTPOLE] and "813 ± 45" in line]
    assert "700 ± 141 (2 seeds)" in row
    assert any("DrQ [K=1,M=1]" in line and "ours: crc" in line for line in lines), "no markup was taken out of it"


def test_unknown_names_are_refused_with_the_nearest(scores: Scores) -> None:
    with pytest.raises(ValueError, match="unknown format 'md'; did you mean"):
        render(paper_table(scores, "100k"), "md")
    with pytest.raises(ValueError, match="unknown table '500'; did you mean '500k'"):
        paper_table(scores, "500")


def test_from_files_to_text(scores: Scores, tmp_path: Path) -> None:
    file = tmp_path / "scores.csv"
    write_scores(scores, file)
    done = CliRunner().invoke(app, ["table", "100k", str(file), "--format", "markdown"])
    assert "700 ± 141 (2 seeds)" in done.stdout and f"curl on {CARTPOLE}, seed 1: absent" in done.stdout
    found = json.loads(CliRunner().invoke(app, ["table", "100k", str(file), "--json"]).stdout)
    assert found["ours"]["crc"][CARTPOLE]["mean"] == 700 and found["ours"]["crc"][CARTPOLE]["seeds"] == 2
    assert {"method": "curl", "task": CARTPOLE, "seed": 1, "reason": "absent"} in found["missing"]
    done = CliRunner().invoke(app, ["table", "100k", str(tmp_path / "no such file"), "--format", "html"])
    assert done.exit_code == 2 and "unknown format" in done.stderr
