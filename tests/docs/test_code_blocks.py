"""Every code block of README, CONTRIBUTING and docs/: Python runs, command lines and YAML are read by what would read them."""

import importlib
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.docs.command_lines import NotUnderstood, check_command_line
from tests.docs.fences import PAGES, ROOT, all_blocks, blocks_of, command_lines
from tests.docs.settings import check_yaml

#: Directives of MyST, whose content `make docs` reads
DIRECTIVES = {"{toctree}", "{eval-rst}", "{literalinclude}"}
SHELL = ("console", "sh")
LANGUAGES = {"python", "yaml", *SHELL}

#: Command lines that are run as they are
RUN = ("sb3-crc rendering", "sb3-crc doctor", "sb3-crc enjoy results/laptop/cartpole-swingup/policy.sb3crc")
LINES = {line: block for language in SHELL for block in all_blocks(language) for line in command_lines(block)}


def check_language(language: str) -> None:
    """:raises AssertionError: for code that nobody checks"""
    assert language.split(" ")[0] in DIRECTIVES | LANGUAGES, f"no checker for code in {language or 'no language'!r}"


def test_every_block_has_a_checker() -> None:
    for block in all_blocks():
        try:
            check_language(block.language)
        except AssertionError as error:
            raise AssertionError(f"{block}: {error}") from error


@pytest.mark.parametrize("page", sorted({block.page for block in all_blocks("python")}))
def test_python_runs(page: str, small: Path) -> None:
    """All blocks of a page, in their order, as one program in a temporary folder."""
    namespace: dict[str, object] = {"__name__": "page"}
    for block in all_blocks("python"):
        if block.page == page:  # empty lines before it, so that a traceback names the page's line
            exec(compile("\n" * block.line + block.text, ROOT / page, "exec"), namespace)


@pytest.mark.parametrize("line", LINES, ids=[f"{block}: {line}" for line, block in LINES.items()])
def test_command_lines_are_understood(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        check_command_line(line)
    except NotUnderstood as error:
        raise AssertionError(f"{LINES[line]}: {error}\n{capsys.readouterr().err}") from error


@pytest.mark.slow
@pytest.mark.parametrize("line", RUN)
def test_cheap_commands_run(line: str) -> None:
    """Those that need nothing but the repository, and write nothing."""
    assert line in LINES
    words = shlex.split(line)[1:]
    done = subprocess.run([sys.executable, "-m", "sb3_crc", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and done.stdout.strip(), done.stderr


@pytest.mark.parametrize("block", all_blocks("yaml"), ids=str)
def test_yaml_is_understood(block: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "examples" / "extending")
    importlib.import_module("own_environment")  # registers what a page trains in
    check_yaml(block.text, tmp_path)  # type: ignore[attr-defined]


# -- The checkers themselves -------------------------------------------------------------------------------------------


def test_pages_are_found() -> None:
    assert len(PAGES) > 15 and len(LINES) > 40
    blocks = blocks_of("a\n\n- list\n\n  ```python\n  1\n  ```\n\n    indented\n\n```\nnone\n```\n", "page.md")
    assert [(block.line, block.language, block.text) for block in blocks] == [
        (5, "python", "1\n"),
        (11, "", "none\n"),
    ]


@pytest.mark.parametrize("language", ["bash", "text", "", "{code-block} python", "pycon"])
def test_an_unknown_language_fails(language: str) -> None:
    with pytest.raises(AssertionError, match="no checker"):
        check_language(language)


@pytest.mark.parametrize(
    "line",
    [
        "make trian",
        "make train ARGS='--sede 1'",
        "make bench ARGS=updates",
        "sb3-crc compare --task cartpole-swingup --sedes 3",
        "sb3-crc compare --task cartpole-swingup --presets crc,radd",
        "sb3-crc compare --task cartpole-swingpu",
        "sb3-crc compare --task cartpole-swingup --seeds three",
        "sb3-crc tabel 100k runs",
        "sb3-crc sweep zoo_configs/sweeps/ablation_9.yml",
        "sb3-crc --no-such-option",
        "python -m sb3_crc docter",
        "python -m sb3_crc.zoo enjoy --algo crcc --env dmc_pixels/cartpole-swingup-v0",
        "python -m sb3_crc.zoo enjoyy --algo crc",
        "python -m sb3_crc.zoo plot_train -a crc -e cartpole-swingup-v0 --logs logs",
        "python train.py --algo crc --env dmc_pixels/cartpole-swingup-v0 --eval-freqq 10",
        "python train.py --algo crc --env dmc_pixels/cartpole-swingpu-v0",
        "python train.py --algo crc --env dmc_pixels/cartpole-swingup-v0 --conf-file zoo_configs/lap.yml",
        "python train.py --algo crc --env dmc_pixels/cartpole-swingup-v0 -params batch_sizes:3",
        "python train.py --algo sac --env dmc_pixels/cartpole-swingup-v0 -params encoder_tau:0.1",
        "python -m benchmarks gpus",
        "python examples/extending/own_objective.py --agentsteps 3",
        "python somewhere.py",
        "pip install -e '.[zoos]'",
        "pip install --constrain2 x",
        "cargo build",
        "sb3-crc doctor && rm -r logs",
        "sb3-crc doctor --json | js .works",
        "sb3-crc doctor --jsn | jq .works",
        "sb3-crc doctor |",
    ],
)
def test_a_mistake_in_a_command_line_fails(line: str) -> None:
    with pytest.raises(NotUnderstood):
        check_command_line(line)


@pytest.mark.parametrize(
    "text",
    [
        "tasks: [cartpole-swingup]\nseeds: 3\nenv_steps: 100000\nvariants: {crc: {batchsize: 3}}",
        "tasks: [cartpole-swingup]\nseeds: 3\nvariants: {crc: {}}",
        "tasks: [cartpole-swingup]\nseeds: 3\nenv_steps: 100000\nvariants: {mine: {preset: rad, objectives: {a.Loss: 1}}}",
        "dmc_pixels/cartpole-swingup-v0: {n_timesteps: 100, policy: CnnPolicy, batchsize: 3}",
        "dmc_pixels/cartpole-swingpu-v0: {}",
        "batch_sizes: 3",
        "objectives: {contrastiv: 1.0}",
        "augmentation: random_shfit",
        "callback: [sb3_crc.callbacks.NoCallback]",
        "callback: [{sb3_crc.callbacks.NStepScheduleCallback: {n_step: {0.0: 3}}}]",
        "just text",
    ],
)
def test_a_mistake_in_yaml_fails(text: str, tmp_path: Path) -> None:
    with pytest.raises(Exception):  # noqa: B017  # of whoever reads it
        check_yaml(text, tmp_path)
