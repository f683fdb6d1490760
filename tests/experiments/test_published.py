"""The figures of papers that are shipped with the package."""

import pytest

from sb3_crc.envs.tasks import PAPER_TASKS
from sb3_crc.experiments.published import COLUMNS, HARDER_TASKS, NOTES, SIX_TASKS, STEPS, TASKS, published, read_published


def test_every_row_is_of_a_task_of_the_paper_and_says_where_it_is_from() -> None:
    rows = read_published()
    assert list(rows.columns) == ["method", "task", "environment_steps", "mean", "std", "seeds", "note", "source"]
    assert set(rows["task"]) == set(PAPER_TASKS)
    assert set(rows["environment_steps"]) == {100_000, 300_000, 500_000}
    assert rows["mean"].between(0, 1000).all() and not (rows["std"] < 0).any()
    assert not rows["source"].isna().any() and not rows["note"].isna().any()
    assert rows["source"].str.contains(r"arXiv \d{4}\.\d{5}|github\.com/|ICCV 2023|ojs\.aaai\.org", regex=True).all()
    assert not rows.duplicated(["method", "task", "environment_steps"]).any()
    everything = read_published().astype(str).agg(" ".join, axis=1).str.lower()
    assert not everything.str.contains(r"\bidx\b|index id").any()


def test_names_with_commas_are_whole() -> None:
    rows = read_published()
    assert (rows["method"] == "DrQ [K=2,M=2]").sum() == 2 * len(SIX_TASKS)


@pytest.mark.parametrize("table", list(COLUMNS))
def test_each_column_has_at_most_one_figure_for_a_task(table: str) -> None:
    cells = published(table)
    assert list(dict.fromkeys(cells["column"])) == list(COLUMNS[table])
    assert set(cells["task"]) == set(TASKS[table]) and set(cells["environment_steps"]) == set(STEPS[table])
    assert not cells.duplicated(["column", "task"]).any()
    for _, of_column in cells.groupby("column"):
        places = [TASKS[table].index(task) for task in of_column["task"]]
        assert places == sorted(places)


def test_the_figures_of_crc_rl() -> None:
    cells = published("100k")
    crc = cells[cells["column"] == "CRC-RL"].set_index("task")["mean"].to_dict()
    six = ("finger-spin", "cartpole-swingup", "reacher-easy", "cheetah-run", "walker-walk", "ball_in_cup-catch")
    assert crc == dict(zip(six, (793, 813, 636, 355, 490, 832), strict=True))


def test_at_500k_crc_rl_has_the_harder_tasks_at_300k_only() -> None:
    cells = published("500k")
    early = cells[cells["environment_steps"] == 300_000]
    assert set(early["column"]) == {"CRC-RL"} and tuple(early["task"]) == HARDER_TASKS
    assert set(cells[cells["column"] == "CRC-RL"]["task"]) == set(HARDER_TASKS)
    curl = cells[(cells["column"] == "CURL") & cells["task"].isin(HARDER_TASKS)]
    assert set(curl["environment_steps"]) == {500_000} and curl["source"].str.contains("CRC-RL").all()
    assert any("300k" in note and "unit not stated" in note for note in NOTES["500k"])


def test_soda_and_the_unit_of_steps_are_explained() -> None:
    assert any("Video-Easy" in note for note in NOTES["100k"])
    for notes in NOTES.values():
        assert any("agent steps" in note for note in notes) and any("±" in note for note in notes)


def test_an_unknown_table_is_refused_with_the_nearest() -> None:
    with pytest.raises(ValueError, match="unknown table '100K'; did you mean '100k'"):
        published("100K")
