"""examples/getting_started.ipynb: it runs with a tiny budget and shows what it says; its outputs come from a real run."""

import base64
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import matplotlib.image
import nbformat
import pytest
from nbclient import NotebookClient

from tests.examples.conftest import EXAMPLES

NOTEBOOK = EXAMPLES / "getting_started.ipynb"
BUDGET = 500


def printed(notebook: Any) -> str:
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert not [output for output in outputs if output.output_type == "error"]
    return "".join(output.text for output in outputs if output.output_type == "stream" and output.name == "stdout")


def pictures(notebook: Any) -> list[bytes]:
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", []) if "data" in output]
    return [base64.b64decode(output.data["image/png"]) for output in outputs if "image/png" in output.data]


def assert_shown(notebook: Any, budget: int, folder: Path) -> None:
    """What a reader should see, whatever the budget."""
    text = printed(notebook)
    assert "uint8 (9, 48, 48)" in text
    updates = budget - min(200, budget // 2)
    assert f"{budget} decisions, {8 * budget} environment steps, {updates} updates" in text
    accuracy, chance = map(float, re.search(r"contrastive accuracy (\S+), chance (\S+)", text).groups())  # type: ignore[union-attr]
    loss, variance = map(float, re.search(r"reconstruction (\S+), variance of the pixels (\S+)", text).groups())  # type: ignore[union-attr]
    assert accuracy > 2 * chance and loss < 0.8 * variance  # something was learned
    assert text.count("the same action: True") == 2  # after loading and after exporting
    assert "stopped by SIGINT" in text and "as if nothing had happened: True" in text
    for line in (r"return \d+ of 1000", r"return over 3 fresh episodes: \d+ \+/- \d+"):
        (value,) = re.findall(line, text)
        assert 0 < int(re.findall(r"\d+(?= of| \+)", value)[0]) <= 1000
    shown = pictures(notebook)
    assert len(shown) == 5  # the environment, the log, reconstructions, the comparison, moments of an episode
    for index, content in enumerate(shown):
        path = folder / f"{index}.png"
        path.write_bytes(content)
        assert matplotlib.image.imread(path)[..., :3].std() > 0.03, f"picture {index} is blank"


def test_what_is_committed_is_a_real_run_and_small(tmp_path: Path) -> None:
    notebook = nbformat.read(NOTEBOOK, 4)
    nbformat.validate(notebook)
    counts = [cell.execution_count for cell in notebook.cells if cell.cell_type == "code"]
    assert counts == list(range(1, len(counts) + 1))  # from top to bottom, once
    assert sum(map(len, pictures(notebook))) < 200_000
    assert NOTEBOOK.stat().st_size < 350_000
    assert_shown(notebook, 1_000, tmp_path)


@pytest.mark.slow
def test_it_runs_from_top_to_bottom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NOTEBOOK_BUDGET", str(BUDGET))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    notebook = nbformat.read(NOTEBOOK, 4)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = []
    run = tmp_path / "run"
    run.mkdir()
    NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(run)}}).execute()
    assert_shown(notebook, BUDGET, tmp_path)
    assert (run / "episode.mp4").stat().st_size > 5_000
    written = {path.name for path in run.iterdir()}
    assert {"crc.zip", "policy.sb3crc", "runs", "checkpoints"} <= written


# -- The cell for Colab ------------------------------------------------------------------------------------------------


def first_cell() -> str:
    notebook = json.loads(NOTEBOOK.read_text())
    return next("".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code")


@pytest.mark.parametrize("gpu", [True, False])
def test_on_colab_the_package_is_installed_and_egl_finds_its_driver(
    gpu: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands: list[list[str]] = []
    monkeypatch.setattr(subprocess, "run", lambda command, check: commands.append(command))
    monkeypatch.setattr("shutil.which", lambda name: "/usr/bin/nvidia-smi" if gpu and name == "nvidia-smi" else None)
    monkeypatch.setitem(sys.modules, "google.colab", ModuleType("google.colab"))
    for name in ("MUJOCO_GL", "AUTO_APT"):
        monkeypatch.setenv(name, "")
    source = first_cell()
    assert source.count("/usr/share/glvnd") == 1
    exec(source.replace("/usr/share/glvnd", str(tmp_path / "glvnd")), {})
    install, rendering = commands
    assert install[1:4] == ["-m", "pip", "install"] and install[-1].startswith("sb3-crc[zoo,video,analysis] @ ")
    assert rendering[1:] == ["-m", "sb3_crc", "rendering", "--install"]
    assert (os.environ["MUJOCO_GL"], os.environ["AUTO_APT"]) == ("egl", "1")
    icd = tmp_path / "glvnd" / "egl_vendor.d" / "10_nvidia.json"
    assert icd.exists() == gpu
    if gpu:
        assert json.loads(icd.read_text())["ICD"] == {"library_path": "libEGL_nvidia.so.0"}


def test_elsewhere_that_cell_does_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: Any, **kwargs: Any) -> None:
        raise AssertionError("a command was run")

    monkeypatch.setattr(subprocess, "run", refuse)
    before = dict(os.environ)
    exec(first_cell(), {})
    assert dict(os.environ) == before
