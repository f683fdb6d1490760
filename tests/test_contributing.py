"""What contributors are told and given fits the project: the page on tests, the hooks, the issue templates."""

import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.named_tests import is_test

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs/contributing.md"
TEMPLATES = sorted(path for path in (ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml") if path.name != "config.yml")


def rows() -> list[list[str]]:
    """The table of SB3's tests: theirs, what it asks, ours."""
    table = PAGE.read_text().split("| SB3's test |", 1)[1]
    lines = [line for line in table.splitlines()[2:] if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_each_test_of_ours_beside_sb3s_exists() -> None:
    for theirs, asked, ours in rows():
        names = re.findall(r"`([^`]+)`", ours)
        assert names, f"{theirs}: nothing of ours"
        assert [name for name in names if not is_test(name)] == [], theirs
        assert asked
    assert not is_test("tests/test_conformity.py::test_that_is_not_there")


def test_each_test_that_was_written_for_sb3s_is_in_the_table() -> None:
    named = {name for row in rows() for name in re.findall(r"::(\w+)`", row[2])}
    own = re.findall(r"^def (test_\w+)", (ROOT / "tests/test_conformity.py").read_text(), re.MULTILINE)
    assert [name for name in own if name not in named] == []


def test_the_hooks_are_parts_of_make_lint() -> None:
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    makefile = (ROOT / "Makefile").read_text()
    lint = makefile.split("\nlint:", 1)[1].split("\n\n", 1)[0]
    tools = set(re.findall(r"\.venv/bin/[\w-]+", lint))
    assert {hook["entry"].split()[0] for hook in hooks} == tools
    assert all(hook["language"] == "system" for hook in hooks)  # nothing is downloaded


def test_a_hook_finds_what_lint_finds(tmp_path: Path) -> None:
    hook = next(h for h in yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"])
    program = ROOT / hook["entry"].split()[0]
    if not program.exists():
        pytest.skip("the tools are not in .venv")
    (tmp_path / "untidy.py").write_text("a   =  1\n")
    subprocess.run([program, *hook["entry"].split()[1:], "untidy.py"], cwd=tmp_path, check=True, capture_output=True)
    assert (tmp_path / "untidy.py").read_text() == "a = 1\n"


@pytest.mark.parametrize("path", TEMPLATES, ids=lambda path: path.stem)
def test_issues_ask_for_what_is_needed(path: Path) -> None:
    template: dict[str, Any] = yaml.safe_load(path.read_text())
    assert {"name", "description", "body"} <= template.keys()
    fields = {field["id"]: field for field in template["body"]}
    assert len(fields) == len(template["body"])
    assert all(field["attributes"]["label"] for field in fields.values())
    if path.stem in ("bug", "results"):
        assert {"doctor", "config"} <= fields.keys()
        assert "python -m sb3_crc doctor" in fields["doctor"]["attributes"]["label"]
        assert fields["doctor"]["validations"]["required"]


def test_there_is_a_template_for_each_kind_of_issue() -> None:
    assert [path.stem for path in TEMPLATES] == ["bug", "feature", "results"]
