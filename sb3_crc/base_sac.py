"""SB3's SAC as CRCSAC needs it around the algorithm: our policy, four learning rates, counted steps, checked files."""

import io
import os
import pathlib
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from inspect import signature
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.sac.sac import SAC
from typing_extensions import Self

from sb3_crc.atomic import atomic_write
from sb3_crc.buffers import DictFrameReplayBuffer, FrameReplayBuffer
from sb3_crc.buffers.files import load_buffer_file, save_buffer_file
from sb3_crc.checked_sac import LOSSES, CheckedSAC
from sb3_crc.convolutions import fast_updates
from sb3_crc.finite import LossHistory
from sb3_crc.instruments import HEALTH_INTERVAL, CollapseAlarm, Speedometer, watched
from sb3_crc.overlap import EarlyUpdates
from sb3_crc.policies import CRCActor, CRCCritic, CRCPolicy
from sb3_crc.recording import RecordedUpdates, recorded_updates, unprepare
from sb3_crc.saved_model import add_plain_attributes, check_pickles, check_saved_model, read_saved_attributes
from sb3_crc.schedules import LearningRate, check_learning_rate, lr_schedule, set_learning_rate
from sb3_crc.settings import check_name
from sb3_crc.stacking import stacked_frame_channels
from sb3_crc.views import Views

#: Arguments of the policy that are the algorithm's to give, and what gives them
GIVEN = {
    **{"objectives": "objectives", "joint_update": "joint_update"},
    **{"qf_lr_schedule": "qf_learning_rate", "encoder_lr_schedule": "encoder_learning_rate"},
}


def check_arguments(algorithm: type[SAC], arguments: Iterable[str], policy_kwargs: Iterable[str]) -> None:
    """
    :param algorithm: CRCSAC
    :param arguments: names of those that it hands on to SB3's SAC
    :param policy_kwargs: names of those for the policy
    :raises TypeError: for an argument that there is not
    :raises ValueError: for one of the policy that is an argument of the algorithm
    """
    known = sorted({*signature(SAC.__init__).parameters, *signature(algorithm.__init__).parameters} - {"self", "kwargs"})
    for name in arguments:
        try:
            check_name(f"argument of {algorithm.__name__}", name, known)
        except ValueError as error:
            raise TypeError(str(error)) from None
    for name in policy_kwargs:
        if name in GIVEN:
            raise ValueError(f"policy_kwargs: {name} is not the policy's own, give {algorithm.__name__} {GIVEN[name]}=...")


class BaseCRCSAC(CheckedSAC):
    """What CRCSAC changes of SB3's SAC beside the algorithm itself; it does not train."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"CnnPolicy": CRCPolicy, "MultiInputPolicy": CRCPolicy}
    policy: CRCPolicy
    actor: CRCActor
    critic: CRCCritic
    critic_target: CRCCritic
    qf_learning_rate: LearningRate | None
    encoder_learning_rate: LearningRate | None
    ent_coef_learning_rate: LearningRate | None
    replay_device: str
    overlap: bool
    compile: bool
    policy_delay: int
    auxiliary_interval: int
    joint_update: bool
    _objective_weights: dict[str, float]
    _weight_tensors: dict[str, th.Tensor]
    _early_updates: EarlyUpdates
    #: Called before the updates that follow a step, also where these are made early; learn() begins and ends without any
    before_updates: list[Callable[[], None]]
    _env_steps: int | None = None
    _frame_channels: int | None = None
    _speedometer: Speedometer
    _recorded: RecordedUpdates | None = None

    def between_updates(self) -> None:
        """Called before each update of :meth:`train`; a callback may put a function in its place, to stop there."""

    def _setup_model(self) -> None:
        self._speedometer = Speedometer()
        self._collapse_alarm = CollapseAlarm()
        self._early_updates = EarlyUpdates(self)
        self.before_updates = []
        own = {name: getattr(self, name) for name in ("replay_buffer_class", "replay_buffer_kwargs", "n_steps")}
        self._choose_replay_buffer()
        super()._setup_model()
        vars(self).update(own)  # as the user gave them: load() compares the two
        buffer = self.replay_buffer
        if isinstance(buffer, FrameReplayBuffer) and self.replay_device == "auto" and not buffer.fits(self.device):
            buffer.frame_device = th.device("cpu")

    def _choose_replay_buffer(self) -> None:
        is_dict = isinstance(self.observation_space, spaces.Dict)
        if self.replay_buffer_class is None:
            self.replay_buffer_class = DictFrameReplayBuffer if is_dict else FrameReplayBuffer
        self.replay_buffer_kwargs = dict(self.replay_buffer_kwargs or {})
        if issubclass(self.replay_buffer_class, FrameReplayBuffer):
            if self.env is not None:  # a model that is loaded without one has saved what it was
                self._frame_channels = stacked_frame_channels(self.env)
            derived: dict[str, Any] = {"frame_channels": self._frame_channels, "n_steps": self.n_steps, "gamma": self.gamma}
            derived["frame_device"] = "cpu" if self.replay_device == "cpu" else None
            self.replay_buffer_kwargs = derived | self.replay_buffer_kwargs
            self.n_steps = 1  # SB3 would warn that a class it does not know ignores them

    def _frames_of(self, encoder_kwargs: dict[str, Any]) -> dict[str, int]:
        """:return: what an encoder that feeds differences of frames must know, unless it is told"""
        channels = self._frame_channels if self.env is None else stacked_frame_channels(self.env)
        return {"frame_channels": channels} if channels and encoder_kwargs.get("frame_differences") else {}

    def _setup_lr_schedule(self) -> None:
        self._lr_schedules: dict[str, FloatSchedule] = {}
        for name in ("learning_rate", "qf_learning_rate", "encoder_learning_rate", "ent_coef_learning_rate"):
            value = getattr(self, name)
            self._lr_schedules[name] = self._lr_schedules["learning_rate"] if value is None else lr_schedule(value)
            check_learning_rate(name, self._lr_schedules[name](1))
        self.lr_schedule = self._lr_schedules["learning_rate"]

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        if policy_name not in self.policy_aliases:
            raise ValueError(
                f"policy {policy_name!r} is not supported: {type(self).__name__} learns from images with 'CnnPolicy', from "
                "Dict observations with one image with 'MultiInputPolicy'; for flat observations use stable_baselines3.SAC"
            )
        return super()._get_policy_from_name(policy_name)

    def _check_policy_name(self, policy: object) -> None:
        if self.env is None:  # load() gives it later
            return
        is_dict = isinstance(self.observation_space, spaces.Dict)
        needed = "MultiInputPolicy" if is_dict else "CnnPolicy"
        if isinstance(policy, str) and policy != needed:
            kind = "Dict observations" if is_dict else "observations that are one image"
            raise ValueError(f"policy {policy!r} does not suit {kind}: use {needed!r}")

    def _optimizers(self) -> dict[str, th.optim.Optimizer]:
        """:return: name of its learning rate -> optimizer, of those that there are"""
        optimizers = {
            "learning_rate": self.actor.optimizer,
            "qf_learning_rate": self.critic.optimizer,
            "encoder_learning_rate": self.policy.encoder_optimizer,
            "ent_coef_learning_rate": self.ent_coef_optimizer,
        }
        return {name: optimizer for name, optimizer in optimizers.items() if optimizer is not None}

    def _begin_updates(self) -> LossHistory:
        """:return: of what was made already, or of what is to come"""
        for act in self.before_updates:
            act()
        self.policy.set_training_mode(True)
        for name, optimizer in self._optimizers().items():
            value = self._lr_schedules[name](self._current_progress_remaining)
            check_learning_rate(name, value)
            set_learning_rate(optimizer, value)
        losses = {*LOSSES, *(f"representation/{name}" for name in self.policy.objectives)}
        return self._early_updates.taken() or LossHistory(self._n_updates + 1, losses)

    def _objectives_due(self) -> bool:
        """Whether this update trains by them: of what they ask at a rate of 0 only ``joint_update`` makes anything."""
        rate = self._lr_schedules["encoder_learning_rate"](self._current_progress_remaining)
        return self._n_updates % self.auxiliary_interval == 0 and (rate > 0 or self.joint_update)

    def _record(self, history: LossHistory, batch_size: int) -> None:
        super()._record(history, batch_size)
        for name in self._optimizers():
            self.logger.record(f"train/{name}", self._lr_schedules[name](self._current_progress_remaining))

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        super()._update_info_buffer(infos, dones)
        if all("env_steps" in info for info in infos):
            self._env_steps = sum(info["env_steps"] for info in infos)

    def dump_logs(self) -> None:
        """Write the log; ``time/env_steps`` counts the simulator's steps, ``time/total_timesteps`` the agent's decisions."""
        counts = {"updates": self._n_updates, "agent_steps": self.num_timesteps}
        if self._env_steps is not None:
            self.logger.record("time/env_steps", self._env_steps)
            counts["env_steps"] = self._env_steps
        for name, rate in self._speedometer.read(counts).items():
            self.logger.record(f"time/{name}_per_second", rate)
        super().dump_logs()

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if isinstance(self.replay_buffer, FrameReplayBuffer):
            self.replay_buffer.warn_if_too_large()
            self._check_capacity(self.replay_buffer, total_timesteps + (0 if reset_num_timesteps else self.num_timesteps))
            if reset_num_timesteps or self._last_obs is None:  # SB3 resets the environments
                self.replay_buffer.interrupt()
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)

    def _check_capacity(self, buffer: FrameReplayBuffer, until: int) -> None:
        """Before random actions fill it for nothing."""
        capacity = buffer.buffer_size * buffer.n_envs
        if self.batch_size > capacity and self.gradient_steps != 0 and until > self.learning_starts:
            raise ValueError(
                f"batch_size={self.batch_size} is more than the replay buffer holds, {capacity} transitions: raise buffer_size"
            )

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "CRCSAC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """
        As in SB3; ``total_timesteps`` are agent steps, each of ``action_repeat`` environment steps. On a CPU the process keeps
        freed memory until the end (:func:`~sb3_crc.memory.memory_kept`), on a GPU it looks for the fastest convolutions
        (:func:`~sb3_crc.convolutions.fastest_convolutions`).
        """
        with fast_updates(self.device), self._own_values_afterwards():
            return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    @contextmanager
    def _own_values_afterwards(self) -> Iterator[None]:
        """What callbacks schedule is over with the training, however that ends."""
        rates, weights, buffer = dict(self._lr_schedules), dict(self._objective_weights), self.replay_buffer
        n_steps = buffer.n_steps if isinstance(buffer, FrameReplayBuffer) else 1
        try:
            yield
        finally:
            self.before_updates.clear()
            self._lr_schedules, self._objective_weights = rates, weights
            if isinstance(buffer, FrameReplayBuffer):
                buffer.n_steps = n_steps

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """As in SB3, but a file appears whole or not at all: an interrupted save leaves the one that was there before."""
        if isinstance(path, io.BufferedIOBase):
            super().save(path, exclude, include)
            add_plain_attributes(path, vars(self))
            return
        target = pathlib.Path(path)
        target = target if target.suffix else target.with_name(f"{target.name}.zip")
        if target.is_dir():  # SB3 has its own name for it
            return super().save(path, exclude, include)
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(target) as unfinished:
            super().save(unfinished, exclude, include)
            add_plain_attributes(unfinished, vars(self))

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """
        Save the replay buffer: as a folder of npy files, in which a later call adds only what is new; nothing is pickled.

        :param path: of the folder; as in SB3 without an ending it gets ``.pkl``. Or a stream, which gets a zip of the same
        """
        if isinstance(self.replay_buffer, FrameReplayBuffer):
            save_buffer_file(self.replay_buffer, path)
        else:
            super().save_replay_buffer(path)

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        Load a replay buffer, also one that SB3 has pickled (unpickle only what you trust).

        :param path: as for :meth:`save_replay_buffer`
        :param truncate_last_traj: as in SB3
        :raises FileNotFoundError: if there is none
        :raises ValueError: if it is damaged or does not fit the model, whose buffer then stays as it was
        """
        if isinstance(self.replay_buffer, FrameReplayBuffer):
            load_buffer_file(self.replay_buffer, path)
        else:
            super().load_replay_buffer(path, truncate_last_traj)

    @classmethod
    def load(
        cls,
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> Self:
        """
        As in SB3, but attributes that have a plain form are read from it and not unpickled. What a file pickles beside that is
        executed, and named in a warning.

        :param safe: among ``kwargs``: refuse to unpickle anything (default: whether SB3_CRC_SAFE_LOAD=1). Attributes that
            ``custom_objects`` gives are not read at all
        :raises ValueError: for a file that is not a whole model of CRCSAC, arguments that it does not have, or pickles if that
            is to be safe
        """
        saved = check_saved_model(path)
        safe = bool(kwargs.pop("safe", os.environ.get("SB3_CRC_SAFE_LOAD") == "1"))
        known = {*saved, *signature(cls.__init__).parameters, "safe"}
        for key in kwargs:
            check_name("argument of load", key, sorted(known))
        custom_objects = {**read_saved_attributes(path), **(custom_objects or {})}
        check_pickles(path, saved, custom_objects, safe=safe)
        return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)

    # -- Other ways to make an update --------------------------------------------------------------------------------

    def collect_rollouts(self, env: VecEnv, callback: BaseCallback, *args: Any, **kwargs: Any) -> RolloutReturn:
        """As in SB3; with ``overlap``, updates are made during the steps."""
        rollout = super().collect_rollouts(self._early_updates.around(env) if self.overlap else env, callback, *args, **kwargs)
        if not rollout.continue_training:
            self._early_updates.taken()
        return rollout

    def _set_up_recording(self) -> None:
        optimizers = self._optimizers().values()
        self._recorded = recorded_updates(self._update, optimizers, self.device) if self.compile else None
        recorded_weights = self._objective_weights if self._recorded else ()
        self._weight_tensors = {name: th.zeros((), device=self.device) for name in recorded_weights}

    @abstractmethod
    def _make_update(self, history: LossHistory, batch_size: int) -> None:
        """Draw a batch, and make one update by it."""

    @abstractmethod
    def _update(self, views: Views) -> dict[str, th.Tensor]:
        """Make one update by the views of a batch. :return: its metrics"""

    def _replayed(self, views: Views) -> dict[str, th.Tensor]:
        """:meth:`_update` by a recording, but where instruments look at it, which wait for the device."""
        assert self._recorded is not None
        for name, weight in self._objective_weights.items():
            self._weight_tensors[name].fill_(weight)
        if self._n_updates % HEALTH_INTERVAL == 0:
            return self._update(views)
        due = tuple(self._n_updates % interval == 0 for interval in (self.policy_delay, self.target_update_interval))
        return self._recorded(views, (*due, self._objectives_due(), views.has_next))  # the last changes when n_steps does

    def _instruments(self, views: Views) -> AbstractContextManager[dict[str, th.Tensor]]:
        if self._n_updates % HEALTH_INTERVAL != 0:
            return nullcontext({})
        parts = {"encoder": list(self.critic.features_extractor.parameters()), "q_heads": self.critic.head_parameters()}
        return watched(lambda: views.anchor.leaves, parts)

    # -- Saving ------------------------------------------------------------------------------------------------------

    def set_parameters(self, *args: Any, **kwargs: Any) -> None:
        """As in SB3."""
        super().set_parameters(*args, **kwargs)
        self.forget_recordings()

    def forget_recordings(self) -> None:
        """Call after the optimizers were given other states: those that recorded updates wrote to are no longer theirs."""
        unprepare(self._optimizers().values())
        if self._recorded is not None:
            self._recorded.forget()

    def _excluded_save_params(self) -> list[str]:
        return [
            *super()._excluded_save_params(),
            "_lr_schedules",
            "_augment",
            "_augment_query",
            "_objective_weights",
            "_collapse_alarm",
            "_speedometer",
            "_reads_next",
            "_recorded",
            "_weight_tensors",
            "_early_updates",
            "between_updates",
            "before_updates",
        ]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        if self.policy.encoder_optimizer is not None:
            state_dicts = [*state_dicts, "policy.encoder_optimizer"]
        return state_dicts, variables
