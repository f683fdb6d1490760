"""Commands that look into saved models: ``sb3-crc latents | tsne | correlate | probe | film | generalize``."""

import importlib.util
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from sb3_crc.console import in_one_line, say

app = typer.Typer()

Models = Annotated[
    list[Path], typer.Argument(help="models (.zip in the folder of their run), runs, or folders that contain runs")
]
Checkpoints = Annotated[bool, typer.Option("--checkpoints", help="Of each run also its rl_model_*_steps.zip, as curves.")]
Decisions = Annotated[int, typer.Option(min=1, help="of each rollout, at least; episodes are whole")]
Episodes = Annotated[int, typer.Option(min=1, help="of each rollout, at least")]
Output = Annotated[Path, typer.Option("--output", "-o", help="folder for figures, numbers and text")]
States = Annotated[int, typer.Option(min=4, help="observations that all models encode, about")]


@app.command()
@in_one_line
def latents(
    models: Models,
    checkpoints: Checkpoints = False,
    decisions: Decisions = 1_000,
    episodes: Episodes = 4,
    output: Output = Path("latents"),
) -> None:
    """Roll policies and keep latents, actions, frames, physics, values and returns in analysis/ of their runs."""
    from sb3_crc.analysis.latent_report import write_latents

    subjects = _gather(models, checkpoints, decisions, episodes, needs=("matplotlib",))
    with _timed("latents"):
        written = write_latents(subjects, output)
    _list(written)


@app.command()
@in_one_line
def tsne(
    models: Models,
    clusters: Annotated[int, typer.Option(help="of the actions, by k-means")] = 5,
    neighbours: Annotated[int, typer.Option(min=1, help="nearest ones that the purity looks at")] = 10,
    checkpoints: Checkpoints = False,
    decisions: Decisions = 1_000,
    episodes: Episodes = 4,
    output: Output = Path("tsne"),
) -> None:
    """Draw latents in the plane, coloured by clusters of the actions, and measure how pure the clusters are."""
    from sb3_crc.analysis.cluster_report import write_clusters

    subjects = _gather(models, checkpoints, decisions, episodes, needs=("sklearn", "plotly", "matplotlib"))
    with _timed("tsne"):
        written = write_clusters(subjects, output, clusters=clusters, neighbours=neighbours)
    _list(written)


@app.command()
@in_one_line
def correlate(
    models: Models,
    null: Annotated[
        list[Path] | None, typer.Option(help="models of the same methods, other seeds: how alike those are")
    ] = None,
    states: States = 1_000,
    checkpoints: Checkpoints = False,
    decisions: Decisions = 1_000,
    episodes: Episodes = 4,
    output: Output = Path("correlate"),
) -> None:
    """Compare latents of the same observations: the paper's heat map, CKA and CCA, beside two seeds of one method."""
    from sb3_crc.analysis.similarity_report import write_similarities

    subjects = _gather([*models, *(null or [])], checkpoints, decisions, episodes, needs=("matplotlib",))
    with _timed("correlate"):
        written = write_similarities(subjects, output, states=states)
    _list(written)


@app.command()
@in_one_line
def probe(
    models: Models,
    states: States = 2_000,
    own_states: Annotated[bool, typer.Option("--own-states", help="Each model on its own rollout: no comparison.")] = False,
    checkpoints: Checkpoints = False,
    decisions: Decisions = 1_000,
    episodes: Episodes = 4,
    output: Output = Path("probe"),
) -> None:
    """Read the physics state off the latents by ridge regression, beside an untrained encoder and a PCA of the pixels."""
    from sb3_crc.analysis.probe_report import write_probes

    subjects = _gather(models, checkpoints, decisions, episodes, needs=("matplotlib",))
    with _timed("probe"):
        written = write_probes(subjects, output, states=states, own_states=own_states)
    _list(written)


@app.command()
@in_one_line
def film(
    model: Annotated[Path, typer.Argument(help="a model (.zip in the folder of its run), or a run")],
    episode: Annotated[int, typer.Option(min=0, help="of the rollout")] = 0,
    decisions: Decisions = 1_000,
    episodes: Episodes = 4,
    output: Output = Path("film"),
) -> None:
    """Film an episode with the reconstruction, what the critic looks at, the latent, reward and value."""
    from sb3_crc.analysis.policies import find_policies
    from sb3_crc.analysis.saliency_film import write_film

    if len(find_policies([model])) > 1:
        raise ValueError(f"{model} contains several runs; a film is of one model")
    (subject,) = _gather([model], False, decisions, episodes, needs=("av", "matplotlib"))
    with _timed("film"):
        written = write_film(subject, output, episode=episode)
    _list(written)


@app.command()
@in_one_line
def generalize(
    models: Models,
    modes: Annotated[
        str, typer.Option(help="separated by commas; none: where it was trained")
    ] = "none,color_easy,color_hard,video_easy,video_hard",
    data: Annotated[
        Path | None, typer.Option(help="folder with DMControl-GB's color_*.npz and folders video_*; else generated ones")
    ] = None,
    evaluation_episodes: Annotated[int, typer.Option("--episodes", min=1, help="of each mode")] = 10,
    checkpoints: Checkpoints = False,
    output: Output = Path("generalization"),
) -> None:
    """Evaluate policies in distracted environments, beside published scores; curves, where a callback watched a training."""
    from sb3_crc.analysis.generalization import generalize as evaluate
    from sb3_crc.analysis.generalization_report import Generalization, write_generalization
    from sb3_crc.analysis.policies import find_policies

    names = [name.strip() for name in modes.split(",") if name.strip()]
    evaluated = []
    for policy in find_policies(models, checkpoints=checkpoints):
        results = evaluate(policy, names, data=data, episodes=evaluation_episodes, report=say)
        evaluated.append(Generalization(policy, policy.environment_steps, results))
    _list(write_generalization(evaluated, output))


@app.command(name="contact-sheet")
@in_one_line
def contact_sheet(
    output: Annotated[Path, typer.Option("--output", "-o", help="PNG file")] = Path("contact_sheet.png"),
    tasks: Annotated[str | None, typer.Option(help="separated by commas; else the paper's ten")] = None,
    modes: Annotated[str | None, typer.Option(help="distractions, separated by commas; else all that move")] = None,
    data: Annotated[Path | None, typer.Option(help="as of generalize")] = None,
    render_quality: Annotated[str, typer.Option(help="benchmark or fast")] = "benchmark",
) -> None:
    """Draw each task under each distraction."""
    from sb3_crc.analysis.contact_sheet import MODES, draw_contact_sheet
    from sb3_crc.envs.tasks import PAPER_TASKS

    chosen = [PAPER_TASKS if tasks is None else tasks.split(","), MODES if modes is None else modes.split(",")]
    _list([draw_contact_sheet(output, *chosen, data=data, render_quality=render_quality)])


def _gather(models: Sequence[Path], checkpoints: bool, decisions: int, episodes: int, *, needs: Sequence[str]) -> list[Any]:
    from sb3_crc.analysis.subjects import gather

    for package in needs:
        if importlib.util.find_spec(package) is None:
            extra = "video" if package == "av" else "analysis"
            raise ValueError(f"this needs {package}, of the extra '{extra}': pip install 'sb3-crc[{extra}]'")
    with _timed("rollouts"):
        return gather(models, checkpoints=checkpoints, decisions=decisions, episodes=episodes, report=say)


@contextmanager
def _timed(what: str) -> Iterator[None]:
    started = time.perf_counter()
    yield
    say(f"{what}: {time.perf_counter() - started:.1f} s")


def _list(written: Sequence[Path]) -> None:
    for path in written:
        say(str(path))
