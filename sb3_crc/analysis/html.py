"""The latents in the plane as a page of their own: the frame of a point is shown where the pointer is.

n decisions, k clusters, A action.
"""

import base64
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sb3_crc.analysis.figures import cluster_colours, cluster_names
from sb3_crc.analysis.subjects import Subject

#: Side of a frame in pixels, and how many are kept in all: a page stays under some 9 MB, half of it plotly itself
SIDE, FRAMES = 48, 2_000
COLOURS = 32
_SHOW_FRAME = """
const picture = document.createElement('img');
picture.style.cssText = 'position:fixed;display:none;width:144px;border:1px solid #444;image-rendering:pixelated;' +
  'pointer-events:none;z-index:10';
document.body.appendChild(picture);
const plot = document.getElementById('{plot_id}');
plot.on('plotly_hover', function (event) {
  const source = event.points[0].customdata;
  if (!source) return;
  picture.src = source;
  picture.style.left = Math.min(event.event.clientX + 16, window.innerWidth - 150) + 'px';
  picture.style.top = Math.max(event.event.clientY - 160, 0) + 'px';
  picture.style.display = 'block';
});
plot.on('plotly_unhover', function () { picture.style.display = 'none'; });
"""


def write_html(
    subjects: Sequence[Subject], planes: Sequence[np.ndarray], labels: Sequence[np.ndarray], centers: np.ndarray, path: Path
) -> Path:
    """
    Write one file that needs no network: plotly and the frames are in it.

    :param subjects: the models
    :param planes: of each, ``(n, 2)``
    :param labels: of each, ``(n,)``
    :param centers: mean actions ``(k, A)``
    :param path: to write
    :return: the path
    """
    from plotly.graph_objects import Figure, Scatter  # type: ignore[import-untyped]
    from plotly.subplots import make_subplots  # type: ignore[import-untyped]

    figure: Figure = make_subplots(rows=len(subjects), cols=1, subplot_titles=[subject.name for subject in subjects])
    share = max(1, FRAMES // len(subjects))
    for row, (subject, plane, own) in enumerate(zip(subjects, planes, labels, strict=True), start=1):
        rollout = subject.rollout
        kept = set(np.linspace(0, len(rollout) - 1, min(share, len(rollout))).astype(int).tolist())
        frames = [data_uri(frame) if index in kept else None for index, frame in enumerate(rollout.newest_frames)]
        texts = [_text(subject, index) for index in range(len(rollout))]
        for cluster, (name, colour) in enumerate(zip(cluster_names(centers), cluster_colours(len(centers)), strict=True)):
            chosen = np.flatnonzero(own == cluster)
            points = Scatter(
                x=plane[chosen, 0].round(2).tolist(),
                y=plane[chosen, 1].round(2).tolist(),
                mode="markers",
                marker={"size": 6, "color": f"rgb({', '.join(str(round(255 * part)) for part in colour)})"},
                name=name,
                legendgroup=name,
                showlegend=row == 1,
                customdata=[frames[index] for index in chosen],
                text=[texts[index] for index in chosen],
                hovertemplate="%{text}<extra></extra>",
            )
            figure.add_trace(points, row=row, col=1)
    figure.update_xaxes(visible=False)
    figure.update_yaxes(visible=False)
    figure.update_layout(
        height=90 + 480 * len(subjects), width=900, template="plotly_white", legend={"itemsizing": "constant"}
    )
    figure.write_html(path, include_plotlyjs=True, post_script=_SHOW_FRAME, config={"displaylogo": False})
    return path


def data_uri(frame: np.ndarray) -> str:
    """:param frame: uint8 ``(3 or 1, H, W)``; :return: a small PNG that stands in the page itself"""
    from PIL import Image

    picture = np.broadcast_to(frame, (3, *frame.shape[1:])).transpose(1, 2, 0) if len(frame) == 1 else frame.transpose(1, 2, 0)
    image = Image.fromarray(np.ascontiguousarray(picture))
    image.thumbnail((SIDE, SIDE))
    stream = io.BytesIO()
    image.quantize(COLOURS).save(stream, "PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(stream.getvalue()).decode()}"


def _text(subject: Subject, index: int) -> str:
    rollout = subject.rollout
    action = " ".join(f"{value:+.2f}" for value in rollout.actions[index][:4])
    place = f"episode {rollout.episodes[index]}, decision {rollout.steps[index]}"
    return f"{place}<br>action {action}<br>reward {rollout.rewards[index]:.2f}, value {rollout.values[index]:.1f}"
