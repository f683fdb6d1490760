"""A loss of your own, in one class: which reward will this action bring?

Latents that can answer hold what matters to the task, and may leave out the scenery (UNREAL, arXiv 1611.05397, section 3.3).
The class says what is computed; optimizer, device, train and eval mode, saving and logging follow. It goes by its dotted path,
in Python and in a configuration alike. Keys beside ``weight`` are arguments of its constructor:

    CRCSAC("CnnPolicy", env, objectives={"reward_objective.RewardPrediction": {"weight": 1.0, "hidden_dim": 64}})

    PYTHONPATH=examples python train.py --algo rad --env dmc_pixels/walker-walk-v0 --conf-file examples/reward_objective.yml

What to look for in the log: ``representation/RewardPrediction`` falls, and ``representation/RewardPrediction_explained``, the
share of the rewards' variance that is foreseen, rises from 0 towards 1. An objective that reads o_{t+1} is in
``examples/extending/own_objective.py``.

    python examples/reward_objective.py --steps 1500
"""

import argparse
from typing import Any

import torch as th
from custom_image_env import SMALL, make_track
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn
from torch.nn import functional as F

from sb3_crc import CRCSAC
from sb3_crc.objectives import AuxiliaryObjective
from sb3_crc.views import Views

NAME = "RewardPrediction"


class RewardPrediction(AuxiliaryObjective):
    """
    Predict r_t from the latent of o_t and a_t. B batch, Z latent, A action.

    :param hidden_dim: width of the predictor
    """

    def __init__(self, latent_dim: int, observation_shape: tuple[int, int, int], action_dim: int, *, hidden_dim: int = 128):
        super().__init__(latent_dim, observation_shape, action_dim)
        self.predictor = nn.Sequential(nn.Linear(latent_dim + action_dim, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, 1))

    def forward(self, views: Views) -> th.Tensor:
        """The mean squared error; what ``metrics`` hold is logged beside it."""
        predicted = self.predictor(th.cat([views.query.latent, views.actions], dim=1))  # (B, 1)
        loss = F.mse_loss(predicted, views.rewards)
        variance = views.rewards.var(correction=0).clamp(min=1e-8)
        self.metrics = {"explained": 1 - loss.detach() / variance}
        return loss


class History(BaseCallback):
    """Keeps what the log says of the objective after each update."""

    def _on_training_start(self) -> None:
        self.values: dict[str, list[float]] = {NAME: [], f"{NAME}_explained": []}

    def _on_step(self) -> bool:
        for name, values in self.values.items():
            if (value := self.logger.name_to_value.get(f"representation/{name}")) is not None:
                values.append(float(value))
        return True


def train(steps: int, objectives: dict[str, Any], seed: int = 0) -> tuple[CRCSAC, dict[str, list[float]]]:
    """:return: the model, and what was logged of the loss and of the share that it explains"""
    history = History()
    model = CRCSAC("CnnPolicy", make_track(seed), seed=seed, objectives=objectives, **SMALL)
    return model.learn(steps, callback=history), history.values


def main() -> None:
    """Train with the loss, and show what it did."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=1_500, help="decisions to learn from")
    parser.add_argument("--weight", type=float, default=1.0, help="of the objective")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()

    setting = {"weight": given.weight, "hidden_dim": 64}
    _, logged = train(given.steps, {f"reward_objective.{NAME}": setting}, given.seed)
    for name, values in logged.items():
        tenth = max(1, len(values) // 10)
        first, last = (sum(part) / len(part) for part in (values[:tenth], values[-tenth:]))
        print(f"representation/{name}: {first:.3f} in the first tenth of the updates, {last:.3f} in the last")


if __name__ == "__main__":
    main()
