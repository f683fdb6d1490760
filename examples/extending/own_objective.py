"""An objective of one's own: which action led from one frame to the next?

    python examples/extending/own_objective.py --agent-steps 12500

B batch, Z latent, A action.
"""

import argparse

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_crc import CRCSAC, make_dmc
from sb3_crc.objectives import AuxiliaryObjective
from sb3_crc.views import Views


class InverseDynamics(AuxiliaryObjective):
    """
    Predict a_t from the latents of o_t and o_{t+1} (arXiv 1705.05363), so that the latent holds what the agent can move.

    :param hidden_dim: width of the predictor
    """

    reads_next = True  # of o_{t+1}, which n-step returns would otherwise skip

    def __init__(
        self, latent_dim: int, observation_shape: tuple[int, int, int], action_dim: int, *, hidden_dim: int = 128
    ) -> None:
        super().__init__(latent_dim, observation_shape, action_dim)
        self.predictor = nn.Sequential(nn.Linear(2 * latent_dim, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, action_dim))

    def forward(self, views: Views) -> th.Tensor:
        """:param views: the views of one batch; :return: the loss, a scalar"""
        latents = th.cat([views.query.latent, views.next.latent], dim=1)  # (B, 2 Z); the second has no gradient
        predicted = self.predictor(latents)  # (B, A)
        self.metrics = {"explained": 1 - (predicted - views.actions).detach().var() / views.actions.var()}
        return F.mse_loss(predicted, views.actions)


def main(arguments: list[str] | None = None) -> CRCSAC:
    """Train for a moment, and print the log with ``representation/InverseDynamics``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--agent-steps", type=int, default=250, help="decisions; 12500 are 100 000 environment steps")
    options = parser.parse_args(arguments)
    env = make_dmc("cartpole-swingup", seed=0, image_size=48, render_quality="fast")
    model = CRCSAC(
        "CnnPolicy",
        env,
        objectives={"contrastive": 0.5, "own_objective.InverseDynamics": {"weight": 0.5, "hidden_dim": 64}},
        learning_starts=100,
        batch_size=32,
        verbose=1,
        seed=0,
    )
    return model.learn(options.agent_steps, log_interval=1)


if __name__ == "__main__":
    main()
