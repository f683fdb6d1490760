"""The presets, and what they are compared with, as algorithms of the zoo."""

from functools import partial
from typing import Any

import rl_zoo3.exp_manager
import rl_zoo3.hyperparams_opt
import rl_zoo3.train
from stable_baselines3 import SAC

from sb3_crc.crc_sac import CRCSAC
from sb3_crc.evaluation import QBiasEvalCallback
from sb3_crc.presets import PRESETS
from sb3_crc.settings import check_name
from sb3_crc.stock import STOCK
from sb3_crc.zoo.manager import CRCExperimentManager
from sb3_crc.zoo.search import constructor_arguments, sample


def preset_class(preset: str) -> type[CRCSAC]:
    """
    CRCSAC with the defaults of a preset, for the zoo's table of algorithms. Its zips load as CRCSAC too.

    :param preset: a key of :data:`~sb3_crc.PRESETS`
    :raises ValueError: for an unknown preset
    """
    check_name("preset", preset, PRESETS)

    def __init__(self: CRCSAC, *args: Any, **kwargs: Any) -> None:
        CRCSAC.__init__(self, *args, **{**PRESETS[preset], **kwargs})

    return type(preset, (CRCSAC,), {"preset": preset, "__init__": __init__, "__doc__": f"CRCSAC with PRESETS[{preset!r}]."})


def watched(algorithm: type[SAC]) -> type[SAC]:
    """
    The algorithm for who only watches it: what is loaded has room for one transition. The zoo does so for its own names only.

    :param algorithm: a class of :func:`preset_class` or of :data:`~sb3_crc.stock.STOCK`
    """

    def load(cls: type[SAC], *args: Any, **kwargs: Any) -> SAC:
        return super(watching, cls).load(*args, **{"buffer_size": 1, **kwargs})

    watching: type[SAC] = type(algorithm.__name__, (algorithm,), {"load": classmethod(load)})
    return watching


def register() -> None:
    """Put our algorithms into the zoo's tables of algorithms and searches, and our manager into its training script."""
    for name, preset in PRESETS.items():
        rl_zoo3.ALGOS[name] = preset_class(name)
        rl_zoo3.hyperparams_opt.HYPERPARAMS_SAMPLER[name] = partial(sample, preset)
        rl_zoo3.hyperparams_opt.HYPERPARAMS_CONVERTER[name] = partial(constructor_arguments, preset)
    rl_zoo3.ALGOS.update(STOCK)
    search = rl_zoo3.hyperparams_opt
    search.HYPERPARAMS_SAMPLER["state_sac"] = search.HYPERPARAMS_SAMPLER["sac"]
    search.HYPERPARAMS_CONVERTER["state_sac"] = search.HYPERPARAMS_CONVERTER["sac"]
    rl_zoo3.exp_manager.EvalCallback = QBiasEvalCallback  # type: ignore[attr-defined]
    rl_zoo3.train.ExperimentManager = CRCExperimentManager  # type: ignore[attr-defined]
