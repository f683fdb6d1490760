"""The doctor's findings, and the exit codes of the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box
from typer.testing import CliRunner

from sb3_crc import doctor
from sb3_crc.buffers import FrameReplayBuffer
from sb3_crc.cli import app
from sb3_crc.doctor import FULL_BUFFER, examine, examine_memory
from sb3_crc.envs import rendering
from sb3_crc.envs.rendering import RenderingUnavailable
from sb3_crc.memory import available_memory


def test_every_topic_is_looked_at() -> None:
    findings = list(examine())
    assert {finding.topic for finding in findings} == {"versions", "rendering", "compute", "memory"}
    broken = [finding for finding in findings if finding.verdict == "broken"]
    assert broken == []
    by_name = {finding.name: finding.value for finding in findings}
    assert by_name["mujoco"].startswith("3.")
    for name in ("benchmark, 100 px", "fast, 64 px"):
        assert 0 < float(by_name[name].split(" ms")[0]) < 1000


def test_buffer_figures_are_what_full_buffers_take() -> None:
    findings = {finding.name: finding.value for finding in examine_memory()}
    assert findings["paper's buffer"].startswith("3.0 GB for 100,000 transitions of 9 x 100 x 100 bytes")
    transitions, shape = FULL_BUFFER
    buffer = FrameReplayBuffer(transitions // 1000, Box(0, 255, shape, np.uint8), Box(-1, 1, (1,)), frame_channels=3)
    memory = buffer.store.allocate()
    assert memory.numel() * memory.element_size() == buffer.full_bytes


def test_a_buffer_that_does_not_fit_is_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "available_memory", lambda: 2_000_000_000)
    findings = {finding.name: finding for finding in examine_memory()}
    assert findings["paper's buffer"].verdict == "note" and "does not fit" in findings["paper's buffer"].value
    assert findings["laptop buffer"].verdict == "ok"


def test_what_is_timed_is_the_picture_of_an_observation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which draws with one camera, where dm_control's own ``render`` builds and frees one each time."""
    from dm_control.mujoco.engine import Camera

    built: list[Any] = []
    build = Camera.__init__
    monkeypatch.setattr(Camera, "__init__", lambda self, *args, **kwargs: built.append(self) or build(self, *args, **kwargs))
    assert doctor.milliseconds_per_frame("fast", 36, frames=5) > 0
    assert len(built) == 1


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="ascii")


def test_a_containers_limit_counts(tmp_path: Path) -> None:
    unlimited = available_memory(tmp_path / "none")
    assert unlimited > 0
    write(tmp_path / "v2/memory.max", "50000000\n")
    write(tmp_path / "v2/memory.current", "30000000\n")
    write(tmp_path / "v2/memory.stat", "anon 1\ninactive_file 4000000\n")
    assert available_memory(tmp_path / "v2") == 24_000_000
    write(tmp_path / "v1/memory/memory.limit_in_bytes", "50000000\n")
    write(tmp_path / "v1/memory/memory.usage_in_bytes", "30000000\n")
    assert available_memory(tmp_path / "v1") == 20_000_000
    write(tmp_path / "v2/memory.max", "max\n")
    assert available_memory(tmp_path / "v2") > 50_000_000


def test_a_missing_package_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "REQUIRED_PACKAGES", ("no-such-package",))
    monkeypatch.setattr(doctor, "OPTIONAL_PACKAGES", ("no-such-extra",))
    verdicts = {finding.name: finding.verdict for finding in doctor.examine_versions()}
    assert (verdicts["no-such-package"], verdicts["no-such-extra"]) == ("broken", "note")


def test_doctor_command_fails_without_a_back_end(monkeypatch: pytest.MonkeyPatch) -> None:
    def unavailable() -> None:
        raise RenderingUnavailable("nothing draws: apt-get [x]")

    monkeypatch.setattr(doctor, "prove_backend", unavailable)
    outcome = CliRunner().invoke(app, ["doctor"])
    assert outcome.exit_code == 1
    assert "nothing draws" in outcome.output and "broken" in outcome.output and "available" in outcome.output


def test_rendering_command_prints_the_choice() -> None:
    outcome = CliRunner().invoke(app, ["rendering"])
    assert outcome.exit_code == 0
    assert "pictures are drawn by" in outcome.output


def test_rendering_command_stops_with_the_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def unavailable() -> None:
        raise RenderingUnavailable("nothing draws")

    monkeypatch.setattr(rendering, "prove_backend", unavailable)
    monkeypatch.setattr(rendering, "may_install", lambda: False)
    monkeypatch.setattr(rendering.shutil, "which", lambda name: f"/usr/bin/{name}")
    assert CliRunner().invoke(app, ["rendering"]).exit_code == 1
    outcome = CliRunner().invoke(app, ["rendering", "--install"])
    assert outcome.exit_code == 1
    line = outcome.output.strip().splitlines()[-1]
    assert line.endswith("apt-get install -y libegl1 libopengl0 libgl1-mesa-dri")  # whole, however long


def test_rendering_command_installs_and_tries_again(monkeypatch: pytest.MonkeyPatch) -> None:
    installed: list[bool] = []

    def prove() -> rendering.Probe:
        if not installed:
            raise RenderingUnavailable("nothing draws")
        return rendering.Probe("egl", "Mesa", 1.0)

    monkeypatch.setattr(rendering, "prove_backend", prove)
    monkeypatch.setattr(rendering, "install_system_library", lambda: installed.append(True))
    outcome = CliRunner().invoke(app, ["rendering", "--install"])
    assert outcome.exit_code == 0 and "egl: Mesa" in outcome.output
