"""An encoder of one's own: not what each filter sees, but where it sees it.

    python examples/extending/own_encoder.py --agent-steps 12500

B batch, C filters, H, W height and width of the last convolution's output, F what the heads' projections read, Z latent.
"""

import argparse
from typing import Any

import torch as th
from gymnasium import spaces

from sb3_crc import CRCSAC, PixelEncoder, make_dmc
from sb3_crc.encoder import Observations, init_orthogonal, latent_projection


class KeypointEncoder(PixelEncoder):
    """
    Convolutions, then the mean place at which each filter is active: a spatial soft arg max (arXiv 1504.00702, section 5.2).

    Arguments are those of PixelEncoder. ``convolve`` gives what actor and critic project, F = 2 C numbers for each picture.
    """

    places: th.Tensor

    def __init__(self, observation_space: spaces.Space[Any], features_dim: int = 50, **kwargs: Any) -> None:
        super().__init__(observation_space, features_dim, **kwargs)
        filters, height, width = self.convolution_shape
        rows, columns = th.meshgrid(th.linspace(-1, 1, height), th.linspace(-1, 1, width), indexing="ij")
        self.register_buffer("places", th.stack([rows.flatten(), columns.flatten()], dim=1), persistent=False)  # (H W, 2)
        self.convolution_dim = 2 * filters
        self.projection = latent_projection(self.convolution_dim, features_dim, self.latent_activation).apply(init_orthogonal)

    def convolve(self, observations: Observations) -> th.Tensor:
        """:param observations: ``(B, C, H, W)``, uint8 or floats in [0, 1]; :return: places ``(B, F)``"""
        features = super().convolve(observations)  # channels last
        activity = features.view(len(features), -1, self.convolution_shape[0])  # (B, H W, C)
        return th.einsum("bpc,pd->bcd", activity.softmax(dim=1), self.places).flatten(start_dim=1)


def main(arguments: list[str] | None = None) -> CRCSAC:
    """Train for a moment with it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--agent-steps", type=int, default=250, help="decisions; 12500 are 100 000 environment steps")
    options = parser.parse_args(arguments)
    env = make_dmc("cartpole-swingup", seed=0, image_size=48, render_quality="fast")
    model = CRCSAC(
        "CnnPolicy",
        env,
        policy_kwargs={"features_extractor_class": KeypointEncoder, "features_extractor_kwargs": {"features_dim": 32}},
        learning_starts=100,
        batch_size=32,
        verbose=1,
        seed=0,
    )
    return model.learn(options.agent_steps, log_interval=1)


if __name__ == "__main__":
    main()
