"""CRC-RL for Stable-Baselines3: SAC from pixels with contrastive, reconstruction and consistency losses."""

from importlib.metadata import version

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
from sb3_crc.envs.tasks import register_environments
from sb3_crc.evaluation import QBiasEvalCallback
from sb3_crc.export import export_policy, load_policy, load_weights
from sb3_crc.policies import CRCPolicy
from sb3_crc.presets import PRESETS
from sb3_crc.workers import WatchedSubprocVecEnv, WorkerError

__version__ = version("sb3-crc")
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

register_environments()
