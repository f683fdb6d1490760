"""What training changes of a model, compared bit for bit."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import SAC

from sb3_crc import CRCSAC


def optimizers(model: SAC) -> dict[str, th.optim.Optimizer]:
    """Every optimizer that the model or a module of its policy holds, wherever it is kept."""

    def search() -> Iterator[tuple[str, th.optim.Optimizer]]:
        for owner, kept in [("model", vars(model)), *((name, vars(module)) for name, module in model.policy.named_modules())]:
            for name, value in kept.items():
                for key, one in value.items() if isinstance(value, dict) else [("", value)]:
                    if isinstance(one, th.optim.Optimizer):
                        yield f"{owner}.{name}.{key}", one

    return dict(search())


def flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    if isinstance(tree, dict | list | tuple):
        pairs = tree.items() if isinstance(tree, dict) else enumerate(tree)
        return {name: value for key, branch in pairs for name, value in flat(branch, f"{prefix}/{key}").items()}
    return {prefix: tree}


def state(model: CRCSAC) -> dict[str, Any]:
    """All that training changes: networks with their buffers, optimizers, temperature, counters."""
    own = {
        "policy": model.policy.state_dict(),
        "optimizers": {name: optimizer.state_dict() for name, optimizer in optimizers(model).items()},
        "temperature": model._temperature(),
        "counters": [model._n_updates, model.num_timesteps, model._episode_num, model._current_progress_remaining],
    }
    return {name: value.clone() if isinstance(value, th.Tensor) else value for name, value in flat(own).items()}


def differences(first: dict[str, Any], second: dict[str, Any]) -> list[str]:
    """Names whose values are not equal bit for bit."""
    common = first.keys() & second.keys()
    unequal = (
        name
        for name in common
        if not (th.equal(first[name], second[name]) if isinstance(first[name], th.Tensor) else first[name] == second[name])
    )
    return sorted([*(first.keys() ^ second.keys()), *unequal])


def parameters(model: CRCSAC) -> list[th.Tensor]:
    return [parameter.detach().clone() for parameter in model.policy.parameters()]


def train_on(model: CRCSAC, seed: int, updates: int = 5) -> None:
    """Updates on batches, crops and actions that the seed decides."""
    np.random.seed(seed)
    th.manual_seed(seed)
    model.train(gradient_steps=updates, batch_size=16)
