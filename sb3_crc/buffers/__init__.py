"""Replay buffers in which each frame is stored once."""

from sb3_crc.buffers.dict_replay import DictFrameReplayBuffer
from sb3_crc.buffers.replay import FrameReplayBuffer
from sb3_crc.buffers.samples import FrameSamples

__all__ = ["DictFrameReplayBuffer", "FrameReplayBuffer", "FrameSamples"]
