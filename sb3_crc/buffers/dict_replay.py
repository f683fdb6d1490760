"""FrameReplayBuffer for observations that are an image and more."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_crc.buffers.replay import FrameReplayBuffer
from sb3_crc.buffers.rows import as_row, same_bytes
from sb3_crc.image_spaces import image_key


class DictFrameReplayBuffer(FrameReplayBuffer, DictReplayBuffer):  # type: ignore[override]
    """
    FrameReplayBuffer for Dict observations with one image among them: its frames are stored once, vectors as in SB3.

    Arguments are those of :class:`FrameReplayBuffer`; the samples' observations are mappings.

    :raises ValueError: if not exactly one entry of ``observation_space`` is an image
    """

    def __init__(self, buffer_size: int, observation_space: spaces.Space[Any], *args: Any, **kwargs: Any):
        self.image_key = image_key(observation_space)
        super().__init__(buffer_size, observation_space, *args, **kwargs)
        assert isinstance(self.observation_space, spaces.Dict)
        rows = self.buffer_size, self.n_envs
        self.vectors, self.next_vectors = (
            {
                key: np.zeros((*rows, *shape), self.observation_space[key].dtype)
                for key, shape in self.obs_shape.items()
                if key != self.image_key
            }
            for _ in range(2)
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """:return: everything but the frames, by name"""
        stored = {"vectors": self.vectors, "next_vectors": self.next_vectors}
        return super().arrays() | {f"{part}/{key}": values for part, group in stored.items() for key, values in group.items()}

    def vector_shapes(self) -> dict[str, tuple[int, ...]]:
        """:return: shapes of what is stored beside the image, by key"""
        return {key: values.shape[2:] for key, values in self.vectors.items()}

    def _stacked_space(self) -> spaces.Box:
        space = self.observation_space[self.image_key]
        assert isinstance(space, spaces.Box)
        return space

    def _images(self, obs: Any) -> Any:
        return obs[self.image_key]

    def _continues(self, env: int, stack: np.ndarray, row: dict[str, np.ndarray]) -> bool:
        return super()._continues(env, stack, row) and all(
            same_bytes(values[self.pos - 1, env], row[f"vectors/{key}"][env]) for key, values in self.next_vectors.items()
        )

    def _vectors(self, obs: Any, next_obs: Any) -> dict[str, np.ndarray]:
        return {
            f"{part}/{key}": as_row(values, np.asarray(source[key]).reshape(values.shape[1:]))
            for part, source in (("vectors", obs), ("next_vectors", next_obs))
            for key, values in self.vectors.items()
        }

    def _observations(self, rows: np.ndarray, envs: np.ndarray, env: VecNormalize | None, *, following: bool) -> Any:
        vectors = self.next_vectors if following else self.vectors
        taken = self._normalize_obs({key: values[rows, envs] for key, values in vectors.items()}, env)
        assert isinstance(taken, dict)
        images = {self.image_key: self._frame_stacks(rows, envs, following)}
        return images | {key: self.to_torch(values) for key, values in taken.items()}
