"""Auxiliary losses for the encoder, and how a mapping of names and weights becomes modules."""

import importlib
import inspect
import math
import warnings
from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.buffers import ReplayBuffer
from torch import nn

from sb3_crc.buffers import FrameReplayBuffer
from sb3_crc.encoder import PixelEncoder
from sb3_crc.objectives.base import AuxiliaryObjective
from sb3_crc.objectives.consistency import Consistency, consistency_loss
from sb3_crc.objectives.contrastive import Contrastive, info_nce
from sb3_crc.objectives.reconstruction import Reconstruction, reconstruction_loss
from sb3_crc.settings import check_name

__all__ = [
    "OBJECTIVES",
    "AuxiliaryObjective",
    "Consistency",
    "Contrastive",
    "Reconstruction",
    "build_objectives",
    "consistency_loss",
    "info_nce",
    "objective_weights",
    "reads_next",
    "reconstruction_loss",
]

#: Name in ``objectives={...}`` -> class. Any other subclass is named by its dotted path.
OBJECTIVES: dict[str, type[AuxiliaryObjective]] = {
    "contrastive": Contrastive,
    "reconstruction": Reconstruction,
    "consistency": Consistency,
}

ObjectiveSettings = Mapping[str, float | Mapping[str, Any]]


def objective_weights(objectives: ObjectiveSettings, *, without: str = "use objectives={}") -> dict[str, float]:
    """
    :param objectives: name -> weight, or name -> ``{"weight": w, **settings}``
    :param without: what to do for training without them
    :return: name (of a dotted path its last part) -> weight
    :raises ValueError: for a name that is no text, or a weight that is missing, negative or not finite
    """
    if not isinstance(objectives, Mapping):
        raise ValueError(f"objectives must be a mapping name -> weight, got {objectives!r}")
    weights = {}
    for name, setting in objectives.items():
        if not isinstance(name, str):
            example = f"{name.__module__}.{name.__qualname__}" if isinstance(name, type) else "my_package.MyObjective"
            raise ValueError(f"objectives: {name!r} must be a name, or a class's dotted path as text, such as {example!r}")
        weight = setting.get("weight") if isinstance(setting, Mapping) else setting
        if isinstance(weight, bool) or not isinstance(weight, int | float) or not math.isfinite(weight) or weight < 0:
            raise ValueError(f"objectives[{name!r}]: the weight must be a finite number >= 0, got {weight!r}")
        weights[_short_name(name)] = float(weight)
    if len(weights) < len(objectives):
        raise ValueError(f"objectives: names must differ in their last part, got {', '.join(objectives)}")
    if weights and not any(weights.values()):
        raise ValueError(f"all weights of objectives are zero; {without} to train without auxiliary losses")
    return weights


def build_objectives(objectives: ObjectiveSettings, encoder: PixelEncoder, action_dim: int) -> nn.ModuleDict:
    """
    Build the modules for ``objectives={"contrastive": 0.5, "my_package.MyObjective": {"weight": 0.1, "margin": 2.0}}``.

    :param objectives: name -> weight, or name -> ``{"weight": w, **constructor arguments}``
    :param encoder: the online encoder
    :param action_dim: A
    :raises ValueError: for an unknown name or setting, or a bad weight
    """
    weights = objective_weights(objectives)
    online = [
        setting
        for setting in objectives.values()
        if isinstance(setting, Mapping) and setting.get("predictor_side") == "online"
    ]
    if set(weights) == {"consistency"} and not online:  # SODA's form holds its target still
        warnings.warn("consistency is the only objective: without another one it collapses the latent", stacklevel=2)
    if set(weights) == set(OBJECTIVES) and not math.isclose(sum(weights.values()), 1, abs_tol=1e-2):
        warnings.warn(f"the weights of CRC-RL's three losses should sum to 1 (the paper), got {weights}", stacklevel=2)
    modules = nn.ModuleDict()
    for name, setting in objectives.items():
        cls = _objective_class(name)
        own = {key: value for key, value in setting.items() if key != "weight"} if isinstance(setting, Mapping) else {}
        _check_settings(name, cls, own)
        modules[_short_name(name)] = cls.for_encoder(encoder, action_dim, **own)
    return modules


def reads_next(objectives: nn.ModuleDict, buffer: ReplayBuffer | None) -> bool:
    """
    :param objectives: what :func:`build_objectives` returned
    :param buffer: where batches come from
    :return: whether one of the objectives reads o_{t+1}
    :raises ValueError: if it does, and the buffer returns o_{t+n} alone
    """
    readers = [name for name, objective in objectives.items() if objective.reads_next]
    n_steps = getattr(buffer, "n_steps", 1)
    if readers and n_steps > 1 and not isinstance(buffer, FrameReplayBuffer):
        raise ValueError(
            f"objective {readers[0]!r} reads the observation one step on, which {type(buffer).__name__} does not return with "
            f"n_steps={n_steps}: use FrameReplayBuffer or n_steps=1"
        )
    return bool(readers)


def _short_name(name: str) -> str:
    return name.rpartition(".")[2]


def _objective_class(name: str) -> type[AuxiliaryObjective]:
    if name in OBJECTIVES:
        return OBJECTIVES[name]
    if "." not in name:
        check_name("objective", name, [*OBJECTIVES, "<module>.<YourObjective>"])
    module_name, _, class_name = name.rpartition(".")
    try:
        cls = getattr(importlib.import_module(module_name), class_name)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"objective {name!r} cannot be imported: {error}") from error
    if not (isinstance(cls, type) and issubclass(cls, AuxiliaryObjective)):
        raise ValueError(f"objective {name!r} must be a subclass of AuxiliaryObjective, got {cls!r}")
    return cls


def _check_settings(name: str, cls: type[AuxiliaryObjective], own: Mapping[str, Any]) -> None:
    parameters = list(inspect.signature(cls.__init__).parameters.values())[4:]  # after self and the three shapes
    allowed = [parameter.name for parameter in parameters if parameter.kind is not parameter.VAR_KEYWORD]
    unknown = [key for key in own if key not in allowed]
    if unknown and len(allowed) == len(parameters):
        raise ValueError(f"objectives[{name!r}] has no setting {unknown[0]!r}; known: {', '.join(['weight', *allowed])}")
