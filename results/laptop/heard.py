"""
How much of the way that the encoder goes is due to each objective?

From a finished run with checkpoints the training goes on for some hundred updates, with the learning rates of half of the run:
once as it was, once without each objective, and twice with all of them but not quite the same, as landmarks: with weights of
the encoder that differ by a ten millionth, and with other random crops. Batches are the same in all, random numbers in all but
the last. Printed and saved: the distance of where the encoder's weights get from where they get as it was, as a share of the
way there.

    python results/laptop/heard.py RUN -o results/laptop/heard.json
    python results/laptop/heard.py RUN --balance grad_norm -o results/laptop/heard_balanced.json
"""

import argparse
import json
from functools import partial
from pathlib import Path

import numpy as np
import torch as th
from stable_baselines3.common.logger import Logger

from sb3_crc import CRCSAC
from sb3_crc.buffers.files import read_contents
from sb3_crc.checkpoints.store import INDEX, CheckpointStore
from sb3_crc.crc_sac import CHOICES

AFTER = (1, 3, 10, 30, 100, 200)


def ways(model: CRCSAC, after: tuple[int, ...] = AFTER, *, without: str = "", nudge: float = 0.0, seed: int = 0) -> th.Tensor:
    """
    Train on.

    :param model: with a replay buffer; it is changed
    :param after: how many updates
    :param without: an objective, whose weight becomes zero
    :param nudge: relative size of random changes of the encoder's weights at the beginning
    :param seed: of what is random beside the batches
    :return: how far each of the encoder's weights has moved, ``(len(after), weights)``
    """
    parameters = list(model.critic.features_extractor.parameters())
    model.set_logger(Logger(None, []))
    if without:
        model._objective_weights[without] = 0.0
    th.manual_seed(0)
    with th.no_grad():
        for parameter in parameters:
            parameter.mul_(1 + nudge * th.randn_like(parameter))
    np.random.seed(0)
    th.manual_seed(seed)
    begin, moved = flat(parameters), []
    for updates in np.diff((0, *after)):
        model.train(int(updates), model.batch_size)
        moved.append(flat(parameters) - begin)
    return th.stack(moved)


def flat(parameters: list[th.nn.Parameter]) -> th.Tensor:
    """:return: a copy of all of them in one row, however they lie in memory"""
    return th.cat([parameter.detach().flatten() for parameter in parameters])


def loaded(run: Path, balance: str) -> CRCSAC:
    """
    :param run: folder of a training
    :param balance: as CRCSAC's, whatever the training had
    :return: its model with what it had seen, half-way as far as learning rates go
    """
    checkpoints = CheckpointStore(run / "checkpoints")
    newest = checkpoints.newest()
    (path,) = run.glob("*-v*.zip")
    model = CRCSAC.load(path, device="cpu")
    if newest is None or model.replay_buffer is None:
        raise SystemExit(f"{run} has no checkpoint")
    read_contents(model.replay_buffer, checkpoints.segments, newest.path / INDEX)
    model._current_progress_remaining = 0.5
    model.balance = balance
    return model


def main() -> None:
    """Measure, print, save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--balance", choices=CHOICES["balance"], default="none")
    options = parser.parse_args()
    begin = partial(loaded, options.run, options.balance)
    as_it_was = ways(begin())
    changes = {f"without {name}": {"without": name} for name in begin().objectives}
    changes |= {"weights differ by 1e-7": {"nudge": 1e-7}, "other crops": {"seed": 1}}
    shares = {}
    for name, change in changes.items():
        distance = (ways(begin(), **change) - as_it_was).norm(dim=1) / as_it_was.norm(dim=1)
        shares[name] = {str(updates): round(share, 4) for updates, share in zip(AFTER, distance.tolist(), strict=True)}
        print(name, shares[name], flush=True)
    options.output.write_text(json.dumps(shares, indent=1) + "\n")


if __name__ == "__main__":
    main()
