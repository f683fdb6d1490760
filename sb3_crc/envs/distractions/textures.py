"""Pictures and colours inside a compiled MuJoCo model, changed in place: no second compilation, no new OpenGL context.

H, W height and width of a texture; a skybox is six square faces one below the other.
"""

from __future__ import annotations

from typing import Any

import numpy as np

SKYBOX, GRID, BODY = "skybox", "grid", "self"


class Scene:
    """
    The textures and materials of dm_control's common scene.

    :param physics: of a suite task
    :param task: for the message
    :raises ValueError: if the scene lacks any of them: then it cannot be distracted
    """

    def __init__(self, physics: Any, task: str) -> None:
        model = physics.model
        textures = {model.id2name(index, "texture"): index for index in range(model.ntex)}
        materials = {model.id2name(index, "material"): index for index in range(model.nmat)}
        lacking = [f"texture {name!r}" for name in (SKYBOX, GRID) if name not in textures]
        lacking += [f"material {name!r}" for name in (GRID, BODY) if name not in materials]
        if lacking:
            raise ValueError(
                f"{task} cannot be distracted: its scene has no {', no '.join(lacking)}; those of dm_control 1.0.50's "
                "suite all have them"
            )
        self.physics, self.model = physics, physics.model
        self._textures, self._materials = textures, materials

    def texture(self, name: str) -> np.ndarray:
        """:return: what the model holds, uint8 ``(H, W, 3)``, to be read and written; :meth:`upload` shows it"""
        model, index = self.physics.model, self._textures[name]
        height, width, channels = int(model.tex_height[index]), int(model.tex_width[index]), int(model.tex_nchannel[index])
        start = int(model.tex_adr[index])
        pixels: np.ndarray = model.tex_data[start : start + height * width * channels].reshape(height, width, channels)
        return pixels

    def material(self, name: str) -> int:
        """:return: its index in the model"""
        return self._materials[name]

    def geoms_of(self, name: str) -> np.ndarray:
        """:param name: of a material; :return: int ``(geoms,)``, the indices of the geoms that are made of it"""
        return np.flatnonzero(self.physics.model.geom_matid == self._materials[name])

    def shrink_skybox(self, side: int) -> None:
        """
        Make the skybox one square picture for all six faces: smaller ones are uploaded in less time.

        :param side: in pixels, at most that of a face
        """
        model, index = self.physics.model, self._textures[SKYBOX]
        model.tex_height[index] = model.tex_width[index] = side

    def upload(self, name: str) -> None:
        """Hand the texture over to OpenGL, which draws a copy of its own."""
        import mujoco

        physics = self.physics
        with physics.contexts.gl.make_current() as context:
            context.call(mujoco.mjr_uploadTexture, physics.model.ptr, physics.contexts.mujoco.ptr, self._textures[name])
