"""An augmentation of one's own: a grey square somewhere in the picture.

    python examples/extending/own_augmentation.py --agent-steps 12500

B batch, C channels (of the whole frame stack), H, W height and width.
"""

import argparse

import torch as th

from sb3_crc import CRCSAC, make_dmc
from sb3_crc.augmentations import AUGMENTATIONS


def random_cutout(images: th.Tensor, side: int = 12) -> th.Tensor:
    """
    Paint a grey square over a random place of each sample, the same for its whole stack (Cutout, arXiv 1708.04552).

    :param images: uint8 ``(B, C, H, W)``
    :param side: of the square in pixels
    :return: uint8 ``(B, C, H, W)``
    """
    batch, _, height, width = images.shape
    tops, lefts = th.randint(height - side + 1, (batch, 1)), th.randint(width - side + 1, (batch, 1))
    rows, columns = th.arange(height), th.arange(width)
    within_rows = (rows >= tops) & (rows < tops + side)  # (B, H)
    within_columns = (columns >= lefts) & (columns < lefts + side)  # (B, W)
    hidden = within_rows[:, None, :, None] & within_columns[:, None, None, :]  # (B, 1, H, W)
    return images.masked_fill(hidden.to(images.device), 128)


AUGMENTATIONS["random_cutout"] = random_cutout


def main(arguments: list[str] | None = None) -> CRCSAC:
    """Train for a moment with it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--agent-steps", type=int, default=250, help="decisions; 12500 are 100 000 environment steps")
    options = parser.parse_args(arguments)
    env = make_dmc("cartpole-swingup", seed=0, image_size=48, render_quality="fast")
    model = CRCSAC(
        "CnnPolicy",
        env,
        augmentation="random_cutout",
        augmentation_kwargs={"side": 10},
        objectives={},
        learning_starts=100,
        batch_size=32,
        verbose=1,
        seed=0,
    )
    return model.learn(options.agent_steps, log_interval=1)


if __name__ == "__main__":
    main()
