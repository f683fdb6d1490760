"""The zoo's two commands for the Hugging Face Hub, on our algorithms.

``push_to_hub`` takes rl_zoo3's flags, but what it uploads is written by :mod:`sb3_crc.experiments.hub`: rl_zoo3's own page
would name commands that do not know our algorithms. rl_zoo3's ``load_from_hub``, which is used as it is, reads that.
"""

import argparse
import os
import runpy
import sys
from pathlib import Path

import huggingface_hub.errors
import huggingface_sb3
import requests
import rl_zoo3
from huggingface_sb3 import EnvironmentName, ModelName
from rl_zoo3.utils import get_model_path

from sb3_crc.experiments.commands.sharing import share
from sb3_crc.zoo.algorithms import register


def push_to_hub(program: str, flags: list[str]) -> None:
    """
    Share the final policy of a run.

    :param program: as which it was called
    :param flags: those of rl_zoo3's script that concern us, and ``--output``
    """
    register()
    parser = argparse.ArgumentParser(program, description="Share the final policy of a run on the Hugging Face Hub.")
    parser.add_argument("--algo", required=True, choices=list(rl_zoo3.ALGOS), help="algorithm")
    parser.add_argument("--env", required=True, type=EnvironmentName, help="environment id")
    parser.add_argument("-f", "--folder", required=True, help="log folder")
    parser.add_argument("--exp-id", default=0, type=int, help="number of the run; 0: the latest, -1: no folder of its own")
    parser.add_argument("-orga", "--organization", required=True, help="user or organization on the Hub")
    parser.add_argument("-name", "--repo-name", help="repository, by default algo-env")
    parser.add_argument("-m", "--commit-message", default="A policy of sb3_crc", help="commit message")
    parser.add_argument("--no-render", action="store_true", help="film nothing")
    parser.add_argument("-o", "--output", type=Path, help="write the files here and upload nothing")
    given = parser.parse_args(flags)
    try:
        _, _, run = get_model_path(given.exp_id, given.folder, given.algo, given.env)
        share(
            Path(run),
            f"{given.organization}/{given.repo_name or ModelName(given.algo, given.env)}",
            output=given.output,
            filmed=not given.no_render,
            private=False,
            message=given.commit_message,
        )
    except (AssertionError, ValueError, OSError) as error:  # the first is get_model_path's
        sys.exit(str(error))


def load_from_hub(program: str, flags: list[str]) -> None:
    """
    Make a run of a repository; flags are rl_zoo3's.

    :param program: as which it was called
    :param flags: those of rl_zoo3's script
    """
    register()
    download = huggingface_sb3.load_from_hub

    def load(repo_id: str, filename: str) -> str:
        try:
            return str(download(repo_id, filename))
        except huggingface_hub.errors.EntryNotFoundError as error:
            # rl_zoo3 2.9.2 expects the error of requests, by which huggingface_hub fetched before its version 1
            raise requests.exceptions.HTTPError(str(error)) from error

    huggingface_sb3.load_from_hub = load
    sys.argv = [program, *flags]
    try:
        if not {"-h", "--help"}.intersection(flags) and os.environ.get("TRUST_REMOTE_CODE") is None:
            sys.exit(
                "What is downloaded may hold pickles, which are programs. TRUST_REMOTE_CODE=True before the command says that "
                "you trust whoever made it; policy.sb3crc, in repositories of sb3_crc, needs no trust: sb3_crc.load_policy"
            )
        runpy.run_module("rl_zoo3.load_from_hub", run_name="__main__")
    finally:
        huggingface_sb3.load_from_hub = download
