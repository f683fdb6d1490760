"""CRC-RL for Stable-Baselines3: SAC from pixels with contrastive, reconstruction and consistency losses."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sb3_crc.envs.tasks import register_environments

if TYPE_CHECKING:
    from sb3_crc.buffers import DictFrameReplayBuffer, FrameReplayBuffer
    from sb3_crc.callbacks import (
        AuxiliaryLossCallback,
        NStepScheduleCallback,
        ObjectiveScheduleCallback,
        ReconstructionImageCallback,
    )
    from sb3_crc.checkpoints.callback import TrainingCheckpoint
    from sb3_crc.crc_sac import CRCSAC
    from sb3_crc.decoder import PixelDecoder
    from sb3_crc.encoder import PixelEncoder
    from sb3_crc.envs.dmc import make_dmc
    from sb3_crc.evaluation import QBiasEvalCallback
    from sb3_crc.export import export_policy, load_policy, load_weights
    from sb3_crc.policies import CRCPolicy
    from sb3_crc.presets import PRESETS
    from sb3_crc.workers import WatchedSubprocVecEnv, WorkerError

    __version__: str

__all__ = [
    "CRCSAC",
    "PRESETS",
    "AuxiliaryLossCallback",
    "CRCPolicy",
    "DictFrameReplayBuffer",
    "FrameReplayBuffer",
    "NStepScheduleCallback",
    "ObjectiveScheduleCallback",
    "PixelDecoder",
    "PixelEncoder",
    "QBiasEvalCallback",
    "ReconstructionImageCallback",
    "TrainingCheckpoint",
    "WatchedSubprocVecEnv",
    "WorkerError",
    "export_policy",
    "load_policy",
    "load_weights",
    "make_dmc",
]

#: Module -> its public names, which are imported when they are first asked for: the command line, completion in a shell and
#: registered environments then need no torch
_HOMES: dict[str, tuple[str, ...]] = {
    "buffers": ("DictFrameReplayBuffer", "FrameReplayBuffer"),
    "callbacks": (
        "AuxiliaryLossCallback",
        "NStepScheduleCallback",
        "ObjectiveScheduleCallback",
        "ReconstructionImageCallback",
    ),
    "checkpoints.callback": ("TrainingCheckpoint",),
    "crc_sac": ("CRCSAC",),
    "decoder": ("PixelDecoder",),
    "encoder": ("PixelEncoder",),
    "envs.dmc": ("make_dmc",),
    "evaluation": ("QBiasEvalCallback",),
    "export": ("export_policy", "load_policy", "load_weights"),
    "policies": ("CRCPolicy",),
    "presets": ("PRESETS",),
    "workers": ("WatchedSubprocVecEnv", "WorkerError"),
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        value: Any = import_module("importlib.metadata").version("sb3-crc")
    else:
        home = next((module for module, names in _HOMES.items() if name in names), None)
        if home is None:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        try:
            value = getattr(import_module(f"{__name__}.{home}"), name)
        except AttributeError as error:  # of a dependency: Python would take it for one of ours, and say that ours is missing
            raise ImportError(f"cannot import {name!r}: {error}") from error
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})


register_environments()
