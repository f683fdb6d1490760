"""What a run's folder has to show beside its scores: settings, command, instruments, pictures and films."""

from __future__ import annotations

import base64
import importlib.util
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_crc.experiments.runs import Run, find_runs

#: Beginnings of the names of logged values that are shown as instruments
INSTRUMENTS = ("train/", "representation/", "eval/", "rollout/", "generalization/", "time/updates_per_second")
#: Points that an instrument keeps, evenly spread over the run
POINTS = 150
#: Longer side of a picture on the page, in pixels
WIDEST = 1_100
FILMS, PICTURES = (".mp4",), (".png", ".jpg", ".jpeg")
#: Reconstructions that are kept of a run, evenly spread over it
RECONSTRUCTIONS = 8


@dataclass(frozen=True)
class Medium:
    """
    A picture or film that stands in the page itself.

    :param caption: what it is
    :param uri: "data:image/png;base64,..."
    """

    caption: str
    uri: str

    @property
    def is_film(self) -> bool:
        """Else it is a picture."""
        return self.uri.startswith("data:video/")


@dataclass(frozen=True)
class RunContents:
    """
    :param run: whose folder it is
    :param name: of it for people, which no other run on the page has
    :param settings: flat: "policy_kwargs.net_arch" -> value
    :param command: the line that began it, "" if it is not known
    :param provenance: machine, versions, revision, time; empty if unknown
    :param instruments: name -> agent steps and values
    """

    run: Run
    name: str
    settings: Mapping[str, Any]
    command: str
    provenance: Mapping[str, Any]
    instruments: Mapping[str, tuple[list[int], list[float]]]


def all_contents(folders: Sequence[Path]) -> list[RunContents]:
    """
    :param folders: of runs, or that contain some
    :return: what the files of each run say, finished or not
    :raises FileNotFoundError: if a folder does not exist
    :raises ValueError: if a file cannot be read, naming it
    """
    runs = list(find_runs(folders))
    names = [f"{run.method}, {run.task}, seed {run.seed}" for run in runs]
    several = {name for name in names if names.count(name) > 1}
    return [
        _contents(run, f"{name} ({run.folder})" if name in several else name) for run, name in zip(runs, names, strict=True)
    ]


def _contents(run: Run, name: str) -> RunContents:
    commands = sorted(run.folder.glob("*/command.txt"))
    command = commands[0].read_text(encoding="utf-8").strip() if commands else ""
    instruments = _instruments(run.folder / "progress.csv")
    return RunContents(run, name, dict(_flat(run.settings)), command, run.provenance, instruments)


def differing_settings(contents: Sequence[RunContents]) -> dict[str, list[str]]:
    """
    :param contents: of runs
    :return: setting -> its value in each run, "" where it has none, for the settings that are not the same in all
    """
    names = dict.fromkeys(name for one in contents for name in one.settings)
    values = {name: [str(one.settings.get(name, "")) for one in contents] for name in names}
    return {name: of_runs for name, of_runs in values.items() if len(set(of_runs)) > 1}


def run_media(contents: RunContents) -> Iterator[Medium]:
    """
    :param contents: of a run
    :return: the film of its policy, what its decoder painted over training, and pictures of its folder
    """
    who, folder = contents.name, contents.run.folder
    for path in sorted(path for path in folder.rglob("*") if path.suffix.lower() in FILMS):
        yield _film(path, f"{who}: {path.stem}")
    yield from _reconstructions(folder, who)
    pictures = [path for path in folder.rglob("*") if path.suffix.lower() in PICTURES]
    for path in sorted(path for path in pictures if path.name != "learning_curve.png"):  # drawn anew, to be touched
        yield _picture(path, f"{who}: {path.stem}")


def folder_media(folder: Path, runs: Sequence[Run]) -> Iterator[Medium]:
    """
    :param folder: that contains runs, or figures such as those of ``sb3-crc tsne``
    :param runs: whose own files are shown elsewhere
    :return: the pictures and films beside them
    """
    own = [run.folder.resolve() for run in runs]
    for path in sorted(folder.rglob("*")):
        inside = any(parent in own for parent in path.resolve().parents)
        if path.suffix.lower() in (*FILMS, *PICTURES) and not inside:
            caption = str(path.relative_to(folder).with_suffix(""))
            yield _film(path, caption) if path.suffix.lower() in FILMS else _picture(path, caption)


def _flat(settings: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in settings.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", value


def _instruments(path: Path) -> dict[str, tuple[list[int], list[float]]]:
    import pandas as pd

    if not path.exists() or not path.stat().st_size:
        return {}
    try:
        table = pd.read_csv(path)
        steps = table["time/total_timesteps"]
    except (OSError, ValueError, KeyError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    found = {}
    for name in sorted(column for column in table if str(column).startswith(INSTRUMENTS)):
        values = pd.to_numeric(table[name], errors="coerce")
        rows = np.flatnonzero(np.isfinite(values) & steps.notna())
        if len(rows) > 1:
            kept = rows[np.unique(np.linspace(0, len(rows) - 1, min(POINTS, len(rows))).astype(int))]
            found[str(name)] = steps.iloc[kept].astype(int).tolist(), [float(f"{value:.4g}") for value in values.iloc[kept]]
    return found


def _film(path: Path, caption: str) -> Medium:
    return Medium(caption, _uri("video/mp4", path.read_bytes()))


def _picture(source: Path | bytes, caption: str) -> Medium:
    from PIL import Image, UnidentifiedImageError

    try:
        image = Image.open(source if isinstance(source, Path) else io.BytesIO(source)).convert("RGB")
    except (OSError, UnidentifiedImageError) as error:
        raise ValueError(f"{source if isinstance(source, Path) else caption} is no picture: {error}") from error
    image.thumbnail((WIDEST, WIDEST))
    stream = io.BytesIO()
    image.quantize(128).save(stream, "PNG", optimize=True)
    return Medium(caption, _uri("image/png", stream.getvalue()))


def _reconstructions(folder: Path, who: str) -> Iterator[Medium]:
    """What ReconstructionImageCallback has logged for TensorBoard: frames above, what was painted of them below."""
    if not any(folder.glob("events.out.tfevents.*")) or importlib.util.find_spec("tensorboard") is None:
        return
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator  # type: ignore[import-untyped]

    events = EventAccumulator(str(folder), size_guidance={"images": 0, "scalars": 1})
    events.Reload()
    for tag in events.Tags()["images"]:
        images = events.Images(tag)
        for index in np.unique(np.linspace(0, len(images) - 1, min(RECONSTRUCTIONS, len(images))).astype(int)):
            image = images[index]
            yield _picture(image.encoded_image_string, f"{who}: {tag} after {image.step:,} agent steps")


def _uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
