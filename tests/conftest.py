"""Tiny image environments and models, so that a test takes a second."""

import shutil
import signal
import threading
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_crc import CRCSAC

# Started in the background by a script, pytest ignores Ctrl-C, and so would the processes in which tests send it
if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

SIZE = 40
#: Networks that are large enough to be real and small enough to be quick
POLICY_KWARGS: dict[str, Any] = {
    "net_arch": [32, 32],
    "features_extractor_kwargs": {"channels": [8, 8], "strides": [2, 2], "features_dim": 16},
}


class NoiseEnv(gym.Env[np.ndarray, np.ndarray]):
    """Random frames; the reward is the action's first entry; episodes of ``length`` steps end by truncation."""

    def __init__(self, size: int = SIZE, channels: int = 9, length: int = 10):
        self.observation_space = gym.spaces.Box(0, 255, (channels, size, size), np.uint8)
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.length = length
        self.steps = 0

    def _frame(self) -> np.ndarray:
        return self.np_random.integers(0, 256, self.observation_space.shape, dtype=np.uint8)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self._frame(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return self._frame(), float(action[0]), False, self.steps >= self.length, {}


class ClockEnv(gym.Env[np.ndarray, np.ndarray]):
    """Reward 1 at each of five steps; the frame shows the time as a bar. The end is a time limit or a termination."""

    def __init__(self, terminates: bool, size: int = 36):
        self.observation_space = gym.spaces.Box(0, 255, (3, size, size), np.uint8)
        self.action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
        self.terminates = terminates
        self.steps = 0

    def _frame(self) -> np.ndarray:
        frame = np.zeros(self.observation_space.shape, np.uint8)
        frame[:, :, self.steps * 7 : self.steps * 7 + 6] = 255
        return frame

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self._frame(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        end = self.steps == 5
        return self._frame(), 1.0, end and self.terminates, end, {}


def construct(env: gym.Env[Any, Any] | None = None, **settings: Any) -> CRCSAC:
    """A tiny CRCSAC that has seen nothing yet."""
    return CRCSAC("CnnPolicy", env or NoiseEnv(), **{"buffer_size": 50, "policy_kwargs": POLICY_KWARGS, **settings})


def make_model(env: gym.Env[Any, Any] | None = None, **kwargs: Any) -> CRCSAC:
    """A tiny CRCSAC, seeded, with 40 transitions of random frames in its buffer and nothing learned yet."""
    settings: dict[str, Any] = {
        "batch_size": 16,
        "buffer_size": 200,
        "learning_starts": 40,
        "policy_kwargs": POLICY_KWARGS,
        "seed": 0,
        "device": "cpu",
    }
    model = CRCSAC("CnnPolicy", env or NoiseEnv(), **{**settings, **kwargs})
    return model.learn(40)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """
    Slow and long tests may take their time: the limit of the fast ones would fail them on a busy machine. Those that say that
    they take longest come first, so that what runs beside them ends when they do.
    """

    def own_limit(item: pytest.Item) -> float:
        marker = item.get_closest_marker("timeout")
        return 0.0 if marker is None else float(marker.args[0])

    items.sort(key=own_limit, reverse=True)
    for item in items:
        for marker, seconds in (("slow", 900), ("long", 6 * 3600)):
            if item.get_closest_marker(marker) is not None:
                item.add_marker(pytest.mark.timeout(seconds))


@pytest.fixture(autouse=True)
def repeatable() -> None:
    """The same random numbers at each run; one thread, since two processes with two each would ruin each other's speed."""
    th.set_num_threads(1)
    th.manual_seed(0)
    np.random.seed(0)


@pytest.fixture(scope="module")
def observations() -> np.ndarray:
    """Five stacks of random frames, as :class:`NoiseEnv` has them."""
    return np.random.default_rng(0).integers(0, 256, (5, 9, 40, 40), dtype=np.uint8)


@pytest.fixture
def browser() -> Iterator[Any]:
    """Debian's Chromium, driven by Playwright; without one nothing can be shown."""
    sync_api = pytest.importorskip("playwright.sync_api")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        pytest.skip("no Chromium")
    with sync_api.sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        yield launched
        launched.close()
