"""Films of policies.

H, W height and width of a picture.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
    :param path: the file to write, for instance .mp4
    :param max_decisions: stop filming after so many
    :return: the return of the episode so far
    :raises ImportError: without the package ``av`` (extra ``video``)
    :raises ValueError: if the environment renders no pictures, or PyAV knows no format of the file's suffix
    """
    fps = float(environment.metadata.get("render_fps", 30))  # type: ignore[arg-type]
    observation = environment.reset()
    total = 0.0
    with film_file(path, fps) as add:
        for _ in range(max_decisions):
            add(_picture(environment))
            action, _ = model.predict(observation, deterministic=True)  # type: ignore[arg-type]
            observation, rewards, dones, _ = environment.step(action)
            total += float(rewards[0])
            if dones[0]:
                break
    return total


@contextmanager
def film_file(path: Path, fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    """
    A film in H.264, complete when the context ends.

    :param path: the file to write; its suffix names the container
    :param fps: pictures per second
    :return: a function that adds a picture, uint8 ``(H, W, 3)``, all of one size; an odd last row or column is cut off
    :raises ImportError: without the package ``av`` (extra ``video``)
    :raises ValueError: if PyAV knows no format of the file's suffix
    """
    try:
        import av
    except ImportError as error:
        raise ImportError("films need the package av: pip install 'sb3-crc[video]'") from error

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
        stream.pix_fmt = "yuv420p"
        sides: list[int] = []

        def add(picture: np.ndarray) -> None:
            if not sides:
                sides.extend(side - side % 2 for side in picture.shape[:2])  # the codec takes even sides only
                stream.height, stream.width = sides
            even = np.ascontiguousarray(picture[: sides[0], : sides[1]])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")))

        yield add
        container.mux(stream.encode())


def _picture(environment: VecEnv) -> np.ndarray:
    picture = environment.render("rgb_array")
    if picture is None:
        raise ValueError("the environment renders no pictures: make it with render_mode='rgb_array'")
    return picture
