"""What ``sb3-crc film`` writes: an episode with what the decoder paints, what the critic looks at, and the latent over time.

T decisions, H, W height and width, Z latent.
"""

from pathlib import Path
from typing import Any

import numpy as np

from sb3_crc.analysis.films import film_file
from sb3_crc.analysis.networks import reconstruct
from sb3_crc.analysis.saliency import q_saliency, saliency_on_motion
from sb3_crc.analysis.subjects import Subject
from sb3_crc.analysis.tables import number, write_lines, write_rows

#: Of the film in pixels, even as H.264 wants it
DOTS_PER_INCH, WIDTH, HEIGHT = 100, 9.6, 6.4
COMPONENTS = 4
#: Of an episode's saliency, what is drawn at full strength
BRIGHTEST = 99.5
EXPLANATION = """\
{name}, episode {episode}: {decisions} decisions, return {total:.1f}.

- **frame**: the newest one of the stack that the policy sees.
{reconstruction}- **saliency**: |d min Q(s, a) / d pixel| of the newest frame, summed over its channels, the action held;
  relative to the {brightest} % brightest of the episode. It says where a small change of a pixel would change the value, not
  why.
- **latent**: its first {components} principal components in this episode. **reward** of each decision. **value**: min Q(s, a).

Saliency on what moves: **{share}** of it lies on the {area} of the pixels that differ from the episode's median frame. An even
map, chance, would have {area} there; under a camera that follows the body everything moves, and the number says nothing."""


def write_film(subject: Subject, folder: Path, *, episode: int = 0) -> list[Path]:
    """
    Write ``film.mp4``, a still of its middle ``film.png``, ``film.csv``, ``film.json`` (of each decision) and ``film.md``.

    :param subject: the model
    :param folder: to write to
    :param episode: of its rollout
    :return: what was written
    :raises ValueError: if the rollout has no such episode, or the policy reads vectors beside the picture
    """
    rollout = subject.rollout
    rows = np.flatnonzero(rollout.episodes == episode)
    if not len(rows):
        raise ValueError(f"there is no episode {episode} in the rollout, only 0 to {rollout.episodes.max()}")
    model = subject.policy.load()
    images, frames = rollout.observations[rows], rollout.newest_frames[rows]
    maps = q_saliency(model, images, rollout.actions[rows], frames.shape[1])
    painted = reconstruct(model, images)
    on_motion, area = saliency_on_motion(maps, frames)

    panels = {"frame": _pictures(frames.astype(np.float32) / 255)}
    if painted is not None:
        panels["reconstruction"] = _pictures(painted[:, -frames.shape[1] :])
    panels["saliency of min Q"] = _over(panels["frame"], maps)
    traces = {
        "latent": principal_components(rollout.latents[rows], COMPONENTS),
        "reward": rollout.rewards[rows, None],
        "value": rollout.values[rows, None],
    }
    folder.mkdir(parents=True, exist_ok=True)
    background, boxes, cursor = _background(subject.name, panels, traces)
    shown = [_composed(background, boxes, cursor, panels, time) for time in range(len(rows))]
    written = [
        _write_video(shown, folder / "film.mp4", float(rollout.about["render_fps"])),
        _still(shown, folder / "film.png"),
    ]
    table = [
        {
            "decision": int(rollout.steps[row]),
            "reward": float(rollout.rewards[row]),
            "value": float(rollout.values[row]),
            "saliency": float(maps[time].sum()),
            "saliency_on_motion": float(on_motion[time]),
            "moving_pixels": float(area[time]),
        }
        for time, row in enumerate(rows)
    ]
    written += write_rows(table, folder, "film")
    text = EXPLANATION.format(
        name=subject.name,
        episode=episode,
        decisions=len(rows),
        total=rollout.rewards[rows].sum(),
        reconstruction="- **reconstruction**: what the decoder paints of its latent.\n" if painted is not None else "",
        brightest=f"{100 - BRIGHTEST:.1f}",
        components=COMPONENTS,
        share=number(100 * _mean(on_motion), ".0f") + " %",
        area=number(100 * _mean(area), ".1f") + " %",
    )
    return [*written, write_lines(["# Film", "", text], folder / "film.md")]


def principal_components(latents: np.ndarray, count: int) -> np.ndarray:
    """
    :param latents: ``(T, Z)``
    :param count: how many
    :return: ``(T, count or fewer)``, in units of the standard deviation of the first
    """
    centred = latents.astype(np.float64) - latents.mean(axis=0)
    basis, singular, _ = np.linalg.svd(centred, full_matrices=False)
    components = basis[:, :count] * singular[:count]
    return np.asarray(components / max(components.std(axis=0).max(), 1e-12))


def _pictures(images: np.ndarray) -> np.ndarray:
    """Floats ``(T, 3 or 1, H, W)`` to bytes ``(T, H, W, 3)``."""
    colours = np.repeat(images, 3, axis=1) if images.shape[1] == 1 else images[:, :3]
    return np.asarray((colours.clip(0, 1) * 255).round().astype(np.uint8).transpose(0, 2, 3, 1))


def _over(pictures: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """Grey and dim pictures, with the saliency in colours over them."""
    import matplotlib

    strength = (maps / max(float(np.percentile(maps, BRIGHTEST)), 1e-12)).clip(0, 1)[..., None]
    grey = pictures.mean(axis=-1, keepdims=True) / 255 * 0.5
    colours = matplotlib.colormaps["inferno"](strength[..., 0])[..., :3]
    return np.asarray(((grey * (1 - strength) + colours * strength) * 255).round().astype(np.uint8))


def _background(name: str, panels: dict[str, np.ndarray], traces: dict[str, np.ndarray]) -> tuple[np.ndarray, Any, Any]:
    """Everything that stands still, drawn once; where the panels belong, and where the traces are at each time."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, HEIGHT), dpi=DOTS_PER_INCH)
    canvas = FigureCanvasAgg(figure)
    upper = figure.add_gridspec(1, len(panels), left=0.03, right=0.97, top=0.88, bottom=0.45, wspace=0.06)
    lower = figure.add_gridspec(3, 1, left=0.08, right=0.97, top=0.4, bottom=0.09, hspace=0.12, height_ratios=(2, 1, 1))
    figure.suptitle(name, fontsize=12)
    pictures = []
    for index, title in enumerate(panels):
        axes = figure.add_subplot(upper[0, index])
        axes.set_title(title, fontsize=10)
        axes.set_axis_off()
        pictures.append(axes)
    plots = []
    for index, (title, values) in enumerate(traces.items()):
        axes = figure.add_subplot(lower[index, 0])
        axes.plot(values, linewidth=1.2)
        axes.set_xlim(0, max(len(values) - 1, 1))
        axes.set_ylabel(title, fontsize=9)
        axes.tick_params(labelsize=7, labelbottom=index == len(traces) - 1)
        axes.grid(alpha=0.3)
        plots.append(axes)
    plots[-1].set_xlabel("decision", fontsize=9)
    canvas.draw()  # type: ignore[no-untyped-call]
    rgba = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    drawn = rgba[..., :3].copy()
    height = len(drawn)
    boxes = [
        _square(axes.get_window_extent(), height, panels[title].shape[1:3])
        for axes, title in zip(pictures, panels, strict=True)
    ]
    times = np.arange(len(next(iter(traces.values()))))
    columns = plots[0].transData.transform(np.column_stack([times, times]))[:, 0].round().astype(int)
    extents = [axes.get_window_extent() for axes in plots]
    spans = [(height - round(extent.y1), height - round(extent.y0)) for extent in extents]
    return drawn, boxes, (columns, spans)


def _square(extent: Any, height: int, size: tuple[int, ...]) -> tuple[int, int, int, int]:
    """The largest box of the picture's proportions in the middle of the extent: top, left, height, width."""
    scale = min(extent.height / size[0], extent.width / size[1])
    rows, columns = int(size[0] * scale), int(size[1] * scale)
    top = height - round(extent.y0 + (extent.height + rows) / 2)
    return top, round(extent.x0 + (extent.width - columns) / 2), rows, columns


def _composed(background: np.ndarray, boxes: Any, cursor: Any, panels: dict[str, np.ndarray], time: int) -> np.ndarray:
    shown = background.copy()
    for (top, left, rows, columns), pictures in zip(boxes, panels.values(), strict=True):
        picture = pictures[time]
        enlarged = picture[np.arange(rows) * len(picture) // rows][:, np.arange(columns) * picture.shape[1] // columns]
        shown[top : top + rows, left : left + columns] = enlarged
    columns_of_time, spans = cursor
    column = min(int(columns_of_time[time]), shown.shape[1] - 1)
    for top, bottom in spans:
        shown[top:bottom, column - 1 : column + 1] = (200, 30, 30)
    return shown


def _write_video(pictures: list[np.ndarray], path: Path, fps: float) -> Path:
    with film_file(path, fps) as add:
        for picture in pictures:
            add(picture)
    return path


def _still(pictures: list[np.ndarray], path: Path) -> Path:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, HEIGHT))
    figure.figimage(pictures[len(pictures) // 2], resize=True)
    figure.savefig(path, dpi=figure.dpi)
    return path


def _mean(values: np.ndarray) -> float:
    return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")
