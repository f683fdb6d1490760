"""Find an OpenGL back end that really draws without a display, and say how to mend a machine that has none.

MuJoCo draws through EGL (GPU or Mesa, no display needed), OSMesa (software) or GLFW (needs a display). Importing a back end
proves nothing, so :func:`select_backend` draws one frame in a subprocess: a broken driver may crash or hang its process. This
file is also that subprocess's script; run as one it loads MuJoCo, and it imports nothing heavy otherwise.
"""

from __future__ import annotations

import contextlib
import faulthandler
import importlib
import json
import logging
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

logger = logging.getLogger(__name__)

#: Environment variable: seconds in which the first frame must be there
FIRST_FRAME = "SB3_CRC_FIRST_FRAME"
#: What faulthandler writes when it ends the process
NO_FRAME = "Timeout ("
PROBE_TIMEOUT = 30.0  # seconds: software drivers compile shaders at the first frame, broken ones hang
DEBIAN_PACKAGES = {
    "egl": ("libegl1", "libopengl0", "libgl1-mesa-dri"),  # PyOpenGL loads libOpenGL beside libEGL
    "osmesa": ("libosmesa6",),
}
DISABLED = ("off", "disable", "disabled", "false", "0")  # MUJOCO_GL values with which dm_control draws nothing
NEEDS_DISPLAY = ("glfw", "on", "enable", "enabled", "true", "1")  # MUJOCO_GL values that mean GLFW to dm_control

_PROBE_SCENE = """
<mujoco>
  <worldbody><light pos="0 0 3"/><geom type="sphere" size=".5" rgba="1 .5 0 1"/></worldbody>
</mujoco>
"""


class RenderingUnavailable(RuntimeError):
    """No OpenGL back end draws on this machine; the message holds the line that mends it."""


@dataclass(frozen=True)
class Probe:
    """What drawing one frame with a back end gave.

    :param backend: value of MUJOCO_GL that was tried
    :param renderer: OpenGL's renderer string, for instance "llvmpipe (LLVM 15.0.6, 256 bits)"; empty if nothing was drawn
    :param ms_per_frame: time of one 64 x 64 picture of a sphere in milliseconds
    :param error: why nothing was drawn; empty on success
    """

    backend: str
    renderer: str = ""
    ms_per_frame: float = 0.0
    error: str = ""

    @property
    def draws(self) -> bool:
        """Whether a frame came back that is not black."""
        return not self.error


def candidates() -> tuple[str, ...]:
    """Back ends worth trying on this machine, best first."""
    if platform.system() == "Darwin":
        return ("glfw",)  # MuJoCo itself also has "cgl", but dm_control 1.0.50 refuses to be imported with it
    if platform.system() == "Linux":
        has_display = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
        return ("egl", "osmesa", "glfw") if has_display else ("egl", "osmesa")
    return ("glfw",)


def probe(backend: str, timeout: float = PROBE_TIMEOUT) -> Probe:
    """Draw one frame with a back end in a subprocess.

    :param backend: "egl", "osmesa" or "glfw"
    :param timeout: seconds after which the back end counts as hanging
    :return: the outcome; never raises for a back end that does not work
    """
    environment = {**os.environ, "MUJOCO_GL": backend}
    try:
        outcome = subprocess.run(
            [sys.executable, str(Path(__file__).resolve())],
            env=environment,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return Probe(backend, error=f"no frame within {timeout:g} s")
    if outcome.returncode == 0:
        with contextlib.suppress(json.JSONDecodeError, IndexError):
            return Probe(backend, **json.loads(outcome.stdout.splitlines()[-1]))
    lines = outcome.stderr.strip().splitlines() or [f"exit status {outcome.returncode}"]
    return Probe(backend, error=lines[-1].strip())


def select_backend() -> str:
    """Choose the OpenGL back end before dm_control is imported, and set MUJOCO_GL to it.

    A back end that dm_control has already loaded stays; else MUJOCO_GL if it is set; else the first candidate that draws. The
    choice is written to ``os.environ``, so child processes inherit it and one process tree probes once.

    :return: the back end's name
    :raises RenderingUnavailable: if none draws, or MUJOCO_GL forbids drawing or asks for a display that is not there
    """
    asked = os.environ.get("MUJOCO_GL", "").lower().strip()
    if asked in DISABLED:
        raise RenderingUnavailable(f"Rendering is switched off by MUJOCO_GL={asked}: unset it, or set it to egl or osmesa.")
    if asked in NEEDS_DISPLAY and "glfw" not in candidates():
        raise RenderingUnavailable(f"MUJOCO_GL={asked} needs a display: unset it, or set it to egl or osmesa.")
    loaded = sys.modules.get("dm_control._render")
    bound = getattr(loaded, "BACKEND", None)
    if bound and bound not in DISABLED and (bound != "glfw" or "glfw" in candidates()):
        return str(bound)
    backend = asked or _first_that_draws().backend
    os.environ["MUJOCO_GL"] = backend
    if loaded is not None:
        # Imported first and without MUJOCO_GL, dm_control binds GLFW, which aborts the process where there is no display.
        importlib.reload(loaded)
    return backend


@contextlib.contextmanager
def first_frame_watched() -> Iterator[None]:
    """
    Within it the process ends with :data:`NO_FRAME` in its error output if the frame takes longer than as many seconds as
    SB3_CRC_FIRST_FRAME says, however the driver hangs; without that variable nothing happens.
    """
    seconds = os.environ.get(FIRST_FRAME)
    if not seconds:
        yield
        return
    faulthandler.dump_traceback_later(float(seconds), exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


@contextlib.contextmanager
def loss_of_context_named() -> Iterator[None]:
    """:raises RenderingUnavailable: in place of an error of OpenGL's, whose own text is a number at best"""
    try:
        yield
    except Exception as error:
        if type(error).__module__.partition(".")[0] not in {"OpenGL", "mujoco"}:
            raise
        what = f"{type(error).__name__} {getattr(error, 'err', '')}".strip()  # its str() may fail in turn
        raise RenderingUnavailable(
            f"OpenGL draws no more ({what}, MUJOCO_GL={os.environ.get('MUJOCO_GL')}): its context is lost, as when a driver "
            "is reset. A new process can draw again; a training goes on there from its last checkpoint"
        ) from error


def prove_backend() -> Probe:
    """Choose as :func:`select_backend` does and draw one frame with the choice, even if MUJOCO_GL was set by hand.

    :return: the back end with its renderer string and speed
    :raises RenderingUnavailable: if it does not draw, with what mends it
    """
    backend = select_backend()
    outcome = probe(backend)
    if not outcome.draws:
        raise RenderingUnavailable(
            f"MUJOCO_GL={backend} does not draw ({outcome.error}).\n"
            f"Unset MUJOCO_GL to try other back ends, or mend this one:\n{mending_line()}"
        )
    return outcome


def _first_that_draws() -> Probe:
    failed: list[Probe] = []
    for backend in candidates():
        outcome = probe(backend)
        if outcome.draws:
            logger.info("OpenGL back end %s draws with %s", backend, outcome.renderer)
            return outcome
        failed.append(outcome)
    tried = "\n".join(f"  {outcome.backend}: {outcome.error}" for outcome in failed)
    raise RenderingUnavailable(f"No OpenGL back end draws on this machine:\n{tried}\nWhat mends it:\n{mending_line()}")


def mending_line() -> str:
    """The command that installs what is missing; on systems other than Debian and Ubuntu, what is needed in words."""
    packages = _packages()
    if not packages:
        return f"unset MUJOCO_GL, which asks for {os.environ['MUJOCO_GL']!r}"
    if shutil.which("apt-get"):
        sudo = "" if _is_root() else "sudo "
        return f"{sudo}apt-get update && {sudo}apt-get install -y {' '.join(packages)}"
    if platform.system() == "Linux":
        return "install EGL and Mesa's software driver (Fedora: dnf install mesa-libEGL mesa-dri-drivers)"
    if platform.system() == "Darwin":
        return "log in at the screen: macOS draws through GLFW, which needs one"
    return "use Linux, or WSL2 on Windows"


def _packages() -> tuple[str, ...]:
    """Debian packages of the back end that is asked for; empty if MUJOCO_GL asks for one that needs more than a library."""
    return DEBIAN_PACKAGES.get(os.environ.get("MUJOCO_GL", "").lower().strip() or "egl", ())


def install_system_library() -> None:
    """Install Mesa's EGL library with apt, where nobody will mind: as root in a container, or with AUTO_APT=1 or CI=1.

    With MUJOCO_GL=osmesa it installs OSMesa instead.

    :raises RenderingUnavailable: if it may not, with the line to run by hand; or if the installation failed
    """
    if not shutil.which("apt-get") or not _packages() or not may_install():
        raise RenderingUnavailable(f"No OpenGL back end draws on this machine. What mends it:\n{mending_line()}")
    sudo = [] if _is_root() else ["sudo", "-n"]
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for arguments in (["update"], ["install", "-y", "--no-install-recommends", *_packages()]):
        command = [*sudo, "apt-get", *arguments]
        try:
            subprocess.run(command, check=True, env=environment, stdout=sys.stderr)
        except (subprocess.CalledProcessError, OSError) as error:
            raise RenderingUnavailable(f"`{' '.join(command)}` failed ({error}). Run by hand:\n{mending_line()}") from error


def may_install() -> bool:
    """Whether a system package may be installed without asking: AUTO_APT=1, CI=1, or root in a container."""
    if any(os.environ.get(name, "").lower() in ("1", "true") for name in ("AUTO_APT", "CI")):
        return True
    return _is_root() and _in_container()


def _is_root() -> bool:
    return hasattr(os, "geteuid") and os.geteuid() == 0


def _in_container() -> bool:
    if Path("/.dockerenv").exists() or Path("/run/.containerenv").exists() or "container" in os.environ:
        return True
    with contextlib.suppress(OSError):
        control_groups = Path("/proc/1/cgroup").read_text(encoding="utf-8")
        return any(word in control_groups for word in ("docker", "kubepods", "containerd", "lxc", "libpod"))
    return False


def _draw_probe_scene() -> dict[str, Any]:
    """Draw a sphere twice with the back end of MUJOCO_GL; the second frame is timed."""
    import mujoco
    import numpy as np

    context = mujoco.GLContext(64, 64)
    context.make_current()
    model = mujoco.MjModel.from_xml_string(_PROBE_SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    scene = mujoco.MjvScene(model, maxgeom=10)
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    mujoco.mjv_updateScene(
        model, data, mujoco.MjvOption(), mujoco.MjvPerturb(), camera, mujoco.mjtCatBit.mjCAT_ALL.value, scene
    )
    renderer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, renderer)
    viewport = mujoco.MjrRect(0, 0, 64, 64)
    picture = np.zeros((64, 64, 3), np.uint8)
    seconds = 0.0
    for _ in range(2):
        start = time.perf_counter()
        mujoco.mjr_render(viewport, scene, renderer)
        mujoco.mjr_readPixels(picture, None, viewport, renderer)
        seconds = time.perf_counter() - start
    if not picture.any():
        raise RenderingUnavailable("the frame is black")
    return {"renderer": _renderer_string(), "ms_per_frame": 1000 * seconds}


def _renderer_string() -> str:
    from OpenGL.GL import GL_RENDERER, glGetString

    name = glGetString(GL_RENDERER)
    return name.decode() if isinstance(name, bytes) else str(name)


if __name__ == "__main__":
    sys.stdout.write(json.dumps(_draw_probe_scene()) + "\n")
    sys.stdout.flush()
    # Some drivers crash while they unload; the frame has been drawn by then.
    os._exit(0)
