"""What a FrameReplayBuffer samples.

B batch, k frames in a stack, C channels of a frame, H, W height and width, A action.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch as th

from sb3_crc.buffers.store import FrameStacks

Observations = th.Tensor | FrameStacks | dict[str, th.Tensor | FrameStacks]


class FrameSamples(NamedTuple):
    """
    SB3's ``ReplayBufferSamples``, and the observation one step on.

    :param observations: o_t, ``(B, k C, H, W)``, or a mapping of such
    :param actions: ``(B, A)``
    :param next_observations: o_{t+n}, from which the return is bootstrapped
    :param dones: 1 where the episode terminated (not: was truncated) within the n steps, ``(B, 1)``
    :param rewards: discounted sum over up to n steps, ``(B, 1)``
    :param discounts: of the value of ``next_observations``, ``(B, 1)``; None for ``n_steps=1``: the algorithm's gamma
    :param one_step_observations: o_{t+1}; for ``n_steps=1`` the same object as ``next_observations``
    """

    observations: Observations
    actions: th.Tensor
    next_observations: Observations
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | None
    one_step_observations: Observations

    def whole(self) -> "FrameSamples":
        """:return: the same with all frames gathered"""
        following = whole(self.next_observations)
        one_step = following
        if self.one_step_observations is not self.next_observations:
            one_step = whole(self.one_step_observations)
        return self._replace(
            observations=whole(self.observations), next_observations=following, one_step_observations=one_step
        )


def whole(observations: Observations) -> Any:
    """:return: the observations with all frames gathered"""
    if isinstance(observations, Mapping):
        return {key: whole(value) for key, value in observations.items()}
    return observations.whole() if isinstance(observations, FrameStacks) else observations
