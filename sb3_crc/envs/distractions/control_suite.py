"""The Distracting Control Suite: camera, colours and background vary together.

Stone et al. 2021 (arXiv 2101.02722). The ranges are the paper's; unlike its code, all that is drawn follows from the seed, and
the camera is moved in its own frame, so that one rule serves cameras from the side and from above.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sb3_crc.envs.distractions.clips import Clip, ProceduralClip, StoredClip, bilinear, clips_of
from sb3_crc.envs.distractions.labels import what_they_are
from sb3_crc.envs.distractions.textures import GRID, SKYBOX, Scene

#: beta, the scale of camera and colours
SCALES = {"dcs_easy": 0.1, "dcs_medium": 0.2, "dcs_hard": 0.3}
#: How many of the clips are shown
CLIPS = {"dcs_easy": 4, "dcs_medium": 8, "dcs_hard": 60}
#: Opacity of the floor, behind which the sky is seen
FLOOR_ALPHA = {"reacher": 0.0, "walker": 1.0, "cheetah": 1.0}
OTHER_FLOOR_ALPHA = 0.3
#: Of the sky, one square picture for all its faces: at 800, dm_control's own, uploading takes ten times as long
SKY_SIDE = 128

Render = Callable[..., np.ndarray]
State = dict[str, Any]


class ControlSuite:
    """
    Camera, colours of all materials and the sky's picture: drawn at each reset and, if dynamic, moving with every step.

    :param mode: "dcs_easy", "dcs_medium" or "dcs_hard"
    :param data: folder of clips, DAVIS 2017 in the paper; None: procedural ones
    :param domain: of the suite
    :param camera_id: which camera moves
    :param action_repeat: control steps per decision
    :param dynamic: False: what a reset draws stays for the episode
    :raises ValueError: for MuJoCo's free camera, which cannot be moved; for clips as :class:`StoredClip`
    """

    visible = True

    def __init__(
        self, mode: str, data: Path | None, *, domain: str, camera_id: int, action_repeat: int, dynamic: bool = True
    ) -> None:
        if camera_id < 0:
            raise ValueError(f"{mode} moves one of the task's cameras; camera_id={camera_id} is MuJoCo's free camera")
        self._scale = SCALES[mode]
        self._paths = None if data is None else clips_of(data, mode)[: CLIPS[mode]]
        self._count = CLIPS[mode] if self._paths is None else len(self._paths)
        for path in self._paths or ():  # now, so that a broken clip is not found out after hours
            StoredClip(path, SKY_SIDE)
        what = "procedural" if self._paths is None else what_they_are(self._paths, mode)
        self.label = f"{mode} ({what}{'' if dynamic else ', static'})"
        self._floor_alpha = FLOOR_ALPHA.get(domain, OTHER_FLOOR_ALPHA)
        self._from_above = domain == "reacher"
        self._camera, self._repeat, self._dynamic = camera_id, action_repeat, dynamic
        self._scene: Scene | None = None
        self._clip: Clip | None = None
        self._base = self._colours = np.zeros((0, 3))
        self._pose, self._velocity = np.zeros(4), np.zeros(4)  # horizontal, vertical (rad), radius (log), roll (rad)
        self._clip_number, self._frame, self._direction = 0, 0, 1
        self.restart(None)

    def restart(self, seed: int | None) -> None:
        """:param seed: of everything that is drawn"""
        self._rng = np.random.RandomState(seed)

    def begin(self, scene: Scene) -> None:
        """Draw camera, colours, clip, its first frame and direction."""
        self._enter(scene)
        scale, rng = self._scale, self._rng
        self._colours = (self._base + rng.uniform(-scale, scale, self._base.shape)).clip(0, 1)
        self._pose, self._velocity = rng.uniform(*self._limits(scene)), np.zeros(4)
        self._clip_number = int(rng.randint(self._count))
        self._load_clip()
        self._frame = int(rng.randint(len(self._require_clip())))
        self._direction = int(rng.choice((-1, 1)))
        self._show(scene)

    def advance(self) -> None:
        """Move as often as control steps were taken."""
        if not self._dynamic or self._scene is None:
            return
        for _ in range(self._repeat):
            self._move(self._scene)
        self._show(self._scene)

    def draw(self, render: Render, **settings: Any) -> np.ndarray:
        """:return: the picture through the camera where it is now; the simulator's own camera is put back"""
        if self._scene is None:
            return np.asarray(render(**settings))
        data = self._scene.physics.data
        own = data.cam_xpos[self._camera].copy(), data.cam_xmat[self._camera].copy()
        try:
            data.cam_xpos[self._camera], data.cam_xmat[self._camera] = self._placed(*own, self._scene)
            return np.array(render(**settings))
        finally:
            data.cam_xpos[self._camera], data.cam_xmat[self._camera] = own

    def get_state(self) -> State:
        """:return: everything that was drawn, and where the draws stand"""
        return {
            "label": self.label,
            "colours": self._colours.copy(),
            "pose": self._pose.copy(),
            "velocity": self._velocity.copy(),
            "clip": self._clip_number,
            "frame": self._frame,
            "direction": self._direction,
            "random": self._rng.get_state(legacy=False),
        }

    def set_state(self, state: State, scene: Scene) -> None:
        """:param state: of :meth:`get_state`; :param scene: is changed accordingly"""
        self._enter(scene)
        self._rng.set_state(state["random"])
        self._colours, self._pose, self._velocity = (state[name].copy() for name in ("colours", "pose", "velocity"))
        self._clip_number, self._frame, self._direction = state["clip"], state["frame"], state["direction"]
        self._load_clip()
        self._show(scene)

    def _enter(self, scene: Scene) -> None:
        if self._scene is scene:
            return
        self._scene = scene
        self._base = np.array(scene.physics.model.mat_rgba[:, :3], np.float64)
        scene.physics.model.mat_rgba[scene.material(GRID), 3] = self._floor_alpha
        scene.shrink_skybox(SKY_SIDE)

    def _load_clip(self) -> None:
        number = self._clip_number
        self._clip = ProceduralClip(number, SKY_SIDE) if self._paths is None else StoredClip(self._paths[number], SKY_SIDE)

    def _require_clip(self) -> Clip:
        assert self._clip is not None
        return self._clip

    def _limits(self, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest of horizontal, vertical, log of the radius, roll."""
        scale = self._scale
        turn = scale * math.pi / 2
        lowest, highest = -turn, turn
        if not self._from_above:  # neither below the floor nor over the top
            position, target = self._position_and_target(scene)
            offset = position - target
            elevation = math.asin(np.clip(offset[2] / np.linalg.norm(offset), -1, 1))
            lowest, highest = max(lowest, min(-elevation, 0.0)), min(highest, max(math.pi / 2 - elevation, 0.0))
        near, far = math.log(1 - 0.5 * scale), math.log(1 + 1.5 * scale)
        return np.array([-turn, lowest, near, -turn]), np.array([turn, highest, far, turn])

    def _move(self, scene: Scene) -> None:
        scale, rng = self._scale, self._rng
        self._colours += rng.normal(0, 0.03 * scale, self._colours.shape)
        self._colours = self._colours.clip(self._base - scale, self._base + scale).clip(0, 1)
        position, target = self._position_and_target(scene)
        radius = float(np.linalg.norm(position - target))
        spread = np.array([*[0.1 * scale / radius] * 3, scale * math.pi / 300])
        fastest = np.array([*[0.4 * scale / radius] * 3, scale * math.pi / 50])
        self._velocity = (self._velocity + rng.normal(0, spread)).clip(-fastest, fastest)
        lowest, highest = self._limits(scene)
        moved = self._pose + self._velocity
        self._velocity[(moved < lowest) | (moved > highest)] = 0
        self._pose = moved.clip(lowest, highest)
        last = len(self._require_clip()) - 1
        if not 0 <= self._frame + self._direction <= last:
            self._direction = -self._direction
        self._frame += self._direction

    def _show(self, scene: Scene) -> None:
        scene.physics.model.mat_rgba[:, :3] = self._colours
        scene.texture(SKYBOX)[...] = bilinear(self._require_clip().frame(self._frame), SKY_SIDE)
        scene.upload(SKYBOX)

    def _position_and_target(self, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
        data = scene.physics.data
        position, orientation = data.cam_xpos[self._camera].copy(), data.cam_xmat[self._camera]
        return position, self._target(position, orientation, scene)

    def _target(self, position: np.ndarray, orientation: np.ndarray, scene: Scene) -> np.ndarray:
        """What the camera looks at: the point of its line of sight that is nearest to the scene's centre of mass."""
        forward = -np.reshape(orientation, (3, 3))[:, 2]
        distance = max(float((scene.physics.data.subtree_com[0] - position) @ forward), 0.5)
        return np.asarray(position + distance * forward)

    def _placed(self, position: np.ndarray, orientation: np.ndarray, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
        axes = np.reshape(orientation, (3, 3))  # columns: right, up, backward
        target = self._target(position, orientation, scene)
        horizontal, vertical, log_radius, roll = self._pose
        around = axes[:, 1] if self._from_above else np.array([0.0, 0.0, 1.0])
        turned = _rotation(around, horizontal) @ _rotation(axes[:, 0], -vertical)
        moved = target + math.exp(log_radius) * turned @ (position - target)
        return moved, (turned @ axes @ _rotation(np.array([0.0, 0.0, 1.0]), roll)).ravel()


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' formula, ``(3, 3)``."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross)
