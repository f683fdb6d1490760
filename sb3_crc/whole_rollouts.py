"""SB3's SAC without the gap that a callback leaves which ends a training."""

from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import RolloutReturn
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.sac.sac import SAC


class WholeRollouts(SAC):
    """SAC that also stores the step at which a callback ends the training, so that a later ``learn()`` goes on after it."""

    def collect_rollouts(self, env: VecEnv, callback: BaseCallback, *args: Any, **kwargs: Any) -> RolloutReturn:
        """As in SB3, which returns before it stores that step: the last observation would be one behind the environment."""
        rollout = super().collect_rollouts(env, callback, *args, **kwargs)
        if not rollout.continue_training:
            step = callback.locals
            names = ("replay_buffer", "buffer_actions", "new_obs", "rewards", "dones", "infos")
            self._store_transition(*(step[name] for name in names))
        return rollout
