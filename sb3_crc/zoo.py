"""rl_zoo3 with our algorithms: the only module that imports it.

Each preset is an algorithm of the zoo: ``--algo crc``, ``--algo rad``, ... Runs read ``zoo_configs/<algo>.yml`` unless
``--conf-file`` names another file. Beside what the zoo leaves in a run's folder there are ``progress.csv``, TensorBoard
events, ``learning_curve.png`` and ``policy.mp4``.
"""

import importlib.util
import logging
import os
import sys
from pathlib import Path
from typing import Any

import rl_zoo3.exp_manager
import rl_zoo3.train
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import CSVOutputFormat, Logger, configure
from stable_baselines3.common.utils import configure_logger

from sb3_crc.analysis.films import film
from sb3_crc.crc_sac import CRCSAC
from sb3_crc.evaluation import QBiasEvalCallback
from sb3_crc.experiments.curves import plot_learning_curve
from sb3_crc.presets import PRESETS
from sb3_crc.settings import check_name

logger = logging.getLogger(__name__)

CONFIGS = Path(__file__).resolve().parent.parent / "zoo_configs"


def preset_class(preset: str) -> type[CRCSAC]:
    """
    CRCSAC with the defaults of a preset, for the zoo's table of algorithms. Its zips load as CRCSAC too.

    :param preset: a key of :data:`~sb3_crc.PRESETS`
    :raises ValueError: for an unknown preset
    """
    check_name("preset", preset, PRESETS)

    def __init__(self: CRCSAC, *args: Any, **kwargs: Any) -> None:
        CRCSAC.__init__(self, *args, **{**PRESETS[preset], **kwargs})

    return type(preset, (CRCSAC,), {"preset": preset, "__init__": __init__, "__doc__": f"CRCSAC with PRESETS[{preset!r}]."})


class CRCExperimentManager(ExperimentManager):
    """The zoo's manager, which also finds our configurations, logs into the run's folder and draws what was learned."""

    def __init__(self, args: Any, algo: str, *rest: Any, **kwargs: Any):
        own_config = CONFIGS / f"{algo}.yml"
        if kwargs.get("config") is None and own_config.exists():
            kwargs["config"] = str(own_config)
        super().__init__(args, algo, *rest, **kwargs)

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        processed = super()._preprocess_hyperparams(hyperparams)
        if self._eval_env_kwargs_args is None:  # rl_zoo3 2.9.2 forgets the YAML's env_kwargs in evaluation
            self.eval_env_kwargs = self.env_kwargs
        return processed

    def learn(self, model: BaseAlgorithm) -> None:
        """Train until done or interrupted (Ctrl-C), logging to ``progress.csv`` and TensorBoard."""
        model.set_logger(self._make_logger(model))
        super().learn(model)

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """Save the final model, draw the learning curve, film the best policy, and say how to go on."""
        super().save_trained_model(model)
        folder = Path(self.save_path)
        environment = self.create_envs(1, eval_env=True)
        try:
            repeats = int(environment.get_attr("action_repeat")[0]) if environment.has_attr("action_repeat") else 1
            if (folder / "evaluations.npz").exists():
                plot_learning_curve(folder / "evaluations.npz", folder / "learning_curve.png", action_repeat=repeats)
            if importlib.util.find_spec("av") is None:
                logger.warning("no policy.mp4: install the extra 'video' (pip install 'sb3-crc[video]')")
            else:
                best = folder / "best_model.zip"
                policy = type(model).load(best, device=model.device) if best.exists() else model
                film(policy, environment, folder / "policy.mp4")
        finally:
            environment.close()
        _say(self._how_to_go_on(model.num_timesteps))

    def _make_logger(self, model: BaseAlgorithm) -> Logger:
        if self.tensorboard_log:
            run_logger = configure_logger(self.verbose, self.tensorboard_log, type(model).__name__)
            run_logger.output_formats.append(CSVOutputFormat(os.path.join(self.save_path, "progress.csv")))
            return run_logger
        formats = ["csv", *["tensorboard"] * (importlib.util.find_spec("tensorboard") is not None)]
        return configure(self.save_path, formats + ["stdout"] * (self.verbose > 0))

    def _how_to_go_on(self, done: int) -> str:
        zip_file = Path(self.save_path) / f"{self.env_name}.zip"
        more = self.n_timesteps - done if done < self.n_timesteps else self.n_timesteps
        state = "finished" if done >= self.n_timesteps else f"stopped at {done} of {self.n_timesteps} agent steps"
        command = f"{sys.orig_argv[0]} train.py --algo {self.algo} --env {self.env_name.gym_id} --conf-file {self.config}"
        return f"Training {state}. To go on: {command} -i {zip_file} -n {more}"


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def register() -> None:
    """Put the presets into the zoo's table of algorithms, and our manager into its training script."""
    for name in PRESETS:
        rl_zoo3.ALGOS[name] = preset_class(name)
    rl_zoo3.exp_manager.EvalCallback = QBiasEvalCallback  # type: ignore[attr-defined]
    rl_zoo3.train.ExperimentManager = CRCExperimentManager  # type: ignore[attr-defined]


def train() -> None:
    """Run rl_zoo3's training script, with every flag it has, on our algorithms and environments."""
    logging.basicConfig(format="%(message)s")
    register()
    try:
        rl_zoo3.train.train()
    except KeyboardInterrupt:
        _say("Interrupted before or after training: what is in the run's folder is complete, nothing else was written.")
        sys.exit(130)
