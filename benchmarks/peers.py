"""What sb3_crc is measured against: stock SB3 SAC with the same networks, and CRC-RL as a textbook would write it.

B batch, C channels (of the whole frame stack), H, W image height and width, Z latent.
"""

from collections.abc import Callable
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import polyak_update
from torch import nn
from torch.nn import functional as F

from benchmarks.networks import EPISODE, Networks, NoiseFrames


class PlainEncoder(BaseFeaturesExtractor):
    """
    The networks' encoder as one writes it for SB3, in torch's default layout.

    :param observation_space: channel-first images
    :param channels_last: ask torch for its faster layout
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        features_dim: int = 50,
        *,
        channels: tuple[int, ...] = (32, 32, 32, 32),
        strides: tuple[int, ...] = (2, 1, 1, 1),
        latent_activation: str = "none",
        channels_last: bool = False,
        **_: Any,
    ):
        super().__init__(observation_space, features_dim)
        layers: list[nn.Module] = []
        for c_in, c_out, stride in zip((observation_space.shape[0], *channels), channels, strides, strict=False):
            layers += [nn.Conv2d(c_in, c_out, 3, stride), nn.ReLU()]
        self.convolutions = nn.Sequential(*layers)
        self.channels_last = channels_last
        if channels_last:
            self.convolutions.to(memory_format=th.channels_last)
        size = self.convolutions(th.zeros(1, *observation_space.shape)).numel()
        activation = nn.Tanh() if latent_activation == "tanh" else nn.Identity()
        self.projection = nn.Sequential(nn.Linear(size, features_dim), nn.LayerNorm(features_dim), activation)

    def forward(self, images: th.Tensor) -> th.Tensor:
        """:param images: ``(B, C, H, W)``, floats in [0, 1]; :return: latents ``(B, Z)``"""
        if self.channels_last:
            images = images.contiguous(memory_format=th.channels_last)
        latents: th.Tensor = self.projection(self.convolutions(images).flatten(1))
        return latents


def stock_sac(networks: Networks, batch_size: int, *, channels_last: bool = False, device: str = "cpu") -> SAC:
    """:return: SB3's SAC with these networks, ready to be trained on batches of noise"""
    steps = batch_size + EPISODE
    return SAC(
        "CnnPolicy",
        NoiseFrames(networks.input_size),
        learning_rate=1e-3,
        batch_size=batch_size,
        buffer_size=steps,
        learning_starts=steps,
        policy_kwargs={
            "net_arch": list(networks.net_arch),
            "features_extractor_class": PlainEncoder,
            "features_extractor_kwargs": {**networks.encoder, "channels_last": channels_last},
        },
        seed=0,
        device=device,
    ).learn(steps)


class TextbookCRC:
    """
    CRC-RL by its equations: every loss with its own forward passes and its own optimizer, in torch's default layout.

    :param networks: of the agent
    :param batch_size: B
    """

    def __init__(self, networks: Networks, batch_size: int):
        # SB3's own agent brings encoder, heads, targets and a filled buffer
        self.agent = agent = stock_sac(networks, batch_size)
        assert isinstance(agent.replay_buffer, ReplayBuffer)
        self.buffer, self.batch_size = agent.replay_buffer, batch_size
        self.encoder, self.key_encoder = agent.critic.features_extractor, agent.critic_target.features_extractor
        assert isinstance(self.encoder, PlainEncoder)
        latent_dim = self.encoder.features_dim
        self.bilinear = nn.Parameter(th.eye(latent_dim))
        self.predictor = nn.Sequential(nn.Linear(latent_dim, 128), nn.LayerNorm(128), nn.ReLU(), nn.Linear(128, latent_dim))
        self.decoder = plain_decoder(self.encoder, networks.input_size)
        shared = list(self.encoder.parameters())
        heads = [p for network in agent.critic.q_networks for p in network.parameters()]
        actor = [p for name, p in agent.actor.named_parameters() if not name.startswith("features_extractor")]
        self.optimizers = {
            "critic": th.optim.Adam([*shared, *heads], lr=1e-3),
            "actor": th.optim.Adam(actor, lr=1e-3),
            "contrastive": th.optim.Adam([*shared, self.bilinear], lr=1e-3),
            "reconstruction": th.optim.Adam([*shared, *self.decoder.parameters()], lr=1e-3),
            "consistency": th.optim.Adam([*shared, *self.predictor.parameters()], lr=1e-3),
        }
        self.updates = 0

    def update(self, policy_delay: int) -> None:
        """:param policy_delay: updates between two of the actor"""
        self.updates += 1
        batch = self.buffer.sample(self.batch_size)
        observations, next_observations = self.augment(batch.observations), self.augment(batch.next_observations)
        self.step("critic", lambda: self.critic_loss(batch, observations, next_observations))
        if self.updates % policy_delay == 0:
            self.step("actor", lambda: self.actor_loss(observations))
        positive = self.augment(batch.observations)
        self.step("contrastive", lambda: self.contrastive_loss(observations, positive))
        self.step("reconstruction", lambda: F.mse_loss(self.decoder(self.encoder(observations)), observations))
        self.step("consistency", lambda: self.consistency_loss(observations, positive))
        polyak_update(self.agent.critic.parameters(), self.agent.critic_target.parameters(), 0.01)

    def augment(self, images: th.Tensor) -> th.Tensor:
        """Shift each sample by up to four pixels. :return: floats in [0, 1], ``(B, C, H, W)``"""
        size = images.shape[-1]
        padded = F.pad(images.float() / 255, (4, 4, 4, 4), mode="replicate")
        corners = th.randint(9, (len(images), 2)).tolist()
        return th.stack([image[:, y : y + size, x : x + size] for image, (y, x) in zip(padded, corners, strict=True)])

    def critic_loss(self, batch: Any, observations: th.Tensor, next_observations: th.Tensor) -> th.Tensor:
        """Twin soft Q loss."""
        with th.no_grad():
            next_actions, next_log_prob = self.act(self.encoder(next_observations))
            next_latents = self.key_encoder(next_observations)
            next_q_values = self.q_values(self.agent.critic_target, next_latents, next_actions).min(dim=1, keepdim=True).values
            targets = batch.rewards + (1 - batch.dones) * 0.99 * (next_q_values - 0.1 * next_log_prob)
        return (self.q_values(self.agent.critic, self.encoder(observations), batch.actions) - targets).square().mean()

    def actor_loss(self, observations: th.Tensor) -> th.Tensor:
        """Soft value of the actor's own actions, on a detached latent."""
        with th.no_grad():
            latents = self.encoder(observations)
        actions, log_prob = self.act(latents)
        return (0.1 * log_prob - self.q_values(self.agent.critic, latents, actions).min(dim=1, keepdim=True).values).mean()

    def contrastive_loss(self, observations: th.Tensor, positive: th.Tensor) -> th.Tensor:
        """InfoNCE."""
        with th.no_grad():
            keys = self.key_encoder(positive)
        return F.cross_entropy(self.encoder(observations) @ self.bilinear @ keys.T, th.arange(len(keys)))

    def consistency_loss(self, observations: th.Tensor, positive: th.Tensor) -> th.Tensor:
        """Squared distance between prediction and latent."""
        with th.no_grad():
            keys = self.key_encoder(positive)
        return (self.predictor(keys) - self.encoder(observations)).square().mean()

    def act(self, latents: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """:return: actions ``(B, A)`` and log probabilities ``(B, 1)``"""
        actor = self.agent.actor
        hidden = actor.latent_pi(latents)
        actions, log_prob = actor.action_dist.log_prob_from_params(actor.mu(hidden), actor.log_std(hidden).clamp(-20, 2))
        return actions, log_prob.unsqueeze(1)

    def q_values(self, critic: Any, latents: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """:return: ``(B, 2)``"""
        return th.cat([network(th.cat([latents, actions], dim=1)) for network in critic.q_networks], dim=1)

    def step(self, name: str, loss: Callable[[], th.Tensor]) -> None:
        """One step of one optimizer."""
        self.optimizers[name].zero_grad()
        loss().backward()
        self.optimizers[name].step()


def plain_decoder(encoder: PlainEncoder, size: int) -> nn.Sequential:
    """:return: transposed convolutions that mirror ``encoder``'s, from latents ``(B, Z)`` to images ``(B, C, size, size)``"""
    convolutions = [layer for layer in encoder.convolutions if isinstance(layer, nn.Conv2d)]
    sides = [size]
    for layer in convolutions:
        sides.append((sides[-1] - 3) // layer.stride[0] + 1)
    start = (convolutions[-1].out_channels, sides[-1], sides[-1])
    layers: list[nn.Module] = [nn.Linear(encoder.features_dim, start[0] * start[1] * start[2]), nn.Unflatten(1, start)]
    for layer, side in zip(reversed(convolutions), sides[-2::-1], strict=True):
        stride = layer.stride[0]
        padding = (side - 3) % stride
        layers += [nn.ReLU(), nn.ConvTranspose2d(layer.out_channels, layer.in_channels, 3, stride, output_padding=padding)]
    return nn.Sequential(*layers)
