"""CRC-RL as a Stable-Baselines3 algorithm.

B batch, Z latent, A action.
"""

import difflib
from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import (
    FloatSchedule,
    LinearSchedule,
    polyak_update,
    update_learning_rate,
)
from stable_baselines3.sac.sac import SAC
from typing_extensions import Self

from sb3_crc.augmentations import AUGMENTATIONS, ImageSize, center_crop
from sb3_crc.encoder import image_shape
from sb3_crc.objectives import ObjectiveSettings, objective_weights
from sb3_crc.policies import CRCActor, CRCCritic, CRCPolicy
from sb3_crc.presets import PRESETS
from sb3_crc.views import Views

LearningRate = float | str | Schedule

#: Side of the network's input over that of the frame, where crops are cut: 84 of 100 pixels (RAD, CURL, CRC-RL).
CROP_RATIO = 0.84


class CRCSAC(SAC):
    """
    SAC whose every gradient step also trains the shared CNN with weighted auxiliary objectives, by default the three of
    CRC-RL: contrastive, reconstruction, consistency (arXiv 2301.13473).

    Arguments that are not listed are those of :class:`stable_baselines3.SAC`, with its defaults.

    :param policy: ``"CnnPolicy"`` or a subclass of :class:`~sb3_crc.CRCPolicy`
    :param env: environment with channel-first or -last uint8 images and continuous actions, or its id
    :param learning_rate: of the actor; a number, a schedule of the remaining progress, or ``"lin_x"``: from x down to 0
    :param buffer_size: capacity of the replay buffer, in agent steps
    :param learning_starts: agent steps with random actions before the first update
    :param batch_size: transitions per update
    :param tau: rate at which the target Q heads follow, per target update
    :param encoder_tau: rate at which the key encoder (which is also the target encoder) follows, per target update
    :param target_update_interval: updates between two target updates
    :param policy_delay: updates between two updates of actor and temperature
    :param ent_coef: temperature, as in SAC
    :param qf_learning_rate: of Q heads and encoder under the critic loss; None: ``learning_rate``
    :param encoder_learning_rate: of encoder and objectives under the auxiliary losses; None: ``learning_rate``
    :param ent_coef_learning_rate: of the temperature; None: ``learning_rate``
    :param objectives: name -> weight, or name -> ``{"weight": w, **settings}``; ``{}``: no auxiliary losses
    :param augmentation: name in :data:`~sb3_crc.augmentations.AUGMENTATIONS`
    :param augmentation_kwargs: its arguments
    :param image_size: side of the network's input in pixels, or (height, width); None: 84 % of the frame for the two crops,
        the whole frame for other augmentations
    :param initial_updates: extra updates, made once, with the first ones
    :param reward_scale: factor on the rewards of sampled transitions
    :param max_grad_norm: clip each optimizer's gradient to this norm; None: never
    :raises ValueError: for observations or settings that cannot work, naming the value and what is allowed
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"CnnPolicy": CRCPolicy}
    policy: CRCPolicy
    actor: CRCActor
    critic: CRCCritic
    critic_target: CRCCritic

    def __init__(
        self,
        policy: str | type[CRCPolicy],
        env: GymEnv | str,
        learning_rate: LearningRate = 1e-3,
        buffer_size: int = 100_000,
        learning_starts: int = 1_000,
        batch_size: int = 512,
        tau: float = 0.01,
        *,
        encoder_tau: float = 0.05,
        target_update_interval: int = 2,
        policy_delay: int = 2,
        ent_coef: str | float = "auto_0.1",
        qf_learning_rate: LearningRate | None = None,
        encoder_learning_rate: LearningRate | None = None,
        ent_coef_learning_rate: LearningRate | None = 1e-4,
        objectives: ObjectiveSettings = PRESETS["crc"]["objectives"],
        augmentation: str = "random_crop",
        augmentation_kwargs: Mapping[str, Any] | None = None,
        image_size: ImageSize | None = None,
        initial_updates: int = 0,
        reward_scale: float = 1.0,
        max_grad_norm: float | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ):
        super().__init__(
            policy,
            env,
            learning_rate,  # type: ignore[arg-type]
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            ent_coef=ent_coef,
            target_update_interval=target_update_interval,
            policy_kwargs=dict(policy_kwargs or {}),
            _init_setup_model=False,
            **kwargs,
        )
        del self.policy_kwargs["use_sde"]  # SB3 adds it; ours stays what the user gave, so that load() can compare the two
        self.encoder_tau = encoder_tau
        self.policy_delay = policy_delay
        self.qf_learning_rate = qf_learning_rate
        self.encoder_learning_rate = encoder_learning_rate
        self.ent_coef_learning_rate = ent_coef_learning_rate
        self.objectives = objectives
        self.augmentation = augmentation
        self.augmentation_kwargs = augmentation_kwargs
        self.image_size = image_size
        self.initial_updates = initial_updates
        self.reward_scale = reward_scale
        self.max_grad_norm = max_grad_norm
        self._env_steps: int | None = None
        if _init_setup_model:
            self._setup_model()

    # -- Set-up --------------------------------------------------------------------------------------------------------

    def _setup_model(self) -> None:
        if self.use_sde or self.optimize_memory_usage:
            refused = "use_sde" if self.use_sde else "optimize_memory_usage"
            raise ValueError(f"{refused}=True is not supported by {type(self).__name__}")
        if self.augmentation not in AUGMENTATIONS:
            nearest = difflib.get_close_matches(str(self.augmentation), AUGMENTATIONS, n=1, cutoff=0)
            raise ValueError(
                f"unknown augmentation {self.augmentation!r}; did you mean {nearest[0]!r}? Known: {', '.join(AUGMENTATIONS)}"
            )
        self._objective_weights = objective_weights(self.objectives)

        own_policy_kwargs = self.policy_kwargs
        encoder_kwargs = {"image_size": self._network_input(), **own_policy_kwargs.get("features_extractor_kwargs", {})}
        self._setup_lr_schedule()
        self.policy_kwargs = {
            **own_policy_kwargs,
            "features_extractor_kwargs": encoder_kwargs,
            "objectives": self.objectives,
            "qf_lr_schedule": self._lr_schedules["qf_learning_rate"],
            "encoder_lr_schedule": self._lr_schedules["encoder_learning_rate"],
        }
        super()._setup_model()
        self.policy_kwargs = own_policy_kwargs

        size = self.policy.critic.features_extractor.input_shape[1:]
        augmentation_kwargs = {"size": size} if self.augmentation.endswith("_crop") else {}
        augmentation_kwargs.update(self.augmentation_kwargs or {})
        self._augmentation = partial(AUGMENTATIONS[self.augmentation], **augmentation_kwargs)
        if self.log_ent_coef is not None:
            self.ent_coef_optimizer = th.optim.Adam([self.log_ent_coef], betas=(0.5, 0.999))  # CURL's, as SAC+AE's

    def _network_input(self) -> ImageSize:
        if self.image_size is not None:
            return self.image_size
        _, height, width = image_shape(self.observation_space)
        ratio = CROP_RATIO if self.augmentation.endswith("_crop") else 1
        return round(ratio * height), round(ratio * width)

    def _setup_lr_schedule(self) -> None:
        self.lr_schedule = lr_schedule(self.learning_rate)
        self._lr_schedules: dict[str, FloatSchedule] = {"learning_rate": self.lr_schedule}
        for name in ("qf_learning_rate", "encoder_learning_rate", "ent_coef_learning_rate"):
            value = getattr(self, name)
            self._lr_schedules[name] = self.lr_schedule if value is None else lr_schedule(value)

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        if policy_name not in self.policy_aliases:
            raise ValueError(
                f"policy {policy_name!r} is not supported: {type(self).__name__} learns from images with 'CnnPolicy'; "
                "for flat observations use stable_baselines3.SAC"
            )
        return super()._get_policy_from_name(policy_name)

    # -- The algorithm -------------------------------------------------------------------------------------------------

    def train(self, gradient_steps: int, batch_size: int = 512) -> None:
        """
        Update encoder, critic, actor, temperature and targets.

        :param gradient_steps: number of updates, to which the first call adds ``initial_updates``
        :param batch_size: transitions per update
        """
        self.policy.set_training_mode(True)
        self._update_learning_rates()
        if self._n_updates == 0:
            gradient_steps += self.initial_updates

        records: dict[str, list[th.Tensor]] = {}
        for _ in range(gradient_steps):
            self._n_updates += 1
            views = self._sample_views(batch_size)
            metrics = self._update_critic_and_encoder(views)
            if self._n_updates % self.policy_delay == 0:
                metrics |= self._update_actor_and_temperature(views)
            if self._n_updates % self.target_update_interval == 0:
                self._update_targets()
            for name, value in metrics.items():
                records.setdefault(name, []).append(value)
        self._record(records)

    def _sample_views(self, batch_size: int) -> Views:
        assert self.replay_buffer is not None
        batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
        encoders = self.critic.features_extractor, self.policy.key_encoder
        return Views(batch, self._augment, *encoders, gamma=self.gamma, reward_scale=self.reward_scale)

    def _augment(self, images: th.Tensor) -> th.Tensor:
        return center_crop(self._augmentation(images), self.critic.features_extractor.input_shape[1:])

    def _update_critic_and_encoder(self, views: Views) -> dict[str, th.Tensor]:
        """Both gradients are taken at the same weights, from one encoding of the anchor; then each Adam steps on its own."""
        critic, optimizer = self.critic, self.policy.encoder_optimizer
        critic_loss = self._critic_loss(views)
        losses = {name: objective(views) for name, objective in self.policy.objectives.items()}
        metrics = {"train/critic_loss": critic_loss}

        critic_parameters = _parameters(critic.optimizer)
        critic_gradients = th.autograd.grad(critic_loss, critic_parameters, retain_graph=bool(losses))
        if optimizer is not None:
            loss = th.stack([self._objective_weights[name] * value for name, value in losses.items()]).sum()
            gradients = th.autograd.grad(loss, _parameters(optimizer), allow_unused=True)
            self._step(optimizer, gradients)
            metrics |= {f"representation/{name}": value for name, value in losses.items()}
            metrics["representation/loss"] = loss
        self._step(critic.optimizer, critic_gradients)
        return metrics

    def _critic_loss(self, views: Views) -> th.Tensor:
        """Twin soft Q loss, 0.5 * sum over the heads of the mean squared Bellman error."""
        with th.no_grad():
            next_actions, next_log_prob = self.actor.view_log_prob(views.bootstrap)
            next_q_values = self.critic_target.q_values(views.bootstrap.key_latent, next_actions)  # (B, n_critics)
            next_values = next_q_values.min(dim=1, keepdim=True).values - self._temperature() * next_log_prob  # (B, 1)
            target_q_values = views.rewards + views.discounts * next_values
        q_values = self.critic.q_values(views.anchor.latent, views.actions)  # (B, n_critics)
        return 0.5 * (q_values - target_q_values).square().mean(dim=0).sum()

    def _update_actor_and_temperature(self, views: Views) -> dict[str, th.Tensor]:
        """Neither encoder nor Q heads receive gradient from the actor loss."""
        actions, log_prob = self.actor.view_log_prob(views.anchor)
        min_q_values = self.critic.q_values(views.anchor.latent.detach(), actions).min(dim=1, keepdim=True).values
        actor_loss = (self._temperature() * log_prob - min_q_values).mean()
        self._step(self.actor.optimizer, th.autograd.grad(actor_loss, _parameters(self.actor.optimizer)))
        metrics = {"train/actor_loss": actor_loss, "train/entropy": -log_prob.mean()}

        if self.ent_coef_optimizer is not None and self.log_ent_coef is not None:
            ent_coef_loss = -(self.log_ent_coef * (log_prob.detach() + float(self.target_entropy))).mean()
            self._step(self.ent_coef_optimizer, th.autograd.grad(ent_coef_loss, [self.log_ent_coef]))
            metrics["train/ent_coef_loss"] = ent_coef_loss
        return metrics | {"train/ent_coef": self._temperature()}

    def _update_targets(self) -> None:
        critic, target = self.critic, self.critic_target
        polyak_update(critic.head_parameters(), target.head_parameters(), self.tau)
        encoder, key_encoder = critic.features_extractor, self.policy.key_encoder
        polyak_update(encoder.parameters(), key_encoder.parameters(), self.encoder_tau)
        polyak_update(critic.buffers(), target.buffers(), 1.0)

    def _temperature(self) -> th.Tensor:
        """The entropy coefficient, shape ``(1,)`` or ``()``, without gradient."""
        return self.ent_coef_tensor if self.log_ent_coef is None else self.log_ent_coef.detach().exp()

    def _step(self, optimizer: th.optim.Optimizer, gradients: tuple[th.Tensor | None, ...]) -> None:
        parameters = _parameters(optimizer)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        if self.max_grad_norm is not None:
            th.nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
        optimizer.step()
        optimizer.zero_grad()

    # -- Around it -----------------------------------------------------------------------------------------------------

    def _update_learning_rates(self) -> None:
        optimizers = {
            "learning_rate": self.actor.optimizer,
            "qf_learning_rate": self.critic.optimizer,
            "encoder_learning_rate": self.policy.encoder_optimizer,
            "ent_coef_learning_rate": self.ent_coef_optimizer,
        }
        for name, optimizer in optimizers.items():
            if optimizer is not None:
                value = self._lr_schedules[name](self._current_progress_remaining)
                update_learning_rate(optimizer, value)
                self.logger.record(f"train/{name}", value)

    def _record(self, records: dict[str, list[th.Tensor]]) -> None:
        """Log the means over one call of :meth:`train`, with a single transfer from the device."""
        means = th.stack([th.stack([value.detach().reshape(()) for value in values]).mean() for values in records.values()])
        for name, mean in zip(records, means.tolist(), strict=True):
            self.logger.record(name, mean)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        super()._update_info_buffer(infos, dones)
        if all("env_steps" in info for info in infos):
            self._env_steps = sum(info["env_steps"] for info in infos)

    def dump_logs(self) -> None:
        """Write the log; ``time/env_steps`` counts the simulator's steps, ``time/total_timesteps`` the agent's decisions."""
        if self._env_steps is not None:
            self.logger.record("time/env_steps", self._env_steps)
        super().dump_logs()

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "CRCSAC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """As in SB3; ``total_timesteps`` are agent steps, each of ``action_repeat`` environment steps."""
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_lr_schedules", "_augmentation", "_objective_weights"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        if self.policy.encoder_optimizer is not None:
            state_dicts = [*state_dicts, "policy.encoder_optimizer"]
        return state_dicts, variables


def lr_schedule(learning_rate: LearningRate) -> FloatSchedule:
    """
    :param learning_rate: a number, a schedule of the remaining progress, or ``"lin_x"``: from x down to 0
    :raises ValueError: for any other string
    """
    if isinstance(learning_rate, str):
        kind, _, start = learning_rate.partition("_")
        try:
            value = float(start)
        except ValueError:
            kind = "unknown"
        if kind != "lin":
            raise ValueError(f"unknown learning rate {learning_rate!r}; expected a number, a schedule or 'lin_x', x a number")
        return FloatSchedule(LinearSchedule(value, 0.0, 1.0))
    return FloatSchedule(learning_rate)


def _parameters(optimizer: th.optim.Optimizer) -> list[th.Tensor]:
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]
