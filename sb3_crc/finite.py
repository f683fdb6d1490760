"""Stop at the first loss that is not finite, and keep the batch it came from."""

import math
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

#: State of the generators from which a batch, its crops and actions were drawn
Draw = tuple[Any, th.Tensor]


def draw_state() -> Draw:
    """What makes the next batch repeatable: bytes of state instead of a copy of the batch."""
    return np.random.get_state(), th.get_rng_state()


class LossHistory:
    """
    The metrics of each update of one call of ``train()``.

    :param first_update: number of the first of them
    :param losses: names of the metrics that must be finite; instruments may be undefined
    """

    def __init__(self, first_update: int, losses: set[str]):
        self.first_update = first_update
        self.losses = losses
        self.draws: list[Draw] = []
        self.updates: list[dict[str, th.Tensor]] = []

    def begin(self) -> dict[str, th.Tensor]:
        """Call before a batch is drawn. :return: to be filled with the update's metrics, without graphs"""
        self.draws.append(draw_state())
        self.updates.append({})
        return self.updates[-1]

    def means(self) -> dict[str, float]:
        """:return: name -> mean over the updates that have it, fetched from the device in one transfer"""
        records: dict[str, list[th.Tensor]] = {}
        for metrics in self.updates:
            for name, value in metrics.items():
                records.setdefault(name, []).append(value.reshape(()).float())
        if not records:
            return {}
        means = th.stack([th.stack(values).mean() for values in records.values()]).tolist()
        return dict(zip(records, means, strict=True))

    def first_failure(self) -> tuple[int, str, float] | None:
        """:return: index of the update, name and value of the first loss that is not finite"""
        for index, metrics in enumerate(self.updates):
            for name, value in metrics.items():
                if name in self.losses and not math.isfinite(number := value.item()):
                    return index, name, number
        return None

    def stop_if_not_finite(
        self, buffer: ReplayBuffer, batch_size: int, env: VecNormalize | None, folder: str | None, agent_step: int
    ) -> None:
        """
        Draw the batch of the first update that failed again, which needs the buffer as it was, and save it.

        :param folder: under which to save it; None: the system's for temporary files
        :raises FloatingPointError: naming update, loss, value and the folder, if a loss is not finite
        """
        failure = self.first_failure()
        if failure is None:
            return
        index, name, value = failure
        update = self.first_update + index
        numpy_state, torch_state = self.draws[index]
        np.random.set_state(numpy_state)
        batch = buffer.sample(batch_size, env=env)
        target = Path(folder or tempfile.gettempdir()) / f"not_finite_at_update_{update}"
        target.mkdir(parents=True, exist_ok=True)
        th.save({**_on_host(batch._asdict()), "torch_rng_state": torch_state}, target / "batch.pt")
        raise FloatingPointError(
            f"{name} is {value} at update {update}, agent step {agent_step}: the weights are lost, go on from the last "
            f"checkpoint; the update's batch is saved in {target}"
        )


def _on_host(values: Mapping[str, Any]) -> dict[str, Any]:
    present = {key: value for key, value in values.items() if value is not None}
    return {key: _on_host(value) if isinstance(value, Mapping) else value.cpu() for key, value in present.items()}
