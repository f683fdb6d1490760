"""Commands that look into saved models, ``sb3-crc latents | tsne | correlate | probe | film | generalize``, and at what
distractions show, ``contact-sheet``."""

import json
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from sb3_crc import completion
from sb3_crc.command import Group, command, require, separated
from sb3_crc.console import say, tell

app = typer.Typer()

Models = Annotated[
    list[Path],
    typer.Argument(
        help="Models (.zip in the folder of their run), runs, or folders that contain runs.", autocompletion=completion.runs
    ),
]
Checkpoints = Annotated[bool, typer.Option("--checkpoints", help="Of each run also its rl_model_*_steps.zip, as curves.")]
Output = Annotated[Path, typer.Option("--output", "-o", help="Folder for figures, numbers and text.")]
States = Annotated[int, typer.Option(min=4, help="Observations that all models encode, about.")]
Data = Annotated[
    Path | None,
    typer.Option(help="Folder with DMControl-GB's color_*.npz and folders video_*; else what is shown is generated."),
]


@dataclass(frozen=True)
class Rollouts:
    """How policies act for what looks into them."""

    decisions: Annotated[int, typer.Option(min=1, help="Agent steps of each rollout, at least; episodes are whole.")] = 1_000
    episodes: Annotated[int, typer.Option(min=1, help="Episodes of each rollout, at least.")] = 4


@command(app, Group.INSIDE, "sb3-crc latents runs")
def latents(
    models: Models,
    checkpoints: Checkpoints = False,
    output: Output = Path("latents"),
    *,
    rollouts: Rollouts,
) -> object:
    """Roll policies and keep latents, actions, frames, physics, values and returns in analysis/ of their runs."""
    from sb3_crc.analysis.latent_report import write_latents

    subjects = _gather(models, checkpoints, rollouts)
    with _timed("latents"):
        written = write_latents(subjects, output)
    return _listed(written)


@command(
    app, Group.INSIDE, "sb3-crc tsne runs -o tsne", "sb3-crc tsne logs/crc/dmc_pixels-cartpole-swingup-v0_1 --checkpoints"
)
def tsne(
    models: Models,
    clusters: Annotated[int, typer.Option(help="How many, of the actions, by k-means.")] = 5,
    neighbours: Annotated[int, typer.Option(min=1, help="Nearest ones that the purity looks at.")] = 10,
    checkpoints: Checkpoints = False,
    output: Output = Path("tsne"),
    *,
    rollouts: Rollouts,
) -> object:
    """Draw latents in the plane, coloured by clusters of the actions, and measure how pure the clusters are."""
    from sb3_crc.analysis.cluster_report import write_clusters

    require("analysis", "sklearn", "plotly")
    subjects = _gather(models, checkpoints, rollouts)
    with _timed("tsne"):
        written = write_clusters(subjects, output, clusters=clusters, neighbours=neighbours)
    return _listed(written)


@command(app, Group.INSIDE, "sb3-crc correlate runs/crc_1 runs/rad_1 --null runs/crc_2 -o correlate")
def correlate(
    models: Models,
    null: Annotated[
        list[Path] | None,
        typer.Option(
            help="Models of the same methods, other seeds: how alike those are; once for each, else none.",
            autocompletion=completion.runs,
        ),
    ] = None,
    states: States = 1_000,
    checkpoints: Checkpoints = False,
    output: Output = Path("correlate"),
    *,
    rollouts: Rollouts,
) -> object:
    """Compare latents of the same observations: the paper's heat map, CKA and CCA, beside two seeds of one method."""
    from sb3_crc.analysis.similarity_report import write_similarities

    subjects = _gather([*models, *(null or [])], checkpoints, rollouts)
    with _timed("correlate"):
        written = write_similarities(subjects, output, states=states)
    return _listed(written)


@command(app, Group.INSIDE, "sb3-crc probe runs -o probe")
def probe(
    models: Models,
    states: States = 2_000,
    own_states: Annotated[bool, typer.Option("--own-states", help="Each model on its own rollout: no comparison.")] = False,
    checkpoints: Checkpoints = False,
    output: Output = Path("probe"),
    *,
    rollouts: Rollouts,
) -> object:
    """Read the physics state off the latents by ridge regression, beside an untrained encoder and a PCA of the pixels."""
    from sb3_crc.analysis.probe_report import write_probes

    subjects = _gather(models, checkpoints, rollouts)
    with _timed("probe"):
        written = write_probes(subjects, output, states=states, own_states=own_states)
    return _listed(written)


@command(app, Group.INSIDE, "sb3-crc film logs/crc/dmc_pixels-cartpole-swingup-v0_1 -o film")
def film(
    model: Annotated[
        Path, typer.Argument(help="A model (.zip in the folder of its run), or a run.", autocompletion=completion.runs)
    ],
    episode: Annotated[int, typer.Option(min=0, help="Which one of the rollout is filmed.")] = 0,
    output: Output = Path("film"),
    *,
    rollouts: Rollouts,
) -> object:
    """Film an episode with the reconstruction, what the critic looks at, the latent, reward and value."""
    from sb3_crc.analysis.policies import find_policies
    from sb3_crc.analysis.saliency_film import write_film

    if len(find_policies([model])) > 1:
        raise ValueError(f"{model} contains several runs; a film is of one model")
    require("video", "av")
    (subject,) = _gather([model], False, rollouts)
    with _timed("film"):
        written = write_film(subject, output, episode=episode)
    return _listed(written)


@command(app, Group.INSIDE, "sb3-crc generalize runs --modes none,color_hard,video_hard -o generalization")
def generalize(
    models: Models,
    modes: Annotated[
        str,
        typer.Option(help="Distractions, separated by commas; none: where it was trained.", autocompletion=completion.modes),
    ] = "none,color_easy,color_hard,video_easy,video_hard",
    data: Data = None,
    evaluation_episodes: Annotated[int, typer.Option("--episodes", min=1, help="Episodes in each mode.")] = 10,
    checkpoints: Checkpoints = False,
    output: Output = Path("generalization"),
) -> object:
    """Evaluate policies in distracted environments, beside published scores; curves, where a callback watched a training."""
    from sb3_crc.analysis.generalization import generalize as evaluate
    from sb3_crc.analysis.generalization_report import Generalization, write_generalization
    from sb3_crc.analysis.policies import find_policies

    require("analysis", "matplotlib")
    names = separated(modes)
    evaluated = []
    for policy in find_policies(models, checkpoints=checkpoints):
        results = evaluate(policy, names, data=data, episodes=evaluation_episodes, report=tell)
        evaluated.append(Generalization(policy, policy.environment_steps, results))
    return _listed(write_generalization(evaluated, output))


@command(
    app,
    Group.TASKS,
    "sb3-crc contact-sheet --tasks cartpole-swingup,walker-walk --modes color_hard,video_hard",
    name="contact-sheet",
)
def contact_sheet(
    output: Annotated[Path, typer.Option("--output", "-o", help="PNG file to write.")] = Path("contact_sheet.png"),
    tasks: Annotated[
        str | None,
        typer.Option(help="domain-task, separated by commas; else the paper's ten.", autocompletion=completion.several_tasks),
    ] = None,
    modes: Annotated[
        str | None,
        typer.Option(help="Distractions, separated by commas; else all that move.", autocompletion=completion.distractions),
    ] = None,
    data: Data = None,
    render_quality: Annotated[
        str,
        typer.Option(
            help="benchmark: dm_control's own pictures; fast: without multisampling, shadows and reflections.",
            autocompletion=completion.one_of("benchmark", "fast"),
        ),
    ] = "benchmark",
) -> object:
    """Draw each task under each distraction."""
    from sb3_crc.analysis.contact_sheet import MODES, draw_contact_sheet
    from sb3_crc.envs.tasks import PAPER_TASKS

    require("analysis", "matplotlib")
    chosen = [PAPER_TASKS if tasks is None else separated(tasks), MODES if modes is None else separated(modes)]
    return _listed([draw_contact_sheet(output, *chosen, data=data, render_quality=render_quality)])


def _gather(models: Sequence[Path], checkpoints: bool, rollouts: Rollouts) -> list[Any]:
    from sb3_crc.analysis.subjects import gather

    require("analysis", "matplotlib")
    with _timed("rollouts"):
        return gather(models, checkpoints=checkpoints, **asdict(rollouts), report=tell)


@contextmanager
def _timed(what: str) -> Iterator[None]:
    started = time.perf_counter()
    yield
    tell(f"{what}: {time.perf_counter() - started:.1f} s")


def _listed(written: Sequence[Path]) -> dict[str, Any]:
    """The numbers are those of the JSON file among what was written."""
    for path in written:
        say(str(path))
    numbers = [json.loads(path.read_text(encoding="utf-8")) for path in written if path.suffix == ".json"]
    return {"written": list(written), "numbers": numbers[0] if numbers else None}
