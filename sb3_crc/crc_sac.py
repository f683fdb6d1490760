"""CRC-RL as a Stable-Baselines3 algorithm.

B batch, Z latent, A action.
"""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import torch as th
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import polyak_update

from sb3_crc.augmentations import AUGMENTATIONS, ImageSize, augmented_input, takes_size
from sb3_crc.base_sac import BaseCRCSAC, check_arguments
from sb3_crc.buffers import FrameReplayBuffer
from sb3_crc.convolutions import PRECISIONS, set_precision
from sb3_crc.finite import LossHistory, checked_step, parameters_of
from sb3_crc.gradients import gradients_of
from sb3_crc.image_spaces import image_shape, image_space
from sb3_crc.memory import largest_that_fits, named_shortage
from sb3_crc.objectives import ObjectiveSettings, objective_weights, reads_next
from sb3_crc.policies import CRCPolicy
from sb3_crc.presets import PRESETS
from sb3_crc.representation import AuxiliaryGradients, auxiliary_gradients
from sb3_crc.schedules import LearningRate
from sb3_crc.settings import check_name, check_ranges
from sb3_crc.views import View, Views

#: Side of the network's input over that of the frame, where crops are cut: 84 of 100 pixels (RAD, CURL, CRC-RL).
CROP_RATIO = 0.84

#: Argument -> what it may be
CHOICES = {
    "augmentation": AUGMENTATIONS,
    "anchor": ("augmented", "center_crop"),
    "balance": ("none", "grad_norm"),
    "precision": tuple(PRECISIONS),
    "replay_device": ("auto", "model", "cpu"),
    "on_nonfinite": ("stop", "skip"),
}


class CRCSAC(BaseCRCSAC):
    """
    SAC whose every gradient step also trains the shared CNN with weighted auxiliary objectives, by default the three of
    CRC-RL: contrastive, reconstruction, consistency (arXiv 2301.13473).

    Arguments that are not listed are those of :class:`stable_baselines3.SAC`, with its defaults.

    :param policy: ``"CnnPolicy"``, for Dict observations ``"MultiInputPolicy"``, or a subclass of :class:`~sb3_crc.CRCPolicy`
    :param env: environment with continuous actions and channel-first or -last uint8 images, or Dict observations with one such
        image, to whose latent the vectors beside it are joined; or the environment's id
    :param learning_rate: of the actor; a number, a schedule, ``"lin_x"`` (from x down to 0), ``"lin_x_f"`` (0 from share f on)
    :param buffer_size: capacity of the replay buffer, in agent steps
    :param learning_starts: agent steps with random actions before the first update
    :param batch_size: transitions per update
    :param tau: rate at which the target Q heads follow, per target update
    :param encoder_tau: rate at which the key encoder (which is also the target encoder) follows, per target update
    :param target_update_interval: updates between two target updates
    :param policy_delay: updates between two updates of actor and temperature
    :param ent_coef: temperature, as in SAC
    :param qf_learning_rate: of Q heads and encoder under the critic loss; None: ``learning_rate``
    :param encoder_learning_rate: of encoder and objectives under the auxiliary losses, which rest while it is 0 (but not with
        ``joint_update``); None: ``learning_rate``
    :param ent_coef_learning_rate: of the temperature; None: ``learning_rate``
    :param objectives: name -> weight, or name -> ``{"weight": w, **settings}``; ``{}``: no auxiliary losses
    :param augmentation: name in :data:`~sb3_crc.augmentations.AUGMENTATIONS`
    :param augmentation_kwargs: its arguments
    :param objective_augmentation: as ``augmentation``, of what the objectives alone see of o_t instead of the view that critic
        and actor see (SODA's strong view, arXiv 2011.13389); one more pass through the encoder. None: they see the same
    :param objective_augmentation_kwargs: its arguments
    :param image_size: side of the network's input in pixels, or (height, width); None: 84 % of the frame for crops,
        the whole frame for other augmentations
    :param q_augmentations: M: the critic loss is averaged over so many augmentations of o_t (DrQ, arXiv 2004.13649, eq. 3)
    :param target_augmentations: K: the Q targets are averaged over so many augmentations of o_{t+n} (DrQ, eq. 1)
    :param anchor: ``"augmented"``, or ``"center_crop"``: critic, actor, query, s and decoder see the middle of the frame (the
        literal reading of the paper's consistency section; an ablation)
    :param balance: ``"grad_norm"`` divides each objective by a moving average of its gradient norm at the latent before
        weighting; ``"none"`` does not
    :param auxiliary_interval: updates between two steps of the objectives (SAC+AE's decoder update frequency)
    :param joint_update: one pass through the encoder and one optimizer for the sum of critic loss and objectives: faster, but
        here absolute weights matter, and a critic loss that grows with Q can swamp the objectives
    :param reencode: step the critic first, then encode the anchor anew for objectives and actor (CURL, the released code of
        CRC-RL); slower
    :param initial_updates: extra updates, made once, with the first ones
    :param reward_scale: factor on the rewards of sampled transitions
    :param max_grad_norm: clip each optimizer's gradient to this norm; None: never
    :param precision: in which convolutions compute, ``"float32"`` or ``"bfloat16"``; everything else is float32
    :param compile: on a GPU, record the work of an update once and replay it (:mod:`~sb3_crc.recording`); on a CPU, nothing
    :param replay_device: where frames are kept: ``"auto"``: beside the networks if they fit there, else in the host's memory;
        ``"model"``: beside the networks; ``"cpu"``
    :param overlap: make the update that follows a step while the environments step (:mod:`~sb3_crc.overlap`), with the same
        results; callbacks see the networks of after it within a step. For SubprocVecEnv, with a GPU or an idle core
    :param on_nonfinite: what a loss, gradient, reward or observation that is not finite does. Adam never steps on one.
        ``"stop"``: a FloatingPointError names it, and what led to it is saved; ``"skip"``: training goes on, and counts them
    :raises ValueError: for observations or settings that cannot work, naming the value and what is allowed
    """

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
        objective_augmentation: str | None = None,
        objective_augmentation_kwargs: Mapping[str, Any] | None = None,
        image_size: ImageSize | None = None,
        q_augmentations: int = 1,
        target_augmentations: int = 1,
        anchor: str = "augmented",
        balance: str = "none",
        auxiliary_interval: int = 1,
        joint_update: bool = False,
        reencode: bool = False,
        initial_updates: int = 0,
        reward_scale: float = 1.0,
        max_grad_norm: float | None = None,
        precision: str = "float32",
        compile: bool = False,
        replay_device: str = "auto",
        overlap: bool = False,
        on_nonfinite: str = "stop",
        policy_kwargs: dict[str, Any] | None = None,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ):
        check_arguments(type(self), kwargs, policy_kwargs or {})
        super().__init__(
            # A class, since for the name SB3 would send users of Dict observations to a policy that is not ours
            self._get_policy_from_name(policy) if isinstance(policy, str) else policy,  # type: ignore[arg-type]
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
        self._check_policy_name(policy)
        del self.policy_kwargs["use_sde"]  # SB3 adds it; ours stays what the user gave, so that load() can compare the two
        self.encoder_tau = encoder_tau
        self.policy_delay = policy_delay
        self.qf_learning_rate = qf_learning_rate
        self.encoder_learning_rate = encoder_learning_rate
        self.ent_coef_learning_rate = ent_coef_learning_rate
        self.objectives = objectives
        self.augmentation = augmentation
        self.augmentation_kwargs = augmentation_kwargs
        self.objective_augmentation = objective_augmentation
        self.objective_augmentation_kwargs = objective_augmentation_kwargs
        self.image_size = image_size
        self.q_augmentations = q_augmentations
        self.target_augmentations = target_augmentations
        self.anchor = anchor
        self.balance = balance
        self.auxiliary_interval = auxiliary_interval
        self.joint_update = joint_update
        self.reencode = reencode
        self.initial_updates = initial_updates
        self.reward_scale = reward_scale
        self.max_grad_norm = max_grad_norm
        self.precision = precision
        self.compile = compile
        self.replay_device = replay_device
        self.overlap = overlap
        self.on_nonfinite = on_nonfinite
        if _init_setup_model:
            self._setup_model()

    # -- Set-up --------------------------------------------------------------------------------------------------------

    def _setup_model(self) -> None:
        if self.use_sde or self.optimize_memory_usage:
            refused = "use_sde" if self.use_sde else "optimize_memory_usage"
            raise ValueError(f"{refused}=True is not supported by {type(self).__name__}")
        shape = image_shape(image_space(self.observation_space))
        check_ranges(self)
        if self.objective_augmentation is not None:
            check_name("objective_augmentation", self.objective_augmentation, AUGMENTATIONS)
        for name, known in CHOICES.items():
            check_name(name, getattr(self, name), known)
        if self.joint_update and self.reencode:
            raise ValueError("joint_update and reencode exclude each other: one encoding for both gradients, or one for each")
        self._objective_weights = objective_weights(self.objectives)

        own_policy_kwargs = self.policy_kwargs
        own_kwargs = own_policy_kwargs.get("features_extractor_kwargs", {})
        encoder_kwargs = {"image_size": self._network_input(), **self._frames_of(own_kwargs), **own_kwargs}
        self._setup_lr_schedule()
        self.policy_kwargs = {
            **own_policy_kwargs,
            "features_extractor_kwargs": encoder_kwargs,
            "objectives": self.objectives,
            "joint_update": self.joint_update,
            "qf_lr_schedule": self._lr_schedules["qf_learning_rate"],
            "encoder_lr_schedule": self._lr_schedules["encoder_learning_rate"],
        }
        super()._setup_model()
        self.policy_kwargs = own_policy_kwargs
        set_precision(self.policy, self.precision)
        self._reads_next = reads_next(self.policy.objectives, self.replay_buffer)

        size = self.policy.critic.features_extractor.input_shape[1:]
        self._augment = augmented_input(self.augmentation, self.augmentation_kwargs, shape, size)
        own = self.objective_augmentation
        self._augment_query = None if own is None else augmented_input(own, self.objective_augmentation_kwargs, shape, size)
        if self.log_ent_coef is not None:
            self.ent_coef_optimizer = th.optim.Adam([self.log_ent_coef], betas=(0.5, 0.999), fused=True)  # CURL's
        self._set_up_recording()

    def _network_input(self) -> ImageSize:
        if self.image_size is not None:
            return self.image_size
        _, height, width = image_shape(image_space(self.observation_space))
        ratio = CROP_RATIO if takes_size(self.augmentation) else 1
        return round(ratio * height), round(ratio * width)

    # -- The algorithm -------------------------------------------------------------------------------------------------

    def train(self, gradient_steps: int, batch_size: int = 512) -> None:
        """
        Update encoder, critic, actor, temperature and targets.

        :param gradient_steps: number of updates, to which the first call adds ``initial_updates``
        :param batch_size: transitions per update
        """
        if not self._has_batch(batch_size):
            return  # a model that was loaded without its replay buffer acts until a batch is stored
        if self._n_updates == 0:
            gradient_steps += self.initial_updates
        history = self._begin_updates()
        for _ in range(gradient_steps - len(history.updates)):
            self._make_update(history, batch_size)
        self._record(history, batch_size)

    def _make_update(self, history: LossHistory, batch_size: int) -> None:
        """One update by one batch."""
        self.between_updates()
        self._n_updates += 1
        metrics = history.begin()
        with named_shortage() as shortage:
            views = self._sample_views(batch_size)
            metrics |= self._update(views) if self._recorded is None else self._replayed(views)
        if shortage:
            views = None  # type: ignore[assignment]  # gives its memory back
            raise MemoryError(self._what_fits(batch_size, shortage[0]))

    def _update(self, views: Views) -> dict[str, th.Tensor]:
        with self._instruments(views) as health:
            metrics = self._update_critic_and_encoder(views)
        metrics |= health
        if self._n_updates % self.policy_delay == 0:
            metrics |= self._update_actor_and_temperature(views)
        if self._n_updates % self.target_update_interval == 0:
            self._update_targets()
        return metrics

    def _sample_views(self, batch_size: int) -> Views:
        assert self.replay_buffer is not None
        buffer, normalize = self.replay_buffer, self._vec_normalize_env
        sample = buffer.sample_frames if isinstance(buffer, FrameReplayBuffer) else buffer.sample
        batch = sample(batch_size, env=normalize)
        return Views(
            batch,
            self._augment,
            self.critic.features_extractor,
            self.policy.key_encoder,
            gamma=self.gamma,
            reward_scale=self.reward_scale,
            augment_anchor=self.anchor == "augmented",
            n_anchors=self.q_augmentations,
            n_bootstraps=self.target_augmentations,
            offers_next=self._reads_next,
            augment_query=self._augment_query,
        )

    def _update_critic_and_encoder(self, views: Views) -> dict[str, th.Tensor]:
        """
        Train encoder, Q heads and objectives on the anchor's one encoding.

        By default both gradients are taken at the same weights, and then each Adam steps on its own. ``joint_update`` sums
        them at the latent for one pass through the encoder and one Adam; ``reencode`` steps the critic before the objectives
        look.
        """
        anchors, encoder = views.anchors, list(self.critic.features_extractor.parameters())
        critic_loss = self._critic_loss(views)
        latents = [anchor.latent for anchor in anchors]
        gradients = gradients_of([critic_loss], [*latents, *self.critic.head_parameters()])
        td_gradients, head_gradients = cast("tuple[th.Tensor, ...]", gradients[: len(latents)]), gradients[len(latents) :]
        metrics = {"train/critic_loss": critic_loss.detach()}
        optimizer = self.policy.encoder_optimizer if self._objectives_due() else None
        if optimizer is None or self.reencode:
            metrics |= self._step("critic", self.critic.optimizer, [*views.backward(td_gradients, encoder), *head_gradients])
        if self.reencode:
            views.forget_encodings()
        if optimizer is None:
            return metrics

        auxiliary = self._auxiliary_gradients(views, td_gradients[0])
        metrics |= auxiliary.metrics
        if self.joint_update:
            critic_gradients = views.backward(td_gradients, encoder, auxiliary.leaves)
            metrics |= self._step("critic", self.critic.optimizer, [*critic_gradients, *head_gradients])
            metrics |= self._step("encoder", optimizer, auxiliary.own)
        else:
            if not self.reencode:
                critic_gradients = views.backward(td_gradients, encoder, retain_graph=True)
            encoder_gradients = views.query.backward(auxiliary.leaves, encoder)
            if not self.reencode:
                metrics |= self._step("critic", self.critic.optimizer, [*critic_gradients, *head_gradients])
            metrics |= self._step("encoder", optimizer, [*encoder_gradients, *auxiliary.own])
        if self.reencode:
            views.forget_encodings()
        return metrics

    def _what_fits(self, batch_size: int, reason: str) -> str:
        def attempt(size: int) -> None:
            views = self._sample_views(size)
            latents = [anchor.latent for anchor in views.anchors]
            gradients = th.autograd.grad(self._critic_loss(views), latents)
            leaves = self._auxiliary_gradients(views, gradients[0]).leaves
            views.backward(gradients, list(self.critic.features_extractor.parameters()), leaves)

        fits = largest_that_fits(attempt, batch_size)
        hint = f"batch_size={fits} fits" if fits else "no smaller one fits either: the networks or frames are too large"
        return f"batch_size={batch_size} does not fit into the memory of {self.device} ({reason}); {hint}"

    def _auxiliary_gradients(self, views: Views, td_gradient: th.Tensor) -> AuxiliaryGradients:
        policy, balance = self.policy, self.balance == "grad_norm"
        weights: Mapping[str, float | th.Tensor] = self._weight_tensors or self._objective_weights
        return auxiliary_gradients(policy.objectives, weights, views, td_gradient, policy.gradient_norms, balance=balance)

    def _critic_loss(self, views: Views) -> th.Tensor:
        """Twin soft Q loss, 0.5 * sum over the heads of the mean squared Bellman error, averaged as DrQ does."""
        next_values = th.stack([self._next_values(bootstrap) for bootstrap in views.bootstraps]).mean(dim=0)  # (B, 1)
        target_q_values = views.rewards + views.discounts * next_values
        losses = []
        for anchor in views.anchors:
            q_values = self.critic.q_values(anchor.latent, views.actions, anchor.proprioception)  # (B, n_critics)
            losses.append(0.5 * (q_values - target_q_values).square().mean(dim=0).sum())
        return th.stack(losses).mean()

    @th.no_grad()
    def _next_values(self, bootstrap: View) -> th.Tensor:
        """Soft values by the target heads, ``(B, 1)``."""
        next_actions, next_log_prob = self.actor.view_log_prob(bootstrap)
        next_q_values = self.critic_target.q_values(bootstrap.key_latent, next_actions, bootstrap.proprioception)
        return next_q_values.min(dim=1, keepdim=True).values - self._temperature() * next_log_prob

    def _update_actor_and_temperature(self, views: Views) -> dict[str, th.Tensor]:
        """Neither encoder nor Q heads receive gradient from the actor loss."""
        anchor = views.anchor
        actions, log_prob = self.actor.view_log_prob(anchor)
        q_values = self.critic.q_values(anchor.latent.detach(), actions, anchor.proprioception)  # (B, n_critics)
        actor_loss = (self._temperature() * log_prob - q_values.min(dim=1, keepdim=True).values).mean()
        metrics = {"train/actor_loss": actor_loss.detach(), "train/entropy": -log_prob.detach().mean()}
        optimizer = self.actor.optimizer
        metrics |= self._step("actor", optimizer, gradients_of([actor_loss], parameters_of(optimizer)))

        if self.ent_coef_optimizer is not None and self.log_ent_coef is not None:
            ent_coef_loss = -(self.log_ent_coef * (log_prob.detach() + float(self.target_entropy))).mean()
            metrics["train/ent_coef_loss"] = ent_coef_loss.detach()
            metrics |= self._step("ent_coef", self.ent_coef_optimizer, th.autograd.grad(ent_coef_loss, [self.log_ent_coef]))
        return metrics | {"train/ent_coef": self._temperature()}

    def _update_targets(self) -> None:
        critic, target = self.critic, self.critic_target
        polyak_update(critic.head_parameters(), target.head_parameters(), self.tau)
        encoder, key_encoder = critic.features_extractor, self.policy.key_encoder
        polyak_update(encoder.parameters(), key_encoder.parameters(), self.encoder_tau)
        for buffer, target_buffer in zip(critic.buffers(), target.buffers(), strict=True):
            target_buffer.copy_(buffer)

    def _temperature(self) -> th.Tensor:
        """The entropy coefficient, shape ``(1,)`` or ``()``, without gradient."""
        return self.ent_coef_tensor if self.log_ent_coef is None else self.log_ent_coef.detach().exp()

    def _step(self, name: str, optimizer: th.optim.Optimizer, gradients: Sequence[th.Tensor | None]) -> dict[str, th.Tensor]:
        if not gradients:  # joint_update with objectives that have no parameters
            return {}
        return {f"train/{name}_gradient_norm": checked_step(optimizer, gradients, self.max_grad_norm)}
