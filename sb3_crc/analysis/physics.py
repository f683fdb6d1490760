"""The state of a dm_control simulator as named numbers."""

from typing import Any

import gymnasium as gym
import numpy as np


def physics_state(env: gym.Env[Any, Any]) -> dict[str, float]:
    """
    :param env: any
    :return: name -> number: each coordinate of the task's own observations, ``position[0]``, and MuJoCo's generalised
        positions and velocities by joint, ``qpos.slider`` (m or rad) and ``qvel.slider`` (m/s or rad/s), ``qpos.root[3]`` for
        joints of several coordinates; empty for environments without such a simulator
    """
    simulator = getattr(env.unwrapped, "_env", None)  # of Shimmy
    if not (hasattr(simulator, "task") and hasattr(simulator, "physics")):
        return {}
    assert simulator is not None
    physics = simulator.physics
    found: dict[str, float] = {}
    for name, value in simulator.task.get_observation(physics).items():
        found |= _numbered(name, np.ravel(value))
    model, data = physics.model, physics.data
    for name, values, starts in (("qpos", data.qpos, model.jnt_qposadr), ("qvel", data.qvel, model.jnt_dofadr)):
        ends = [*starts[1:], len(values)]
        for joint, (start, end) in enumerate(zip(starts, ends, strict=True)):
            found |= _numbered(f"{name}.{model.id2name(joint, 'joint') or joint}", values[start:end])
    return found


def _numbered(name: str, values: np.ndarray) -> dict[str, float]:
    if len(values) == 1:
        return {name: float(values[0])}
    return {f"{name}[{index}]": float(value) for index, value in enumerate(values)}
