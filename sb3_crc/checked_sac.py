"""SB3's SAC with an eye on its numbers: what is not finite is neither stored nor trained on, and never goes unnoticed."""

from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_crc.buffers import FrameReplayBuffer
from sb3_crc.finite import LossHistory, not_finite, save_transition
from sb3_crc.instruments import HEALTH_INTERVAL, CollapseAlarm
from sb3_crc.whole_rollouts import WholeRollouts

#: Metrics that must stay finite, beside the objectives
LOSSES = (
    *("train/critic_loss", "train/actor_loss", "train/ent_coef_loss"),
    *(f"train/{optimizer}_gradient_norm" for optimizer in ("critic", "encoder", "actor", "ent_coef")),
)
#: What SB3 calls the last one of an episode; it is stored, and not the first one of the next
TERMINAL = "the terminal observation"


class CheckedSAC(WholeRollouts):
    """What is checked of transitions and updates; see ``on_nonfinite`` of CRCSAC."""

    on_nonfinite: str
    _collapse_alarm: CollapseAlarm
    _skipped_updates = 0
    _skipped_transitions = 0

    def _sample_action(self, *args: Any, **kwargs: Any) -> tuple[np.ndarray, np.ndarray]:
        actions, buffer_actions = super()._sample_action(*args, **kwargs)
        found = not_finite({"the action": actions})
        if found is not None:
            last = {"observation": self._last_obs, "action": actions}
            self._stop_at(found, last, "the policy's weights or what it was shown are not finite")
        return actions, buffer_actions

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: Any,
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        last = {int(env): infos[env].get("terminal_observation") for env in np.flatnonzero(dones)}  # stored in new_obs's place
        found = not_finite({"the reward": reward, "the observation": new_obs}) or _not_finite_at_the_end(last)
        if self._vec_normalize_env is not None:
            self._leave_what_is_not_normalized(self._vec_normalize_env, new_obs)
        if found is None:
            super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
            return
        if self.on_nonfinite == "stop":
            observations = {"observation": self._last_obs, "next_observation": new_obs}
            if found[0].startswith(TERMINAL):
                observations["terminal_observation"] = last[found[1]]
            self._stop_at(found, {**observations, "action": buffer_action, "reward": reward}, "the environment returned it")
        self._skipped_transitions += len(dones)
        if isinstance(replay_buffer, FrameReplayBuffer):
            replay_buffer.interrupt()
        self._last_obs = new_obs
        if self._vec_normalize_env is not None:
            self._last_original_obs = self._vec_normalize_env.get_original_obs()

    def _leave_what_is_not_normalized(self, normalize: VecNormalize, new_obs: Any) -> None:
        """Where SB3 stores what VecNormalize keeps, store what wrappers around it made of that (they are there in rl_zoo3)."""
        if not normalize.norm_obs:
            self._last_original_obs, normalize.old_obs = self._last_obs, new_obs
        elif isinstance(new_obs, dict):
            assert isinstance(self._last_obs, dict)
            assert isinstance(self._last_original_obs, dict)
            keys = normalize.norm_obs_keys or []
            self._last_original_obs = {**self._last_obs, **{key: self._last_original_obs[key] for key in keys}}
            normalize.old_obs = {**new_obs, **{key: normalize.old_obs[key] for key in keys}}

    def _stop_at(self, found: tuple[str, int, float], values: Mapping[str, Any], why: str) -> NoReturn:
        name, env, value = found
        target = save_transition(self.logger.dir, self.num_timesteps, values)
        stored = self.replay_buffer.size() if self.replay_buffer is not None else 0
        raise FloatingPointError(
            f"{name} of environment {env} is {value} at agent step {self.num_timesteps}, with {stored} rows stored: {why}; "
            f"what led to it is saved in {target}"
        )

    def _has_batch(self, batch_size: int) -> bool:
        """
        SB3 would fill the batch with copies, which are false negatives of the contrastive loss.

        :param batch_size: B
        :return: whether so many transitions are stored. A model that was loaded without its replay buffer acts until they are
        :raises ValueError: if they are not, and it has learned nothing yet, or the buffer cannot hold them
        """
        assert self.replay_buffer is not None
        stored, capacity = (n * self.replay_buffer.n_envs for n in (self.replay_buffer.size(), self.replay_buffer.buffer_size))
        if batch_size > stored and (self._n_updates == 0 or batch_size > capacity):
            raise ValueError(
                f"batch_size={batch_size} is more than the {stored} transitions that are stored: raise learning_starts "
                f"({self.learning_starts}) or buffer_size ({self.buffer_size}), or load a replay buffer"
            )
        return batch_size <= stored

    def _record(self, history: LossHistory, batch_size: int) -> None:
        """Log the means over one call of :meth:`train`."""
        means = history.means()
        if not np.isfinite(list(means.values())).all():
            assert self.replay_buffer is not None
            normalize, folder = self._vec_normalize_env, self.logger.dir
            if self.on_nonfinite == "stop":
                history.stop_if_not_finite(self.replay_buffer, batch_size, normalize, folder, self.num_timesteps)
            self._skipped_updates += history.drop_failures()
            means = history.means()
        if self.on_nonfinite == "skip":
            self.logger.record("train/skipped_updates", self._skipped_updates)
            self.logger.record("rollout/skipped_transitions", self._skipped_transitions)
        for name, mean in means.items():
            self.logger.record(name, mean)
        if "representation/latent_std" in means:
            self._collapse_alarm.check(means["representation/latent_std"], max(HEALTH_INTERVAL, len(history.updates)))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")


def _not_finite_at_the_end(observations: Mapping[int, Any]) -> tuple[str, int, float] | None:
    """:param observations: environment -> the last one of its episode; :return: as :func:`not_finite`"""
    for env, observation in observations.items():
        rows = {key: [one] for key, one in observation.items()} if isinstance(observation, Mapping) else [observation]
        found = not_finite({TERMINAL: rows})
        if found is not None:
            return found[0], env, found[2]
    return None
