"""Evaluation that also asks whether the critic believes what then happens.

T length of an episode in agent steps, A action.
"""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import EvalCallback

from sb3_crc.crc_sac import CRCSAC


class QBiasEvalCallback(EvalCallback):
    """
    SB3's EvalCallback, which for a :class:`~sb3_crc.CRCSAC` also logs the bias of its Q function at the start of each episode:

    ``eval/q_bias`` = ``eval/q_value`` - ``eval/soft_return``, means over the evaluation's episodes, where ``q_value`` is
    min Q(s_0, a_0) over the heads, and ``soft_return`` is what Q should say: r_0 + sum over t >= 1 of
    gamma^t (r_t - alpha log pi(a|s_t)), and where the time limit ended the episode
    gamma^T (min Q(s_T, a) - alpha log pi(a|s_T)), with actions a drawn from the policy (Haarnoja et al. 2018,
    arXiv 1812.05905, eq. 3). The evaluation itself acts by the policy's mean, so even a perfect critic shows a small bias; a
    growing one is overestimation. Rewards count with ``reward_scale``. Arguments are EvalCallback's; for other algorithms it
    is EvalCallback.
    """

    def _init_callback(self) -> None:
        super()._init_callback()
        self._episodes: dict[int, list[tuple[np.ndarray, np.ndarray, float]]] = {}
        self._biases: list[tuple[float, float]] = []

    def _on_step(self) -> bool:
        self._biases = []
        self._episodes = {}
        return super()._on_step()

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        """Called by ``evaluate_policy`` after each step of each environment."""
        super()._log_success_callback(locals_, globals_)
        if not isinstance(self.model, CRCSAC):
            return
        index, info = locals_["i"], locals_["info"]
        step = locals_["observations"][index], locals_["actions"][index], float(locals_["reward"])
        self._episodes.setdefault(index, []).append(step)
        if locals_["done"]:
            truncated = info.get("TimeLimit.truncated", False)
            last = info["terminal_observation"] if truncated else None
            self._biases.append(q_value_and_soft_return(self.model, self._episodes.pop(index), last))
            q_value, soft_return = np.mean(self._biases, axis=0)
            self.logger.record("eval/q_value", q_value)
            self.logger.record("eval/soft_return", soft_return)
            self.logger.record("eval/q_bias", q_value - soft_return)


def q_value_and_soft_return(
    model: CRCSAC, episode: list[tuple[np.ndarray, np.ndarray, float]], last: np.ndarray | None
) -> tuple[float, float]:
    """
    :param model: whose critic and actor are asked
    :param episode: observation, action as the environment took it, and reward of each of the T steps
    :param last: the observation after the last step, if a time limit ended the episode; None: it terminated
    :return: min Q(s_0, a_0), and the discounted soft return of the episode
    """
    observations, actions, rewards = zip(*episode, strict=True)
    frames = np.stack([*observations, *([] if last is None else [last])])
    policy, device = model.policy, model.device
    state = th.get_rng_state()  # evaluating must not change the run's random numbers
    with th.no_grad():
        taken = th.as_tensor(policy.scale_action(np.stack(actions[:1])), dtype=th.float32, device=device)
        q_value = th.cat(policy.critic(th.as_tensor(frames[:1], device=device), taken)).min()
        entropies, value = [], th.zeros(())
        for chunk in np.array_split(frames, max(1, len(frames) // 128)):
            images = th.as_tensor(chunk, device=device)
            drawn, log_prob = policy.actor.action_log_prob(images)
            entropies.append(-model._temperature() * log_prob)
            if last is not None:  # of the last chunk its last frame counts
                value = th.cat(policy.critic(images[-1:], drawn[-1:])).min() + entropies[-1][-1]
    th.set_rng_state(state)
    soft_rewards = model.reward_scale * np.array(rewards)
    soft_rewards[1:] += th.cat(entropies).cpu().numpy()[1 : len(rewards)]
    discounts = model.gamma ** np.arange(len(rewards))
    soft_return = float(discounts @ soft_rewards) + model.gamma ** len(rewards) * float(value)
    return float(q_value), soft_return
