"""What the pages train with, made small: the same calls, on networks and budgets that take a second."""

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import stable_baselines3.common.evaluation
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

import sb3_crc
import sb3_crc.envs.dmc
from sb3_crc import CRCSAC, TrainingCheckpoint
from tests.docs.fences import ROOT

#: Argument -> the most that it may be
BUDGET = {"buffer_size": 500, "learning_starts": 40, "batch_size": 16}
STEPS = 44


def smaller(function: Callable[..., Any], change: Callable[[dict[str, Any]], None]) -> Callable[..., Any]:
    """The function, with its arguments, defaults included, changed by ``change`` before it is called."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        bound = signature.bind(*args, **kwargs)
        bound.apply_defaults()
        change(bound.arguments)
        return function(*bound.args, **bound.kwargs)

    return call


def at_most(**limits: int) -> Callable[[dict[str, Any]], None]:
    """Change arguments to be at most so large."""

    def change(arguments: dict[str, Any]) -> None:
        for name, limit in limits.items():
            arguments[name] = min(arguments[name], limit)

    return change


def small_networks(arguments: dict[str, Any]) -> None:
    """Small buffers and batches; for ours, small networks too."""
    at_most(**BUDGET)(arguments)
    if isinstance(arguments["self"], CRCSAC):
        own = dict(arguments["policy_kwargs"] or {})
        encoder = {**own.get("features_extractor_kwargs", {}), "channels": [8, 8], "strides": [2, 2]}
        arguments["policy_kwargs"] = {**own, "net_arch": [32, 32], "features_extractor_kwargs": encoder}


def fast_pictures(arguments: dict[str, Any]) -> None:
    """Pictures of the same size that are drawn quickly."""
    arguments["render_quality"] = "fast"


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """:return: the folder in which a page's code runs"""
    make_dmc = smaller(sb3_crc.envs.dmc.make_dmc, fast_pictures)
    evaluate = smaller(stable_baselines3.common.evaluation.evaluate_policy, at_most(n_eval_episodes=1))
    monkeypatch.setattr(sb3_crc.envs.dmc, "make_dmc", make_dmc)
    monkeypatch.setattr(sb3_crc, "make_dmc", make_dmc, raising=False)
    monkeypatch.setattr(stable_baselines3.common.evaluation, "evaluate_policy", evaluate)
    for owner, method, change in (
        (OffPolicyAlgorithm, "__init__", small_networks),
        (OffPolicyAlgorithm, "learn", at_most(total_timesteps=STEPS)),
        (EvalCallback, "__init__", at_most(eval_freq=STEPS, n_eval_episodes=1)),
        (TrainingCheckpoint, "__init__", at_most(every=STEPS)),
    ):
        monkeypatch.setattr(owner, method, smaller(getattr(owner, method), change))
    monkeypatch.syspath_prepend(ROOT)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dmcgb" / "video_easy").mkdir(parents=True)  # distractions.md: data that is not ours to ship
    np.save(tmp_path / "dmcgb" / "video_easy" / "clip.npy", np.zeros((4, 16, 16, 3), np.uint8))
    return tmp_path
