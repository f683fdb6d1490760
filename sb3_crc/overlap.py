"""Updates that are made while the environments step, with the results that they have afterwards.

The update that follows a step reads transitions from the replay buffer. Which ones is a matter of random numbers and of how
many there are, so it is known before the step has ended; unless the step's own transition is among them, the update can be
made while the environments simulate and draw. Where these are processes of their own (SubprocVecEnv), both are done at once.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol

from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_crc.buffers import FrameReplayBuffer
from sb3_crc.finite import LossHistory


class Learner(Protocol):
    """What of an algorithm the updates need."""

    replay_buffer: ReplayBuffer | None
    batch_size: int
    gradient_steps: int
    policy: Any
    learning_starts: int
    num_timesteps: int
    train_freq: Any
    _n_updates: int
    _total_timesteps: int
    _last_obs: Any
    before_updates: list[Callable[[], None]]
    _vec_normalize_env: VecNormalize | None

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None: ...
    def _has_batch(self, batch_size: int) -> bool: ...
    def _begin_updates(self) -> LossHistory: ...
    def _make_update(self, history: LossHistory, batch_size: int) -> None: ...


class WhileStepping(VecEnvWrapper):
    """
    Does something else after the environments have been told to step, and before their answer is awaited.

    :param venv: the environments
    :param work: what to do
    """

    def __init__(self, venv: VecEnv, work: Callable[[], None]):
        super().__init__(venv)
        self._work = work

    def reset(self) -> VecEnvObs:
        """As the environments do."""
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Do it, then await the answer, also if it fails: the next step would take it for its own."""
        try:
            self._work()
        except BaseException:
            with suppress(Exception):  # Ctrl-C in a terminal ends the environments' processes too
                self.venv.step_wait()
            raise
        return self.venv.step_wait()


class EarlyUpdates:
    """
    Makes the updates that follow a step before it has ended.

    Not before the first updates, nor where rewards are normalised by numbers that the step changes.

    :param learner: whose updates they are
    """

    def __init__(self, learner: Learner):
        self._learner = learner
        self._history: LossHistory | None = None
        self._wrapper: WhileStepping | None = None

    def around(self, env: VecEnv) -> VecEnv:
        """:param env: of the learner; :return: the same, during whose steps updates are made"""
        if self._wrapper is None or self._wrapper.venv is not env:
            self._wrapper = WhileStepping(env, self._make)
        return self._wrapper

    def taken(self) -> LossHistory | None:
        """:return: what was made since this was last asked"""
        history, self._history = self._history, None
        return history

    def _make(self) -> None:
        try:
            self._make_updates()
        except BaseException:
            self._learner._last_obs = None  # the step is lost, so a later learn() resets the environments
            raise

    def _make_updates(self) -> None:
        learner, buffer = self._learner, self._learner.replay_buffer
        self._history = None  # left by a training that was stopped
        if not isinstance(buffer, FrameReplayBuffer) or learner._vec_normalize_env is not None:
            return
        steps = learner.num_timesteps + buffer.n_envs
        every_step = learner.train_freq == TrainFreq(1, TrainFrequencyUnit.STEP)
        if not every_step or learner._n_updates == 0 or steps <= learner.learning_starts:
            return
        if not learner._has_batch(learner.batch_size):
            return
        wanted = learner.gradient_steps if learner.gradient_steps >= 0 else buffer.n_envs
        learner._update_current_progress_remaining(steps, learner._total_timesteps)
        for act in learner.before_updates:
            act()
        with buffer.one_ahead():
            while wanted > 0 and buffer.next_batch_is_there(learner.batch_size):
                if self._history is None:
                    self._history = learner._begin_updates()
                learner._make_update(self._history, learner.batch_size)
                wanted -= 1
        learner.policy.set_training_mode(False)  # as it is while environments step
