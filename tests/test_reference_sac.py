"""``objectives={}`` without augmentation is pixel SAC: an independent implementation in plain torch agrees with it."""

import copy

import pytest
import torch as th
from torch.nn import functional as F

from sb3_crc import CRCSAC
from tests.conftest import make_model

GAMMA, TAU, ENCODER_TAU = 0.97, 0.03, 0.07


def torchs_own(convolutions: th.nn.Sequential) -> th.nn.Sequential:
    """The same convolutions as torch's layers in its default layout."""
    layers: list[th.nn.Module] = []
    for ours in convolutions:
        layer = th.nn.Conv2d(ours.in_channels, ours.out_channels, ours.kernel_size, ours.stride)
        layer.load_state_dict({name: weight.contiguous() for name, weight in ours.state_dict().items()})
        layers += [layer, th.nn.ReLU()]
    return th.nn.Sequential(*layers)


def channels_last(features: th.Tensor) -> th.Tensor:
    return features.permute(0, 2, 3, 1).flatten(1)


class ReferenceSAC:
    """Pixel SAC with a shared encoder that only the critic trains; targets and policy every 2nd update."""

    def __init__(self, model: CRCSAC):
        policy = copy.deepcopy(model.policy)
        encoder = policy.critic.features_extractor
        self.convs, self.projection = torchs_own(encoder.convolutions), encoder.projection
        self.q = list(policy.critic.q_networks)
        self.target_convs, self.target_projection = copy.deepcopy(self.convs), copy.deepcopy(self.projection)
        self.target_q = copy.deepcopy(self.q)
        self.actor_projection, self.trunk = policy.actor.projection, policy.actor.latent_pi
        self.mu, self.log_std = policy.actor.mu, policy.actor.log_std
        self.log_alpha = model.log_ent_coef.detach().clone().requires_grad_()
        critic = [p for module in (self.convs, self.projection, *self.q) for p in module.parameters()]
        actor = [p for m in (self.actor_projection, self.trunk, self.mu, self.log_std) for p in m.parameters()]
        self.critic_adam, self.actor_adam = th.optim.Adam(critic, lr=1e-3), th.optim.Adam(actor, lr=1e-3)
        self.alpha_adam = th.optim.Adam([self.log_alpha], lr=1e-4, betas=(0.5, 0.999))
        self.updates = 0

    def act(self, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        hidden = self.trunk(self.actor_projection(features))
        mean, log_std = self.mu(hidden), -10 + 6 * (th.tanh(self.log_std(hidden)) + 1)
        normal = th.distributions.Normal(mean, log_std.exp())
        gaussian = normal.rsample()
        action = th.tanh(gaussian)
        log_prob = (normal.log_prob(gaussian) - th.log(1 - action**2 + 1e-6)).sum(dim=1, keepdim=True)
        return action, log_prob

    def update(self, batch) -> dict[str, float]:
        self.updates += 1
        corner = (slice(None), slice(None), slice(3, 37), slice(3, 37))  # the middle 34 of 40 pixels
        obs, next_obs = batch.observations[corner].float() / 255, batch.next_observations[corner].float() / 255
        alpha = self.log_alpha.exp().detach()
        with th.no_grad():
            next_action, next_log_prob = self.act(channels_last(self.convs(next_obs)))
            next_latent = self.target_projection(channels_last(self.target_convs(next_obs)))
            q1, q2 = (q(th.cat([next_latent, next_action], 1)) for q in self.target_q)
            target = batch.rewards + GAMMA * (1 - batch.dones) * (th.min(q1, q2) - alpha * next_log_prob)
        features = channels_last(self.convs(obs))
        latent = self.projection(features)
        critic_loss = sum(0.5 * F.mse_loss(q(th.cat([latent, batch.actions], 1)), target) for q in self.q)
        self.critic_adam.zero_grad()
        critic_loss.backward()
        self.critic_adam.step()
        losses = {"train/critic_loss": critic_loss.item()}
        if self.updates % 2 == 0:
            action, log_prob = self.act(features.detach())
            q1, q2 = (q(th.cat([latent.detach(), action], 1)) for q in self.q)
            actor_loss = (alpha * log_prob - th.min(q1, q2)).mean()
            self.actor_adam.zero_grad()
            actor_loss.backward()
            self.actor_adam.step()
            alpha_loss = -(self.log_alpha * (log_prob.detach() - 2)).mean()  # target entropy -|A| = -2
            self.alpha_adam.zero_grad()
            alpha_loss.backward()
            self.alpha_adam.step()
            losses |= {"train/actor_loss": actor_loss.item(), "train/ent_coef_loss": alpha_loss.item()}
            for online, target_net, tau in [
                (self.convs, self.target_convs, ENCODER_TAU),
                (self.projection, self.target_projection, ENCODER_TAU),
                *((q, t, TAU) for q, t in zip(self.q, self.target_q, strict=True)),
            ]:
                for p, t in zip(online.parameters(), target_net.parameters(), strict=True):
                    t.data = (1 - tau) * t.data + tau * p.data
        return losses


def test_twenty_updates_equal_the_reference() -> None:
    model = make_model(objectives={}, augmentation="center_crop", gamma=GAMMA, tau=TAU, encoder_tau=ENCODER_TAU)
    reference = ReferenceSAC(model)
    batches = [model.replay_buffer.sample(16) for _ in range(20)]

    th.manual_seed(3)
    expected = [reference.update(batch) for batch in batches]
    th.manual_seed(3)
    feed = iter(batches)
    model.replay_buffer.sample_frames = lambda batch_size, env=None: next(feed)
    for losses in expected:
        model.train(gradient_steps=1, batch_size=16)
        for name, value in losses.items():
            assert model.logger.name_to_value[name] == pytest.approx(value, rel=1e-5, abs=1e-6), name

    pairs = [
        (model.critic.features_extractor.convolutions, reference.convs),
        (model.critic.features_extractor.projection, reference.projection),
        (model.policy.key_encoder.convolutions, reference.target_convs),
        (model.policy.key_encoder.projection, reference.target_projection),
        (model.actor.latent_pi, reference.trunk),
        *zip(model.critic_target.q_networks, reference.target_q, strict=True),
    ]
    for ours, theirs in pairs:
        for p, r in zip(ours.parameters(), theirs.parameters(), strict=True):
            assert th.allclose(p, r, rtol=1e-4, atol=1e-6)
    assert model.log_ent_coef.item() == pytest.approx(reference.log_alpha.item(), rel=1e-5)
