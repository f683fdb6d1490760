"""rl_zoo3's scripts, with all their flags, on our algorithms and environments: ``python -m sb3_crc.zoo <command> flags...``"""

import importlib
import logging
import multiprocessing
import os
import runpy
import sys
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import rl_zoo3
import rl_zoo3.train
import rl_zoo3.utils

from sb3_crc.envs.tasks import NAMESPACE
from sb3_crc.presets import PRESETS
from sb3_crc.settings import check_name
from sb3_crc.stock import STOCK
from sb3_crc.workers import WorkerError
from sb3_crc.zoo.algorithms import preset_class, register, watched
from sb3_crc.zoo.figures import figures, normalized_inputs, split_figures_flag
from sb3_crc.zoo.manager import CRCExperimentManager
from sb3_crc.zoo.messages import say
from sb3_crc.zoo.resume import read_plan

PROGRAM = "python -m sb3_crc.zoo"
Flags = list[str]

#: What processes of environments need, imported once for all of them
WORKERS_IMPORT = ["sb3_crc", "sb3_crc.envs.simulator", "stable_baselines3.common.env_util"]


def train() -> None:
    """Run rl_zoo3's training script on ``sys.argv``."""
    logging.basicConfig(format="%(message)s")
    multiprocessing.set_forkserver_preload(WORKERS_IMPORT)
    register()
    program, *flags = sys.argv
    plan = CRCExperimentManager.plan = read_plan(flags)
    sys.argv = [program, *plan.flags]
    try:
        rl_zoo3.train.train()
    except KeyboardInterrupt:
        say("Interrupted before or after training: what is in the run's folder is complete, nothing else was written.")
        sys.exit(130)
    except WorkerError as error:  # while environments are made
        sys.exit(str(error))
    if CRCExperimentManager.stopped_by is not None:
        sys.exit(128 + CRCExperimentManager.stopped_by)


def enjoy(flags: Flags) -> None:
    """Run rl_zoo3's script that watches a policy; without a window to watch in it prints the returns."""
    if reason := _why_no_window(flags):
        say(f"{reason}: --no-render is implied. For a film: {PROGRAM} record_video")
        flags = [*flags, "--no-render"]
    _register_watched()
    script = importlib.import_module("rl_zoo3.enjoy")
    _run("enjoy", flags, script.enjoy)


def record_video(flags: Flags) -> None:
    """Run rl_zoo3's script that films a policy, in the environment that the run's ``config.yml`` describes."""
    _register_watched()
    rl_zoo3.utils.create_test_env = _with_configured_kwargs(rl_zoo3.utils.create_test_env)
    # The recorder renders anyway; without this flag every picture would be drawn twice.
    _run("record_video", [*flags, "--no-render"], partial(runpy.run_module, "rl_zoo3.record_video", run_name="__main__"))


def plot(command: str, flags: Flags) -> None:
    """Run one of rl_zoo3's plotting scripts; where no window can open, its figures become files."""
    folder, flags = split_figures_flag(flags)
    try:
        script = getattr(importlib.import_module("rl_zoo3.plots"), command)
    except ImportError as error:
        sys.exit(f"{command} needs the extra 'analysis' (pip install 'sb3-crc[analysis]'): {error}")
    with figures(folder):
        if command == "plot_from_file":
            with normalized_inputs(flags) as flags:
                _run(command, flags, script)
        else:
            _run(command, flags, script)


def hub(command: str, flags: Flags) -> None:
    """Run one of the commands of :mod:`sb3_crc.zoo.hub`, which alone needs Hugging Face's packages."""
    getattr(importlib.import_module("sb3_crc.zoo.hub"), command)(f"{PROGRAM} {command}", flags)


COMMANDS: dict[str, tuple[Callable[[Flags], None], str]] = {
    "train": (lambda flags: _run("train", flags, train), "train, go on with -i, or search with -optimize"),
    "enjoy": (enjoy, "run a trained policy and print its returns"),
    "record_video": (record_video, "film a trained policy"),
    "plot_train": (partial(plot, "plot_train"), "returns of the training episodes"),
    "all_plots": (partial(plot, "all_plots"), "learning curves of several runs, and a table"),
    "plot_from_file": (partial(plot, "plot_from_file"), "more plots of all_plots' file; -r: rliable"),
    "push_to_hub": (partial(hub, "push_to_hub"), "share a policy on the Hugging Face Hub"),
    "load_from_hub": (partial(hub, "load_from_hub"), "make a run of what was shared there"),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """
    Run a command.

    :param arguments: the command and its flags; None: those of the process
    """
    given = sys.argv[1:] if arguments is None else arguments
    command, *flags = given or [""]
    if command in ("", "-h", "--help"):
        say(_usage())
        sys.exit(0 if command else 2)
    try:
        check_name("command", command, COMMANDS)
    except ValueError as error:
        sys.stderr.write(f"{PROGRAM}: {error}\n")
        sys.exit(2)
    COMMANDS[command][0](flags)


def _usage() -> str:
    rows = [f"  {name:15} {help_}" for name, (_, help_) in COMMANDS.items()]
    flags = f"Flags are rl_zoo3's ({PROGRAM} <command> --help). The plots take --figures FOLDER: write files, open no window."
    return "\n".join([f"usage: {PROGRAM} <command> flags...", "", *rows, "", flags])


def _run(command: str, flags: Flags, script: Callable[[], Any]) -> None:
    sys.argv = [f"{PROGRAM} {command}", *flags]
    script()


def _register_watched() -> None:
    register()
    for name, algorithm in {**STOCK, **{preset: preset_class(preset) for preset in PRESETS}}.items():
        rl_zoo3.ALGOS[name] = watched(algorithm)


def _why_no_window(flags: Flags) -> str | None:
    if "--no-render" in flags:
        return None
    if sys.platform == "linux" and not os.environ.get("DISPLAY") and not os.environ.get("WAYLAND_DISPLAY"):
        return "There is no display"
    if any(f"{NAMESPACE}/" in flag for flag in flags):
        return f"The environments {NAMESPACE}/... draw pictures but open no window"
    return None


def _with_configured_kwargs(create_test_env: Callable[..., Any]) -> Callable[..., Any]:
    def create(*args: Any, hyperparams: dict[str, Any], env_kwargs: dict[str, Any], **kwargs: Any) -> Any:
        # rl_zoo3 2.9.2 looks for the environment's arguments among the command line's only
        env_kwargs = {**hyperparams.get("env_kwargs", {}), **env_kwargs}
        return create_test_env(*args, hyperparams=hyperparams, env_kwargs=env_kwargs, **kwargs)

    return create
