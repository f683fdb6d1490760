"""Distracted test environments: DMControl-GB's colours and videos, and the Distracting Control Suite."""

from sb3_crc.envs.distractions.modes import DISTRACTIONS, MASKS, STATIC
from sb3_crc.envs.distractions.wrapper import DistractionWrapper

__all__ = ["DISTRACTIONS", "MASKS", "STATIC", "DistractionWrapper"]
