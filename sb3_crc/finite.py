"""Numbers that are not finite: no step is made on them, what they came from is kept, and training stops or counts them."""

import math
import tempfile
from collections.abc import Mapping, Sequence
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
        """:return: index of the update, name and value of the first loss or gradient that is not finite"""
        for index, metrics in enumerate(self.updates):
            for name, value in metrics.items():
                if name in self.losses and not math.isfinite(number := value.item()):
                    return index, name, number
        return None

    def drop_failures(self) -> int:
        """Forget all updates of which something is not finite. :return: how many those were"""
        before = len(self.updates)
        while (failure := self.first_failure()) is not None:
            del self.updates[failure[0]], self.draws[failure[0]]
        return before - len(self.updates)

    def stop_if_not_finite(
        self, buffer: ReplayBuffer, batch_size: int, env: VecNormalize | None, folder: str | None, agent_step: int
    ) -> None:
        """
        Draw the batch of the first update that failed again, which needs the buffer as it was, and save it.

        :param folder: under which to save it; None: the system's for temporary files
        :raises FloatingPointError: naming update, loss, value and the folder, if a loss or gradient is not finite
        """
        failure = self.first_failure()
        if failure is None:
            return
        index, name, value = failure
        update = self.first_update + index
        numpy_state, torch_state = self.draws[index]
        np.random.set_state(numpy_state)
        rows = np.random.randint(0, buffer.size(), size=batch_size)  # as SB3's buffers draw, and ours
        places = {"rows": th.from_numpy(rows), "environments": th.from_numpy(np.random.randint(0, buffer.n_envs, rows.shape))}
        np.random.set_state(numpy_state)
        batch = buffer.sample(batch_size, env=env)
        target = _post_mortem(folder, f"update_{update}")
        th.save({**_on_host(batch._asdict()), **places, "torch_rng_state": torch_state}, target / "batch.pt")
        raise FloatingPointError(
            f"{name} is {value} at update {update}, agent step {agent_step}: Adam has not stepped on it; go on from the last "
            f"checkpoint, or with on_nonfinite='skip'; the update's batch, with its places in the buffer, is saved in {target}"
        )


def checked_step(
    optimizer: th.optim.Optimizer, gradients: Sequence[th.Tensor | None], max_norm: float | None = None
) -> th.Tensor:
    """
    Step, if the gradient is finite and the optimizer is fused, as ours are; others step in any case.

    :param optimizer: of some parameters
    :param gradients: of these, in their order
    :param max_norm: to which the gradient is clipped; None: it is not
    :return: the gradient's norm before that, a scalar
    """
    parameters = parameters_of(optimizer)
    for parameter, gradient in zip(parameters, gradients, strict=True):
        parameter.grad = gradient
    present = [gradient for gradient in gradients if gradient is not None]
    if not present:  # all of it is frozen
        return th.zeros((), device=parameters[0].device)
    norm = th.nn.utils.get_total_norm(present)
    if max_norm is not None:
        th.nn.utils.clip_grads_with_norm_(parameters, max_norm, norm)
    if optimizer.param_groups[0].get("fused"):  # torch's loss scaling asks the same of it
        optimizer.found_inf = (~norm.isfinite()).float()  # type: ignore[attr-defined]
    optimizer.step()
    optimizer.zero_grad()
    return norm.detach()


def parameters_of(optimizer: th.optim.Optimizer) -> list[th.Tensor]:
    """:return: what it steps on"""
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]


def not_finite(values: Mapping[str, Any]) -> tuple[str, int, float] | None:
    """
    :param values: name -> array with one row for each environment, or a mapping of such
    :return: name, environment and value of the first number that is not finite
    """
    for name, value in values.items():
        if isinstance(value, Mapping):
            found = not_finite({f"{name}[{key!r}]": one for key, one in value.items()})
            if found is not None:
                return found
            continue
        array = np.asarray(value)
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            place = np.argwhere(~np.isfinite(array))[0]
            return name, int(place[0]), float(array[tuple(place)])
    return None


def save_transition(folder: str | None, agent_step: int, values: Mapping[str, Any]) -> Path:
    """
    :param folder: under which to save it; None: the system's for temporary files
    :param agent_step: at which it happened
    :param values: name -> array, or a mapping of such
    :return: the folder with ``transition.npz``
    """
    target = _post_mortem(folder, f"agent_step_{agent_step}")
    flat = {
        f"{name}/{key}" if key else name: part
        for name, value in values.items()
        for key, part in (value.items() if isinstance(value, Mapping) else [("", value)])
    }
    np.savez(target / "transition.npz", **{name: np.asarray(value) for name, value in flat.items()})  # type: ignore[arg-type]
    return target


def _post_mortem(folder: str | None, when: str) -> Path:
    target = Path(folder or tempfile.gettempdir()) / f"not_finite_at_{when}"
    target.mkdir(parents=True, exist_ok=True)
    return target


def _on_host(values: Mapping[str, Any]) -> dict[str, Any]:
    present = {key: value for key, value in values.items() if value is not None}
    return {key: _on_host(value) if isinstance(value, Mapping) else value.cpu() for key, value in present.items()}
