"""DMControl-GB's colours: of the floor, the body and the sky, drawn anew for each episode.

Hansen & Wang 2021 (arXiv 2011.13389), as its code does it, but written into the compiled model.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sb3_crc.envs.distractions.clips import UNREADABLE
from sb3_crc.envs.distractions.textures import BODY, GRID, SKYBOX, Scene

#: dm_control's own colours, RGB in [0, 1]
DEFAULT = {
    "grid_rgb1": (0.1, 0.2, 0.3),
    "grid_rgb2": (0.2, 0.3, 0.4),
    "self_rgb": (0.7, 0.5, 0.3),
    "skybox_rgb": (0.4, 0.6, 0.8),
}
#: Standard deviation of the benchmark's tables, before they are cut off at 0 and 1
SPREAD = {"color_easy": 0.1, "color_hard": 0.2}
ENTRIES = 100
#: Of the generated tables
TABLE_SEED = 0
#: The benchmark's tables: sha256 of their numbers, rounded to six digits
ORIGINAL = {
    "color_easy": "0353b674cb119fc7f5663ee29b226a8cc59430c82d718bc15ff432da364be44b",
    "color_hard": "7456d0374ec5642d7d6e367d0576d76d3f1367b4b85665d44188c51cb9d610d2",
}

Table = Mapping[str, np.ndarray]


class Colours:
    """
    DMControl-GB's color_easy and color_hard: at each reset ``RandomState(seed).randint`` draws one of a table's entries.

    :param mode: which
    :param data: a table, see :func:`read_table`; None: the generated one
    """

    visible = True

    def __init__(self, mode: str, data: Path | None) -> None:
        self._table, what = (generated_table(mode), "generated") if data is None else read_table(data, mode)
        self.label = f"{mode} ({what})"
        self._paint: tuple[Scene, Paint] | None = None
        self._entry = 0
        self.restart(None)

    def restart(self, seed: int | None) -> None:
        """:param seed: of the draws"""
        self._rng = np.random.RandomState(seed)

    def begin(self, scene: Scene) -> None:
        """Draw colours; they stay for the episode."""
        self._entry = int(self._rng.randint(len(self._table["self_rgb"])))
        self._apply(scene)

    def advance(self) -> None:
        """Nothing moves."""

    def draw(self, render: Callable[..., np.ndarray], **settings: Any) -> np.ndarray:
        """:return: the picture as it is: the scene has the colours"""
        return render(**settings)

    def get_state(self) -> dict[str, Any]:
        """:return: the entry, and where the draws stand"""
        return {"label": self.label, "entry": self._entry, "random": self._rng.get_state(legacy=False)}

    def set_state(self, state: dict[str, Any], scene: Scene) -> None:
        """:param state: of :meth:`get_state`; :param scene: is painted"""
        self._rng.set_state(state["random"])
        self._entry = state["entry"]
        self._apply(scene)

    def _apply(self, scene: Scene) -> None:
        if self._paint is None or self._paint[0] is not scene:
            self._paint = scene, Paint(scene)
        self._paint[1].apply({name: values[self._entry] for name, values in self._table.items()})


def generated_table(mode: str) -> Table:
    """
    :param mode: "color_easy" or "color_hard"
    :return: colours distributed like the benchmark's, each ``(100, 3)`` in [0, 1]; always the same
    """
    rng = np.random.RandomState(TABLE_SEED)
    drawn = {
        name: rng.normal(DEFAULT[name], SPREAD[mode], (ENTRIES, 3)).clip(0, 1)
        for name in ("grid_rgb1", "self_rgb", "skybox_rgb")
    }
    return {**drawn, "grid_rgb2": (drawn["grid_rgb1"] + 0.1).clip(0, 1)}


def read_table(path: Path, mode: str) -> tuple[Table, str]:
    """
    :param path: an .npz or .json file, or a folder that holds ``<mode>.npz`` or ``<mode>.json``
    :param mode: "color_easy" or "color_hard"
    :return: colours, each ``(entries, 3)`` in [0, 1], and what they are
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: naming the file, if it holds something else
    """
    candidates = [path / f"{mode}.npz", path / f"{mode}.json"] if path.is_dir() else [path]
    found = next((candidate for candidate in candidates if candidate.exists()), None)
    if found is None:
        raise FileNotFoundError(f"{mode} needs a table of colours: there is no {' or '.join(map(str, candidates))}")
    try:
        content: Any = dict(np.load(found)) if found.suffix == ".npz" else json.loads(found.read_text(encoding="utf-8"))
        if isinstance(content, list):  # one mapping per entry
            content = {name: [entry[name] for entry in content] for name in DEFAULT}
        table = {name: np.array(content[name], np.float64) for name in DEFAULT}
    except (*UNREADABLE, KeyError, TypeError) as error:
        raise ValueError(f"{found} is no table of colours with {', '.join(DEFAULT)}: {error!r}") from error
    for name, values in table.items():
        if values.ndim != 2 or values.shape[1] != 3 or len(values) != len(table["self_rgb"]) or not len(values):
            raise ValueError(f"{found}: {name} has shape {values.shape}; it must be (entries, 3), as many as self_rgb")
        if not ((values >= 0) & (values <= 1)).all():  # NaN too
            raise ValueError(f"{found}: {name} has values outside [0, 1]")
    numbers = np.concatenate([table[name].ravel() for name in DEFAULT]).round(6)
    digest = hashlib.sha256(numbers.astype("<f8").tobytes()).hexdigest()
    return table, "DMControl-GB's table" if digest == ORIGINAL[mode] else f"table {found.name}, {digest[:8]}"


class Paint:
    """
    Recolours a scene as if it had been compiled with other colours, to one grey level.

    :param scene: with dm_control's own colours
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        sky, grid = scene.texture(SKYBOX), scene.texture(GRID)
        self._is_mark = (sky == 255).all(axis=2)
        # A gradient from black: each colour is a shade of one. The sum of the channels tells the shade more finely than one
        self._shade = sky.sum(axis=2, dtype=np.uint16)
        levels = [np.asarray(np.array(DEFAULT[name]) * 255, np.uint8) for name in ("grid_rgb1", "grid_rgb2")]
        self._is_first, self._is_second = ((grid == level).all(axis=2) for level in levels)
        # The marks at its edge keep their colour, which by chance is that of the second squares
        self._is_second[[0, -1]] = self._is_second[:, [0, -1]] = False

    def apply(self, colours: Mapping[str, np.ndarray]) -> None:
        """:param colours: RGB in [0, 1] by the names of :data:`DEFAULT`"""
        physics = self._scene.physics
        shades = (np.arange(3 * 256)[:, None] + 1.5) / sum(DEFAULT["skybox_rgb"])  # 1.5: three channels were cut off
        lookup = (shades * colours["skybox_rgb"]).clip(0, 255).astype(np.uint8)
        sky, grid = self._scene.texture(SKYBOX), self._scene.texture(GRID)
        np.take(lookup, self._shade, axis=0, out=sky)
        sky[self._is_mark] = 255
        grid[self._is_first] = (colours["grid_rgb1"] * 255).astype(np.uint8)
        grid[self._is_second] = (colours["grid_rgb2"] * 255).astype(np.uint8)
        physics.model.mat_rgba[self._scene.material(BODY), :3] = colours["self_rgb"]
        for name in (SKYBOX, GRID):
            self._scene.upload(name)
