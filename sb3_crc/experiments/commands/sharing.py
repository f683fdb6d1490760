"""The command that shares a policy: ``sb3-crc push``."""

import importlib.util
import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer

from sb3_crc import completion
from sb3_crc.command import Group, command
from sb3_crc.console import say, tell

app = typer.Typer()
RUN = "logs/crc/dmc_pixels-cartpole-swingup-v0_1"


@command(
    app,
    Group.SHARE,
    f"sb3-crc push {RUN} --repo-id me/crc-cartpole-swingup -o page",
    f"sb3-crc push {RUN} --repo-id me/crc-cartpole-swingup",
)
def push(
    run: Annotated[Path, typer.Argument(help="Run of train.py whose training has ended.", autocompletion=completion.runs)],
    repo_id: Annotated[str, typer.Option(help="user/name on the Hub.")],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder to write the files into, and upload nothing; else they are uploaded."),
    ] = None,
    film: Annotated[bool, typer.Option(help="Film an episode of the final policy.")] = True,
    private: Annotated[bool, typer.Option("--private", help="Make the repository for its owner alone.")] = False,
    message: Annotated[str, typer.Option("--message", "-m", help="Of the commit.")] = "A policy of sb3_crc",
) -> object:
    """Share a policy on the Hugging Face Hub, with a page that says what it is worth; -o: only write what would be sent."""
    return share(run, repo_id, output=output, filmed=film, private=private, message=message)


def share(run: Path, repo_id: str, *, output: Path | None, filmed: bool, private: bool, message: str) -> dict[str, Any]:
    """
    Write the files of a repository, and upload them unless they are to stay.

    :param run: folder
    :param repo_id: ``user/name``
    :param output: folder to write into instead of uploading
    :param filmed: film an episode
    :param private: make the repository for its owner alone
    :param message: of the commit
    :return: ``files``, with their sizes in bytes, and the ``address``, None if nothing was uploaded
    :raises FileNotFoundError: if there is no such run, or its training has not ended
    :raises ValueError: if the files cannot be written, or without an access token
    :raises ConnectionError: if the Hub cannot be reached or refuses
    """
    from sb3_crc.experiments.hub import upload, write_repository
    from sb3_crc.experiments.runs import Run

    found = Run(run)
    if found.final is None:
        tell(f"not evaluated, and the page says so; before it is shared: sb3-crc evaluate {run}")
    if filmed and importlib.util.find_spec("av") is None:
        tell("no film: install the extra 'video' (pip install 'sb3-crc[video]')")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "repository" if output is None else output
        files = {path.name: path.stat().st_size for path in write_repository(found, folder, repo_id, filmed=filmed)}
        for name, size in files.items():
            say(f"{name if output is None else folder / name}: {size / 1000:.1f} kB")
        address = None if output is not None else upload(folder, repo_id, private=private, message=message)
    if address is not None:
        say(address)
    return {"files": files, "address": address}
