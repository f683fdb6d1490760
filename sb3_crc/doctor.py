"""What works on this machine: versions, rendering, compute, and the memory that replay buffers need."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Literal

import numpy as np
import torch as th
from gymnasium.spaces import Box

from sb3_crc.buffers import FrameReplayBuffer
from sb3_crc.envs.dmc import make_dmc
from sb3_crc.envs.rendering import RenderingUnavailable, prove_backend
from sb3_crc.memory import GIGABYTE, available_memory

Verdict = Literal["ok", "note", "broken"]

REQUIRED_PACKAGES = ("torch", "stable-baselines3", "gymnasium", "dm-control", "mujoco", "shimmy")
OPTIONAL_PACKAGES = ("rl_zoo3",)
SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swrast", "lavapipe")

FULL_BUFFER = (100_000, (9, 100, 100))
"""The paper's buffer: transitions, and the bytes of one observation."""
LAPTOP_BUFFER = (15_000, (9, 64, 64))
"""The buffer of zoo_configs/laptop.yml."""


@dataclass(frozen=True)
class Finding:
    """One line of the doctor's table.

    :param topic: "versions", "rendering", "compute" or "memory"
    :param name: what was looked at
    :param value: what was found, with its unit
    :param verdict: "broken" if the package cannot work without it, "note" if the user should know
    """

    topic: str
    name: str
    value: str
    verdict: Verdict = "ok"


def examine() -> Iterator[Finding]:
    """Look at the machine topic by topic; what does not work becomes a finding, not an exception."""
    yield from examine_versions()
    yield from examine_rendering()
    yield from examine_compute()
    yield from examine_memory()


def examine_versions() -> Iterator[Finding]:
    """Versions of Python and of the libraries underneath."""
    yield Finding("versions", "python", f"{platform.python_version()} on {platform.system()} {platform.machine()}")
    for package in (*REQUIRED_PACKAGES, *OPTIONAL_PACKAGES):
        try:
            yield Finding("versions", package, version(package))
        except PackageNotFoundError:
            required = package in REQUIRED_PACKAGES
            yield Finding("versions", package, "not installed", "broken" if required else "note")


def examine_rendering() -> Iterator[Finding]:
    """The OpenGL back end and the time of one picture of cartpole, in the two qualities."""
    try:
        proof = prove_backend()
    except RenderingUnavailable as error:
        yield Finding("rendering", "back end", str(error), "broken")
        return
    yield Finding("rendering", "back end", f"MUJOCO_GL={proof.backend}")
    if any(name in proof.renderer.lower() for name in SOFTWARE_RENDERERS):
        yield Finding("rendering", "renderer", f"{proof.renderer}: software, no GPU", "note")
    else:
        yield Finding("rendering", "renderer", proof.renderer)
    for quality, image_size in (("benchmark", 100), ("fast", 64)):
        milliseconds = milliseconds_per_frame(quality, image_size)
        yield Finding("rendering", f"{quality}, {image_size} px", f"{milliseconds:.1f} ms per frame of cartpole")


def milliseconds_per_frame(render_quality: str, image_size: int, frames: int = 20) -> float:
    """Time the picture of one observation of cartpole-swingup.

    :param render_quality: "benchmark" or "fast"
    :param image_size: side in pixels
    :param frames: how many pictures to average over; one more comes first, in which drivers compile their shaders
    :return: milliseconds
    """
    env = make_dmc("cartpole-swingup", seed=0, image_size=image_size, render_quality=render_quality)
    env.reset()  # draws one
    draw = env.get_wrapper_attr("take_picture")
    start = time.perf_counter()
    for _ in range(frames):
        draw()
    seconds = time.perf_counter() - start
    env.close()
    return 1000 * seconds / frames


def examine_compute() -> Iterator[Finding]:
    """CUDA, processors and threads."""
    if th.cuda.is_available():
        memory = th.cuda.get_device_properties(0).total_memory / GIGABYTE
        yield Finding("compute", "CUDA", f"{th.cuda.get_device_name(0)}, {memory:.0f} GB, CUDA {th.version.cuda}")
    else:
        yield Finding("compute", "CUDA", "none: training runs on the processor", "note")
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    yield Finding("compute", "processors", f"{usable} usable of {os.cpu_count()}")
    limit = os.environ.get("OMP_NUM_THREADS")
    yield Finding("compute", "torch threads", f"{th.get_num_threads()}" + (f" (OMP_NUM_THREADS={limit})" if limit else ""))


def examine_memory() -> Iterator[Finding]:
    """Memory that is free for this process, against full replay buffers."""
    available = available_memory()
    yield Finding("memory", "available", f"{available / GIGABYTE:.1f} GB")
    for name, (transitions, shape) in (("paper's buffer", FULL_BUFFER), ("laptop buffer", LAPTOP_BUFFER)):
        space = Box(0, 255, shape, np.uint8)
        buffer = FrameReplayBuffer(transitions, space, Box(-1, 1, (1,)), device="cpu", frame_channels=3)  # takes no memory yet
        needed = buffer.full_bytes
        fits = needed < available
        size = " x ".join(map(str, shape))
        value = f"{needed / GIGABYTE:.1f} GB for {transitions:,} transitions of {size} bytes"
        yield Finding("memory", name, value if fits else f"{value}: does not fit", "ok" if fits else "note")
