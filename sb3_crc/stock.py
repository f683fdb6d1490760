"""Stock SAC of Stable-Baselines3, with which our methods are compared: networks, losses and updates are those that SB3 ships.

- ``sac``: from pixels, with all of SB3's defaults.
- ``sac_matched``: from pixels, with our encoder, head sizes, learning rate, batch, replay ratio, discount and temperature.
  What is left of the difference is the method: augmentation, objectives, one encoder for actor and critic, n-step returns.
- ``state_sac``: from the simulator's states, with SB3's defaults: what the task would give if seeing were no problem.
"""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import MaybeCallback
from typing_extensions import Self

from sb3_crc.augmentations import takes_size
from sb3_crc.buffers import FrameReplayBuffer
from sb3_crc.convolutions import fast_updates
from sb3_crc.crc_sac import CROP_RATIO
from sb3_crc.encoder import PixelEncoder
from sb3_crc.presets import PRESETS
from sb3_crc.settings import check_name
from sb3_crc.stacking import stacked_frame_channels
from sb3_crc.whole_rollouts import WholeRollouts

#: Settings that make the environment and the budget
ENVIRONMENT = ("n_timesteps", "n_envs", "env_kwargs", "env_wrapper", "vec_env_wrapper", "frame_stack", "buffer_size")
#: What SB3's SAC has in common with CRCSAC, and what makes a comparison one of methods
MATCHED = ("learning_rate", "batch_size", "train_freq", "gradient_steps", "learning_starts", "gamma", "tau", "ent_coef")
MATCHED_POLICY = ("net_arch", "features_extractor_kwargs")
#: As much experience, as many random actions and the same discounted return as from pixels; the rest SB3 chose for states
STATES = ("n_timesteps", "n_envs", "buffer_size", "learning_starts", "gamma")


class StockSAC(WholeRollouts):
    """
    SB3's SAC, whose replay buffer is by default a :class:`~sb3_crc.FrameReplayBuffer`: it samples what SB3's own samples, and
    can be saved in checkpoints. What it saves loads as ``stable_baselines3.SAC`` too.
    """

    def _setup_model(self) -> None:
        ours = isinstance(self.observation_space, spaces.Box) and not self.optimize_memory_usage and self.n_steps == 1
        if self.replay_buffer_class is None and ours:
            stacked = self.env is not None and is_image_space(self.observation_space)
            channels = stacked_frame_channels(self.env) if stacked and self.env is not None else None
            self.replay_buffer_class = FrameReplayBuffer
            self.replay_buffer_kwargs = {"frame_channels": channels, **self.replay_buffer_kwargs}
        super()._setup_model()

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "SAC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """As in SB3, with the settings of the process that ours learn with: a comparison of times is one of methods."""
        with fast_updates(self.device):
            return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)


class MatchedSAC(StockSAC):
    """A :class:`StockSAC` whose actor and critic each see through a :class:`~sb3_crc.PixelEncoder` of their own by default."""

    def _setup_model(self) -> None:
        self.policy_kwargs = {"features_extractor_class": PixelEncoder, **self.policy_kwargs}
        super()._setup_model()


STOCK: dict[str, type[SAC]] = {"sac": StockSAC, "sac_matched": MatchedSAC, "state_sac": StockSAC}


def shared_settings(algorithm: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """
    What a stock algorithm takes of a configuration that was written for our methods. Of what is matched and not named there,
    ours have the default of CRCSAC, so it gets that one too.

    :param algorithm: a key of :data:`STOCK`
    :param settings: one environment's, of rl_zoo3; where frames are cropped, ``sac_matched`` sees the middle of them, of the
        size that our networks see, if ``env_kwargs`` names the size of a frame
    :return: settings of rl_zoo3 that share nothing with ``settings``
    :raises ValueError: for an unknown algorithm, or if what must be a mapping is none
    """
    check_name("stock algorithm", algorithm, STOCK)
    if algorithm == "state_sac":
        repeat = {name: value for name, value in _mapping(settings, "env_kwargs").items() if name == "action_repeat"}
        return {**_taken(settings, STATES), "policy": "MlpPolicy", "env_kwargs": {**repeat, "observation": "state"}}
    taken = {**_taken(settings, ENVIRONMENT), "policy": "CnnPolicy"}
    if algorithm == "sac_matched":
        policy_kwargs = _mapping(settings, "policy_kwargs")
        own = {"net_arch": [1024, 1024]} | {name: policy_kwargs[name] for name in MATCHED_POLICY if name in policy_kwargs}
        encoder = {**_network_input(settings), **_mapping(own, "features_extractor_kwargs")}
        taken |= {**_taken(settings, MATCHED), "policy_kwargs": deepcopy({**own, "features_extractor_kwargs": encoder})}
    return taken


def _taken(settings: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    known = {**PRESETS["crc"], **settings}
    return {name: deepcopy(known[name]) for name in names if name in known}


def _network_input(settings: Mapping[str, Any]) -> dict[str, Any]:
    """:return: argument of PixelEncoder: the size that our networks see; nothing, where that is the whole frame"""
    if settings.get("image_size") is not None:
        return {"image_size": settings["image_size"]}
    frame = _mapping(settings, "env_kwargs").get("image_size")
    cropped = takes_size(settings.get("augmentation", PRESETS["crc"]["augmentation"]))
    return {"image_size": round(CROP_RATIO * frame)} if cropped and frame is not None else {}


def _mapping(settings: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    value = settings.get(name)
    if value is not None and not isinstance(value, Mapping):
        raise ValueError(f"{name} must be a mapping, to be shared with stock algorithms; it is {value!r}")
    return value or {}
