"""Who owns, shares and detaches which weights.

B batch, F flattened convolution output, Z latent, P proprioception, A action.

======================== ============================ ================================ ========================
weights                  trained by                   gradient of                      followed by
======================== ============================ ================================ ========================
encoder                  critic.optimizer and         critic loss; objectives          key_encoder, encoder_tau
                         encoder_optimizer
Q heads                  critic.optimizer             critic loss                      target heads, tau
objectives               encoder_optimizer            objectives
actor (own projection    actor.optimizer              actor loss
and heads)
======================== ============================ ================================ ========================

Of Dict observations the image is encoded, and proprioception (the vectors beside it) joins the latent at the heads.
"""

import math
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch import nn
from typing_extensions import Self

from sb3_crc.encoder import PixelEncoder, init_orthogonal, latent_projection
from sb3_crc.image_spaces import as_bytes, proprioception_dim, split_observations
from sb3_crc.objectives import ObjectiveSettings, build_objectives
from sb3_crc.settings import check_name, is_count
from sb3_crc.views import View

ACTOR_FEATURES = ("conv", "latent")


class SquashedGaussian(SquashedDiagGaussianDistribution):
    """SB3's squashed Gaussian without torch's checks of its arguments, each of which would wait for the device."""

    def proba_distribution(self, mean_actions: th.Tensor, log_std: th.Tensor) -> Self:
        """:param mean_actions: ``(B, A)``; :param log_std: ``(B, A)``; :return: itself"""
        self.distribution = th.distributions.Normal(mean_actions, log_std.exp(), validate_args=False)
        return self


class CRCActor(Actor):
    """
    SAC's actor on detached features of the shared encoder.

    :param actor_features: ``"conv"``: the convolutions' output through a projection of the actor's own (CURL, SAC+AE, DrQ);
        ``"latent"``: the encoder's latent
    :param log_std_bounds: the log standard deviation is squashed into them by a tanh
    :param layer_norm: LayerNorm before each activation of the heads
    """

    features_extractor: PixelEncoder

    def __init__(
        self,
        *args: Any,
        actor_features: str = "conv",
        log_std_bounds: tuple[float, float] = (-10, 2),
        layer_norm: bool = False,
        **kwargs: Any,
    ):
        super().__init__(*args, **kwargs)
        encoder = self.features_extractor
        self.action_dist = SquashedGaussian(get_action_dim(self.action_space))  # type: ignore[assignment]
        self.actor_features = actor_features
        self.log_std_bounds = log_std_bounds
        self.projection: nn.Module = nn.Identity()
        if actor_features == "conv":
            self.projection = latent_projection(encoder.convolution_dim, self.features_dim, encoder.latent_activation)
        inputs = self.features_dim + proprioception_dim(self.observation_space)
        self.latent_pi = _heads_mlp(inputs, -1, self.net_arch, self.activation_fn, layer_norm)
        if not self.net_arch and inputs != self.features_dim:  # SB3's were made for the latent alone
            self.mu = nn.Linear(inputs, get_action_dim(self.action_space))
            self.log_std = nn.Linear(inputs, get_action_dim(self.action_space))  # type: ignore[assignment]
        for module in self.own_modules():
            module.apply(init_orthogonal)

    def own_modules(self) -> list[nn.Module]:
        """Everything but the shared encoder."""
        assert isinstance(self.log_std, nn.Linear)
        return [self.projection, self.latent_pi, self.mu, self.log_std]

    def own_parameters(self) -> list[nn.Parameter]:
        """What the actor loss trains."""
        return [parameter for module in self.own_modules() for parameter in module.parameters()]

    def get_action_dist_params(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor, dict[str, th.Tensor]]:
        """:param obs: images ``(B, C, H, W)``, 0 to 255, or a mapping with them; :return: mean, log std ``(B, A)``, and {}"""
        obs = as_bytes(obs, self.observation_space)
        with th.no_grad():  # the encoder is not the actor's to train
            features = self.features_extractor.convolve(obs)
            if self.actor_features == "latent":
                features = self.features_extractor.project(features)
        _, proprioception = split_observations(obs, self.observation_space)
        mean_actions, log_std = self._dist_params(features, proprioception)
        return mean_actions, log_std, {}

    def view_log_prob(self, view: View) -> tuple[th.Tensor, th.Tensor]:
        """
        Sample actions for a view whose encoding is shared with the critic and the objectives.

        :return: actions ``(B, A)`` and their log probabilities ``(B, 1)``, with gradient to the actor's own weights only
        """
        features = view.features if self.actor_features == "conv" else view.latent
        assert isinstance(self.action_dist, SquashedDiagGaussianDistribution)
        actions, log_prob = self.action_dist.log_prob_from_params(*self._dist_params(features.detach(), view.proprioception))
        return actions, log_prob.unsqueeze(1)

    def _dist_params(self, features: th.Tensor, proprioception: th.Tensor | None) -> tuple[th.Tensor, th.Tensor]:
        latent_pi = self.latent_pi(_beside(self.projection(features), proprioception))
        low, high = self.log_std_bounds
        assert isinstance(self.log_std, nn.Linear)
        log_std = low + 0.5 * (high - low) * (th.tanh(self.log_std(latent_pi)) + 1)
        return self.mu(latent_pi), log_std


class CRCCritic(ContinuousCritic):
    """
    Q networks on the encoder's latent; called with images, it is SB3's ContinuousCritic with gradient to the encoder.

    :param layer_norm: LayerNorm before each activation of the heads
    """

    features_extractor: PixelEncoder

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.ReLU,
        normalize_images: bool = True,
        n_critics: int = 2,
        share_features_extractor: bool = True,
        *,
        layer_norm: bool = False,
    ):
        # SB3's own heads are built empty and replaced: create_mlp's LayerNorm cannot be asked for from outside.
        # To SB3, "share" means that the critic must not train the encoder: here it must.
        super().__init__(
            observation_space,
            action_space,
            [],
            features_extractor,
            features_dim,
            activation_fn,
            normalize_images,
            n_critics,
            share_features_extractor=False,
        )
        self.q_networks = []
        for index in range(n_critics):
            inputs = features_dim + proprioception_dim(observation_space) + get_action_dim(action_space)
            head = _heads_mlp(inputs, 1, net_arch, activation_fn, layer_norm).apply(init_orthogonal)
            self.add_module(f"qf{index}", head)
            self.q_networks.append(head)

    def extract_features(self, obs: PyTorchObs, features_extractor: BaseFeaturesExtractor) -> th.Tensor:
        """:param obs: images ``(B, C, H, W)``, 0 to 255, or a mapping with them; :return: what heads see, ``(B, Z + P)``"""
        obs = as_bytes(obs, self.observation_space)
        return _beside(features_extractor(obs), split_observations(obs, self.observation_space)[1])

    def q_values(self, latents: th.Tensor, actions: th.Tensor, proprioception: th.Tensor | None = None) -> th.Tensor:
        """
        :param latents: ``(B, Z)``
        :param actions: ``(B, A)``
        :param proprioception: ``(B, P)``; None for observations that are an image alone
        :return: ``(B, n_critics)``
        """
        inputs = th.cat([_beside(latents, proprioception), actions], dim=1)
        return th.cat([head(inputs) for head in self.q_networks], dim=1)

    def head_parameters(self) -> list[nn.Parameter]:
        """The weights of the Q networks, without the encoder."""
        return [parameter for head in self.q_networks for parameter in head.parameters()]


class CRCPolicy(SACPolicy):
    """
    SAC's policy with one encoder for critic, actor and objectives, and its moving average as target and key encoder.

    :param observation_space: channel-first uint8 images, or a Dict with one such image and vectors
    :param action_space: a Box
    :param lr_schedule: of the actor
    :param net_arch: hidden layers of the heads, as in SB3; default ``[1024, 1024]`` (CRC-RL)
    :param features_extractor_class: :class:`PixelEncoder` or a subclass
    :param features_extractor_kwargs: arguments of the encoder
    :param objectives: name -> weight, or name -> ``{"weight": w, **settings}``
    :param qf_lr_schedule: of Q heads and encoder under the critic loss; None: ``lr_schedule``
    :param encoder_lr_schedule: of encoder and objectives under the auxiliary losses; None: ``lr_schedule``
    :param actor_features: see :class:`CRCActor`
    :param log_std_bounds: see :class:`CRCActor`
    :param layer_norm: LayerNorm before each activation of actor and Q heads
    :param encoder_steps: how many equal Adam steps the auxiliary gradient takes on the encoder; the released code of CRC-RL
        makes three, with three optimizers, which move the encoder exactly as one does at three times the rate; for
        comparison only
    :param joint_update: leave the encoder to ``critic.optimizer`` alone (see CRCSAC)
    :raises ValueError: for what cannot work: gSDE, unscaled images, an encoder that is not a PixelEncoder, ...
    """

    actor: CRCActor
    critic: CRCCritic
    critic_target: CRCCritic
    key_encoder: PixelEncoder
    objectives: nn.ModuleDict
    encoder_optimizer: th.optim.Optimizer | None
    gradient_norms: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        use_sde: bool = False,
        features_extractor_class: type[BaseFeaturesExtractor] = PixelEncoder,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        n_critics: int = 2,
        *,
        objectives: ObjectiveSettings | None = None,
        qf_lr_schedule: Schedule | None = None,
        encoder_lr_schedule: Schedule | None = None,
        actor_features: str = "conv",
        log_std_bounds: tuple[float, float] = (-10, 2),
        layer_norm: bool = False,
        encoder_steps: int = 1,
        joint_update: bool = False,
    ):
        if use_sde:
            raise ValueError("use_sde=True is not supported: gSDE would need exploration noise on the shared features")
        if not normalize_images:
            raise ValueError("normalize_images=False is not supported: the encoder takes bytes and scales them itself")
        if not (isinstance(features_extractor_class, type) and issubclass(features_extractor_class, PixelEncoder)):
            given = getattr(features_extractor_class, "__name__", repr(features_extractor_class))
            raise ValueError(f"features_extractor_class must be a PixelEncoder, the class or one derived from it, got {given}")
        if not callable(activation_fn) or isinstance(activation_fn, nn.Module):
            raise ValueError(f"activation_fn={activation_fn!r} must be a class of modules, such as torch.nn.ReLU")
        for name, number in (("n_critics", n_critics), ("encoder_steps", encoder_steps)):
            if not is_count(number):
                raise ValueError(f"{name}={number!r} must be an integer, at least 1")
        check_name("actor_features", actor_features, ACTOR_FEATURES)
        low, high = log_std_bounds
        if not -math.inf < low < high < math.inf:
            raise ValueError(f"log_std_bounds={tuple(log_std_bounds)} must be two finite numbers, the first below the second")
        self._own_kwargs: dict[str, Any] = {
            "objectives": objectives or {},
            "actor_features": actor_features,
            "log_std_bounds": tuple(log_std_bounds),
            "layer_norm": layer_norm,
            "encoder_steps": encoder_steps,
            "joint_update": joint_update,
        }
        self._schedules = qf_lr_schedule or lr_schedule, encoder_lr_schedule or lr_schedule
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            [1024, 1024] if net_arch is None else net_arch,
            activation_fn,
            features_extractor_class=features_extractor_class,
            features_extractor_kwargs=features_extractor_kwargs,
            normalize_images=normalize_images,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            n_critics=n_critics,
            share_features_extractor=True,
        )

    def _build(self, lr_schedule: Schedule) -> None:
        qf_lr_schedule, encoder_lr_schedule = self._schedules
        self.critic = self.make_critic()
        encoder = self.critic.features_extractor
        self.actor = self.make_actor(encoder)
        self.objectives = build_objectives(self._own_kwargs["objectives"], encoder, get_action_dim(self.action_space))

        # Copies come last, so that they start equal to what they follow (the release re-initialises the encoder after)
        self.critic_target = self.make_critic()
        self.critic_target.load_state_dict(self.critic.state_dict())
        self.critic_target.requires_grad_(False)
        self.critic_target.set_training_mode(False)
        self.key_encoder = self.critic_target.features_extractor

        self.actor.optimizer = self._optimizer(self.actor.own_parameters(), lr_schedule)
        self.critic.optimizer = self._optimizer([*encoder.parameters(), *self.critic.head_parameters()], qf_lr_schedule)
        self.encoder_optimizer = None
        if self.objectives:
            groups: list[dict[str, Any]] = [{"params": list(self.objectives.parameters()), "lr_factor": 1}]
            if not self._own_kwargs["joint_update"]:
                steps = self._own_kwargs["encoder_steps"]
                groups.insert(0, {"params": list(encoder.parameters()), "lr_factor": steps})
            self.encoder_optimizer = self._optimizer(groups, encoder_lr_schedule)
        #: Moving average of each objective's gradient norm at the latent, 0 before the first update
        self.register_buffer("gradient_norms", th.zeros(len(self.objectives)))

    def _optimizer(self, parameters: Any, lr_schedule: Schedule) -> th.optim.Optimizer:
        kwargs: dict[str, Any] = self.optimizer_kwargs
        if issubclass(self.optimizer_class, th.optim.Adam) and not {"foreach", "fused", "capturable"} & kwargs.keys():
            kwargs = {**kwargs, "fused": True}  # one pass over the weights, not ten
        return self.optimizer_class(parameters, lr=lr_schedule(1), **kwargs)  # type: ignore[call-arg]

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> CRCActor:
        """:return: an actor on ``features_extractor``"""
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        own = {key: self._own_kwargs[key] for key in ("actor_features", "log_std_bounds", "layer_norm")}
        return CRCActor(**kwargs, **own).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> CRCCritic:
        """:return: Q networks on ``features_extractor``, or on a new encoder"""
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return CRCCritic(**kwargs, layer_norm=self._own_kwargs["layer_norm"]).to(self.device)

    def set_training_mode(self, mode: bool) -> None:
        """Switch online networks and objectives; target heads and key encoder stay in evaluation mode."""
        super().set_training_mode(mode)
        self.objectives.train(mode)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        for fixed in ("use_sde", "log_std_init", "use_expln", "clip_mean"):
            del data[fixed]
        return {**data, **self._own_kwargs}


def _beside(latents: th.Tensor, proprioception: th.Tensor | None) -> th.Tensor:
    return latents if proprioception is None else th.cat([latents, proprioception], dim=1)


def _heads_mlp(
    input_dim: int, output_dim: int, net_arch: list[int], activation_fn: type[nn.Module], layer_norm: bool
) -> nn.Sequential:
    modules = create_mlp(input_dim, output_dim, net_arch, activation_fn, post_linear_modules=[nn.LayerNorm] * layer_norm)
    return nn.Sequential(*modules)
