"""The choice of an OpenGL back end, and what a machine without one is told."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from sb3_crc.envs import rendering
from sb3_crc.envs.rendering import Probe, RenderingUnavailable


@pytest.fixture(autouse=True)
def fresh_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a process on Linux without display, MUJOCO_GL or dm_control."""
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY", "AUTO_APT", "CI", "container"):
        monkeypatch.setenv(name, "")  # so that what the test sets is undone too
        monkeypatch.delenv(name)
    monkeypatch.delitem(sys.modules, "dm_control._render", raising=False)
    monkeypatch.setattr(rendering.platform, "system", lambda: "Linux")


def only_draws(monkeypatch: pytest.MonkeyPatch, *working: str) -> list[str]:
    """Replace the probe by one that knows the outcome; return the list of what was tried."""
    tried: list[str] = []

    def probe(backend: str) -> Probe:
        tried.append(backend)
        return Probe(backend, "Mesa", 1.0) if backend in working else Probe(backend, error=f"no {backend} library")

    monkeypatch.setattr(rendering, "probe", probe)
    return tried


def test_the_first_that_draws_is_chosen_once(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = only_draws(monkeypatch, "osmesa", "glfw")
    assert rendering.select_backend() == "osmesa"
    assert os.environ["MUJOCO_GL"] == "osmesa"  # child processes inherit it
    assert rendering.select_backend() == "osmesa"
    assert tried == ["egl", "osmesa"]


def test_mujoco_gl_is_respected_without_a_probe(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = only_draws(monkeypatch)
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert rendering.select_backend() == "osmesa"
    assert tried == []


def test_a_back_end_already_loaded_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    class Loaded:
        BACKEND = "osmesa"

    monkeypatch.setitem(sys.modules, "dm_control._render", Loaded)  # type: ignore[arg-type]
    assert rendering.select_backend() == "osmesa"
    assert "MUJOCO_GL" not in os.environ


@pytest.mark.parametrize(
    ("system", "display", "expected"),
    [
        ("Linux", "", ("egl", "osmesa")),
        ("Linux", ":0", ("egl", "osmesa", "glfw")),
        ("Darwin", "", ("glfw",)),
    ],
)
def test_candidates(monkeypatch: pytest.MonkeyPatch, system: str, display: str, expected: tuple[str, ...]) -> None:
    monkeypatch.setattr(rendering.platform, "system", lambda: system)
    monkeypatch.setenv("DISPLAY", display)
    assert rendering.candidates() == expected


@pytest.mark.parametrize(("value", "reason"), [("disabled", "switched off"), ("glfw", "needs a display")])
def test_a_setting_that_cannot_draw_is_refused(monkeypatch: pytest.MonkeyPatch, value: str, reason: str) -> None:
    monkeypatch.setenv("MUJOCO_GL", value)
    with pytest.raises(RenderingUnavailable, match=f"{reason}.*egl or osmesa|{value} {reason}"):
        rendering.select_backend()


@pytest.mark.parametrize(("root", "sudo"), [(True, ""), (False, "sudo ")])
def test_the_message_holds_the_line_that_mends_it(monkeypatch: pytest.MonkeyPatch, root: bool, sudo: str) -> None:
    only_draws(monkeypatch)
    monkeypatch.setattr(rendering.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(rendering, "_is_root", lambda: root)
    line = f"{sudo}apt-get update && {sudo}apt-get install -y libegl1 libopengl0 libgl1-mesa-dri"
    with pytest.raises(RenderingUnavailable) as error:
        rendering.select_backend()
    assert str(error.value).splitlines()[-1] == line
    assert "egl: no egl library" in str(error.value)
    assert "MUJOCO_GL" not in os.environ


def test_a_frame_is_really_drawn() -> None:
    outcome = rendering.prove_backend()  # raises where none draws, and then nothing else here can work either
    assert outcome.renderer and 0 < outcome.ms_per_frame < 5000


def test_a_broken_back_end_is_an_outcome_not_an_exception() -> None:
    outcome = rendering.probe("no-such-back-end")
    assert not outcome.draws
    assert "no-such-back-end" in outcome.error


def test_a_hanging_back_end_is_given_up() -> None:
    outcome = rendering.probe("egl", timeout=0.01)
    assert outcome.error == "no frame within 0.01 s"


def test_importing_dm_control_first_does_no_harm() -> None:
    """Without MUJOCO_GL dm_control binds GLFW, which would abort the process at the first picture."""
    program = (
        "from dm_control import suite; from sb3_crc.envs.dmc import make_dmc;"
        "print(make_dmc('cartpole-swingup', image_size=36).reset(seed=0)[0].any())"
    )
    outcome = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert outcome.returncode == 0, outcome.stderr
    assert outcome.stdout.strip() == "True"


def test_state_needs_no_back_end() -> None:
    program = (
        "from sb3_crc import make_dmc; env = make_dmc('walker-walk', observation='state');"
        "env.reset(seed=0); print(env.step(env.action_space.sample())[0].shape)"
    )
    outcome = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, env={"MUJOCO_GL": "disabled"}
    )
    assert "(24,)" in outcome.stdout, outcome.stderr


# --- installing ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Record what would be run, and run nothing."""
    recorded: list[list[str]] = []

    def run(command: list[str], **_: Any) -> None:
        recorded.append(command)

    monkeypatch.setattr(rendering.subprocess, "run", run)
    monkeypatch.setattr(rendering.shutil, "which", lambda name: f"/usr/bin/{name}")
    return recorded


@pytest.mark.parametrize(
    ("root", "container", "variable", "allowed"),
    [
        (True, True, None, True),
        (True, False, None, False),
        (False, True, None, False),
        (False, False, "CI", True),
        (False, False, "AUTO_APT", True),
    ],
)
def test_who_may_install(
    monkeypatch: pytest.MonkeyPatch,
    commands: list[list[str]],
    root: bool,
    container: bool,
    variable: str | None,
    allowed: bool,
) -> None:
    monkeypatch.setattr(rendering, "_is_root", lambda: root)
    monkeypatch.setattr(rendering, "_in_container", lambda: container)
    if variable is not None:
        monkeypatch.setenv(variable, "1")
    if not allowed:
        with pytest.raises(RenderingUnavailable, match="apt-get install -y libegl1"):
            rendering.install_system_library()
        assert commands == []
        return
    rendering.install_system_library()
    sudo = [] if root else ["sudo", "-n"]
    assert commands[0] == [*sudo, "apt-get", "update"]
    assert commands[1][: len(sudo) + 2] == [*sudo, "apt-get", "install"]
    assert commands[1][-3:] == ["libegl1", "libopengl0", "libgl1-mesa-dri"]


def test_osmesa_is_installed_for_those_who_ask_for_it(monkeypatch: pytest.MonkeyPatch, commands: list[list[str]]) -> None:
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setenv("CI", "true")
    rendering.install_system_library()
    assert commands[1][-1] == "libosmesa6"


def test_nothing_is_installed_where_no_library_is_missing(monkeypatch: pytest.MonkeyPatch, commands: list[list[str]]) -> None:
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    monkeypatch.setenv("CI", "1")
    with pytest.raises(RenderingUnavailable, match="unset MUJOCO_GL"):
        rendering.install_system_library()
    assert commands == []


def test_a_failed_installation_names_the_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(command: list[str], **_: Any) -> None:
        raise subprocess.CalledProcessError(100, command)

    monkeypatch.setenv("CI", "1")
    monkeypatch.setattr(rendering.subprocess, "run", fail)
    monkeypatch.setattr(rendering.shutil, "which", lambda name: f"/usr/bin/{name}")
    with pytest.raises(RenderingUnavailable, match=r"apt-get update` failed.*\n.*apt-get install"):
        rendering.install_system_library()


def test_a_container_is_recognised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "exists", lambda self: False)
    monkeypatch.setattr(Path, "read_text", lambda self, **_: "0::/kubepods/pod1\n")
    assert rendering._in_container()
    monkeypatch.setattr(Path, "read_text", lambda self, **_: "0::/init.scope\n")
    assert not rendering._in_container()
