"""Evaluation that also asks whether the critic believes what then happens.

T length of an episode in agent steps, A action.
"""

import io
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import EvalCallback

from sb3_crc.atomic import atomic_write
from sb3_crc.crc_sac import CRCSAC
from sb3_crc.disk import outlived

Observation = np.ndarray | dict[str, np.ndarray]

#: Evaluation k of every run begins with this seed plus k times the step; far from the seeds of trainings, and from those of
#: experiments/final.py
FIRST_SEED, SEED_STEP = 20_000, 100


class QBiasEvalCallback(EvalCallback):
    """
    SB3's EvalCallback, which for a :class:`~sb3_crc.CRCSAC` also logs the bias of its Q function at the start of each episode:

    ``eval/q_bias`` = ``eval/q_value`` - ``eval/soft_return``, means over the evaluation's episodes, where ``q_value`` is
    min Q(s_0, a_0) over the heads, and ``soft_return`` is what Q should say: r_0 + sum over t >= 1 of
    gamma^t (r_t - alpha log pi(a|s_t)), and where the time limit ended the episode
    gamma^T (min Q(s_T, a) - alpha log pi(a|s_T)), with actions a drawn from the policy (Haarnoja et al. 2018,
    arXiv 1812.05905, eq. 3). The evaluation itself acts by the policy's mean, so even a perfect critic shows a small bias; a
    growing one is overestimation. Rewards are those of the evaluation's environment times ``reward_scale``: where VecNormalize
    changes those of the training alone, the bias says nothing. Arguments are EvalCallback's; for other algorithms nothing of
    this is logged.

    For every algorithm the k-th evaluation begins with the same seed, so that methods and seeds meet the same initial states;
    and ``evaluations.npz`` also holds ``seeds``, ``updates`` (gradient steps) and ``seconds`` of training, without
    evaluations, at each of them, and ``training_seconds`` in all.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._episodes: dict[int, list[tuple[Observation, np.ndarray, float]]] = {}
        self._biases: list[tuple[float, float]] = []
        self.evaluations_seeds: list[int] = []
        self.evaluations_updates: list[int] = []
        self.evaluations_seconds: list[float] = []
        self._trained, self._since = 0.0, time.perf_counter()

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._since = time.perf_counter()

    def _on_training_end(self) -> None:
        super()._on_training_end()
        self._stop_clock()
        if self.log_path is not None:
            self._write_evaluations()

    def training_state(self) -> dict[str, float]:
        """:return: what a checkpoint keeps beside the plain attributes: seconds of training until now"""
        self._stop_clock()
        return {"seconds": self._trained}

    def set_training_state(self, state: dict[str, float]) -> None:
        """:param state: of :meth:`training_state`"""
        self._trained, self._since = state["seconds"], time.perf_counter()

    def _stop_clock(self) -> None:
        now = time.perf_counter()
        self._trained, self._since = self._trained + now - self._since, now

    def _on_step(self) -> bool:
        if self.eval_freq <= 0 or self.n_calls % self.eval_freq != 0:
            return super()._on_step()
        self._stop_clock()
        seed = FIRST_SEED + SEED_STEP * (self.n_calls // self.eval_freq)
        self.eval_env.seed(seed)
        try:
            return self._evaluate(seed)
        finally:
            self._since = time.perf_counter()

    def _evaluate(self, seed: int) -> bool:
        self._biases = []
        self._episodes = {}
        if self.log_path is None:
            return self._evaluate_and_save()
        done = len(self.evaluations_length)
        # SB3's own writing, which Ctrl-C may cut short, goes nowhere; what is evaluated by then is written whole
        log_path, self.log_path = self.log_path, io.BytesIO()  # type: ignore[assignment]
        try:
            return self._evaluate_and_save()
        finally:
            self.log_path = log_path
            if len(self.evaluations_length) > done:
                self.evaluations_seeds.append(seed)
                self.evaluations_updates.append(getattr(self.model, "_n_updates", 0))
                self.evaluations_seconds.append(self._trained)
            self._write_evaluations()

    def _evaluate_and_save(self) -> bool:
        with self._saves_outlived():
            return super()._on_step()

    @contextmanager
    def _saves_outlived(self) -> Iterator[None]:
        """That the best model cannot be written ends nothing. The environment's own errors are no matter of the disk."""
        model, attributes = self.model, vars(self.model)
        own = {"save": attributes.pop("save")} if "save" in attributes else {}  # of AuxiliaryLossCallback

        def save(*args: Any, **kwargs: Any) -> None:
            attributes.pop("save")  # it would be saved with the model
            attributes.update(own)
            try:
                with outlived(f"the best model in {self.best_model_save_path}"):
                    model.save(*args, **kwargs)
            finally:
                attributes["save"] = save

        attributes["save"] = save
        try:
            yield
        finally:
            attributes.pop("save")
            attributes.update(own)

    def _write_evaluations(self) -> None:
        records: dict[str, list[Any]] = {
            "timesteps": self.evaluations_timesteps,
            "results": self.evaluations_results,
            "ep_lengths": self.evaluations_length,
        }
        complete = min(len(values) for values in records.values())
        arrays = {name: np.array(values[:complete]) for name, values in records.items()}
        if self.evaluations_successes:
            arrays["successes"] = np.array(self.evaluations_successes)
        for name in ("seeds", "updates", "seconds"):
            if len(values := getattr(self, f"evaluations_{name}")) == complete:  # not if an older checkpoint knew of none
                arrays[name] = np.array(values)
        arrays["training_seconds"] = np.array(self._trained)
        path = Path(f"{self.log_path}.npz")
        if complete > 0:
            with outlived(path), atomic_write(path) as unfinished, unfinished.open("wb") as file:
                np.savez(file, **arrays)  # type: ignore[arg-type]

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        """Called by ``evaluate_policy`` after each step of each environment."""
        super()._log_success_callback(locals_, globals_)
        if not isinstance(self.model, CRCSAC):
            return
        index, info = locals_["i"], locals_["info"]
        observation = _rows(locals_["observations"], index)
        step = observation, locals_["actions"][index], float(locals_["reward"])
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
    model: CRCSAC, episode: list[tuple[Observation, np.ndarray, float]], last: Observation | None
) -> tuple[float, float]:
    """
    :param model: whose critic and actor are asked
    :param episode: observation, channels first or last, action as the environment took it, and reward of each of the T steps
    :param last: the observation after the last step, if a time limit ended the episode; None: it terminated
    :return: min Q(s_0, a_0), and the discounted soft return of the episode
    """
    observations, actions, rewards = zip(*episode, strict=True)
    frames = _stack([*observations, *([] if last is None else [last])])
    n_frames = len(rewards) + (last is not None)
    policy, device = model.policy, model.device
    gpus = [device] if device.type == "cuda" else []
    with th.no_grad(), th.random.fork_rng(gpus):  # evaluating must not change the run's random numbers
        scaled = policy.scale_action(np.stack(actions[:1])).reshape(1, -1)
        taken = th.as_tensor(scaled, dtype=th.float32, device=device)
        first, _ = policy.obs_to_tensor(_rows(frames, slice(1)))
        q_value = th.cat(policy.critic(first, taken)).min()
        entropies, value = [], th.zeros(())
        for chunk in np.array_split(np.arange(n_frames), max(1, n_frames // 128)):
            seen, _ = policy.obs_to_tensor(_rows(frames, chunk))
            drawn, log_prob = policy.actor.action_log_prob(seen)
            entropies.append(-model._temperature() * log_prob)
            if last is not None:  # of the last chunk its last frame counts
                value = th.cat(policy.critic(_rows(seen, slice(-1, None)), drawn[-1:])).min() + entropies[-1][-1]
    soft_rewards = model.reward_scale * np.array(rewards)
    soft_rewards[1:] += th.cat(entropies).cpu().numpy()[1 : len(rewards)]
    discounts = model.gamma ** np.arange(len(rewards))
    soft_return = float(discounts @ soft_rewards) + model.gamma ** len(rewards) * float(value)
    return float(q_value), soft_return


def _rows(observations: Any, rows: Any) -> Any:
    if isinstance(observations, dict):
        return {key: values[rows] for key, values in observations.items()}
    return observations[rows]


def _stack(observations: list[Any]) -> Any:
    if isinstance(observations[0], dict):
        return {key: np.stack([observation[key] for observation in observations]) for key in observations[0]}
    return np.stack(observations)
