"""Films of policies."""

from fractions import Fraction
from pathlib import Path

import numpy as np
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv


def film(model: PolicyPredictor, environment: VecEnv, path: Path, *, max_decisions: int = 1_000) -> float:
    """
    Film one episode of the deterministic policy, one picture per decision, at the environment's own speed.

    :param model: any SB3 model, or a policy
    :param environment: one environment that renders ``rgb_array`` and knows its ``render_fps``
    :param path: the file to write, H.264 if it ends in .mp4
    :param max_decisions: stop filming after so many
    :return: the return of the episode so far
    :raises ImportError: without the package ``av`` (extra ``video``)
    """
    import av

    fps = float(environment.metadata.get("render_fps", 30))  # type: ignore[arg-type]
    observation = environment.reset()
    total = 0.0
    height, width = (side - side % 2 for side in _picture(environment).shape[:2])  # the codec takes even sides only
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for _ in range(max_decisions):
            picture = np.ascontiguousarray(_picture(environment)[:height, :width])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            action, _ = model.predict(observation, deterministic=True)  # type: ignore[arg-type]
            observation, rewards, dones, _ = environment.step(action)
            total += float(rewards[0])
            if dones[0]:
                break
        container.mux(stream.encode())
    return total


def _picture(environment: VecEnv) -> np.ndarray:
    picture = environment.render("rgb_array")
    if picture is None:
        raise ValueError("the environment renders no pictures: make it with render_mode='rgb_array'")
    return picture
