"""One run, or one search, of the zoo."""

import importlib.util
import logging
import os
import shlex
import sys
from collections import OrderedDict
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import optuna
import rl_zoo3.hyperparams_opt
import yaml
from filelock import FileLock
from optuna.trial import TrialState
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import SimpleLinearSchedule, get_latest_run_id
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import CSVOutputFormat, Logger, configure
from stable_baselines3.common.utils import LinearSchedule, configure_logger
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from sb3_crc.analysis.films import film
from sb3_crc.checkpoints.callback import TrainingCheckpoint
from sb3_crc.configurations import configuration_file, settings_for, shipped
from sb3_crc.disk import is_of_disk, outlived
from sb3_crc.envs.rendering import RenderingUnavailable
from sb3_crc.envs.tasks import NAMESPACE
from sb3_crc.experiments.curves import plot_learning_curve
from sb3_crc.experiments.provenance import provenance
from sb3_crc.experiments.runs import PROVENANCE, add_provenance, write_json
from sb3_crc.presets import PRESETS
from sb3_crc.schedules import lr_schedule
from sb3_crc.stock import STOCK
from sb3_crc.workers import WatchedSubprocVecEnv, WorkerError
from sb3_crc.zoo.messages import say
from sb3_crc.zoo.resume import CHECKPOINTS, Plan, write_plan
from sb3_crc.zoo.search import ARGUMENTS, constructor_arguments, sample

logger = logging.getLogger(__name__)

SQLITE = "sqlite:///"


class CRCExperimentManager(ExperimentManager):
    """
    The zoo's manager, which also finds our configurations, logs into the run's folder, draws what was learned, and keeps what
    a search does not draw. Arguments are the zoo's.
    """

    #: Whether there are checkpoints, and whether a run goes on
    plan = Plan([], None, None)
    #: The signal that ended the last training; None: there was none, or there were no checkpoints
    stopped_by: int | None = None

    def __init__(self, args: Any, algo: str, env_id: str, *rest: Any, **kwargs: Any):
        own_config = configuration_file(algo)
        # rl_zoo3 has a sac.yml too, for environments of states
        ours = algo not in STOCK or env_id.startswith(f"{NAMESPACE}/")
        if kwargs.get("config") is not None:
            kwargs["config"] = str(shipped(Path(kwargs["config"])))
        elif own_config.exists() and ours:
            kwargs["config"] = str(own_config)
        super().__init__(args, algo, env_id, *rest, **kwargs)
        if self.vec_env_class is SubprocVecEnv:
            self.vec_env_class = WatchedSubprocVecEnv
        if self.plan.run is not None:
            self.save_path = str(self.plan.run)
            self.params_path = str(self.plan.run / str(self.env_name))
        self._configuration: dict[str, Any] = {}
        self._study: optuna.Study | None = None

    # -- Configuration -------------------------------------------------------------------------------------------------

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """
        As in the zoo, but a configuration may be for several algorithms (:func:`~sb3_crc.configurations.settings_for`); and
        the trial of ``--trial-id`` (which may be 0) replaces what it drew and nothing else.

        :return: two mappings of the same content: one to be consumed, one to be saved
        :raises ValueError: for an unknown preset
        """
        trial_id, self.trial_id = self.trial_id, None
        read, _ = super().read_hyperparameters()
        given = self.custom_hyperparams or {}
        settings = {**settings_for(self.algo, read), **given}
        if trial_id is not None and self.storage and self.study_name:
            drawn = self.load_trial(self.storage, self.study_name, trial_id, convert=self.algo not in PRESETS)
            if self.algo in PRESETS:
                drawn = constructor_arguments({**PRESETS[self.algo], **settings}, drawn)
            drawn = {name: value for name, value in drawn.items() if name not in given}
            say(f"Trial {trial_id} of {self.study_name}: {drawn}")
            settings |= drawn
        self._configuration = deepcopy(settings)
        return settings, OrderedDict(sorted(deepcopy(settings).items()))

    @staticmethod
    def _preprocess_schedules(hyperparams: dict[str, Any]) -> dict[str, Any]:
        """As in the zoo, but SB3's linear schedules, saved without a pickle, and a learning rate may be ``lin_x_f``."""
        rate = hyperparams.get("learning_rate")
        own = {"learning_rate": lr_schedule(rate).value_schedule} if isinstance(rate, str) else {}
        others = {name: value for name, value in hyperparams.items() if name not in own}
        found: dict[str, Any] = ExperimentManager._preprocess_schedules(others)
        for name, value in found.items():
            if isinstance(value, SimpleLinearSchedule):
                found[name] = LinearSchedule(value.initial_value, 0.0, 1.0)
        return found | own

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        if "ParallelTrainCallback" in str(hyperparams.get("callback")):
            raise ValueError(
                "callback: rl_zoo3's ParallelTrainCallback reloads the model as a stock SAC, so it cannot train "
                f"{self.algo!r}; remove it from the configuration"
            )
        processed = super()._preprocess_hyperparams(hyperparams)
        if self._eval_env_kwargs_args is None:  # rl_zoo3 2.9.2 forgets the YAML's env_kwargs in evaluation
            self.eval_env_kwargs = self.env_kwargs
        return processed

    # -- Training ------------------------------------------------------------------------------------------------------

    def create_log_folder(self) -> None:
        """As in the zoo, but runs that are begun at the same moment get a folder each: it may be taken since it was named."""
        while self.plan.run is None:
            try:
                os.makedirs(self.save_path)
                break
            except FileExistsError:
                number = get_latest_run_id(self.log_path, self.env_name) + 1
                self.save_path = os.path.join(self.log_path, f"{self.env_name}_{number}")
        self.params_path = os.path.join(self.save_path, str(self.env_name))
        os.makedirs(self.params_path, exist_ok=True)

    def learn(self, model: BaseAlgorithm) -> None:
        """Train until done or interrupted (Ctrl-C), logging to ``progress.csv`` and TensorBoard."""
        model.set_logger(self._make_logger(model))
        if self.plan.run is None:
            write_json(provenance(), Path(self.save_path) / PROVENANCE)
        else:
            with outlived(self.plan.run / PROVENANCE):
                add_provenance(provenance(), self.plan.run)
        if self.plan.checkpoint_every is None:
            super().learn(model)
            return
        run = Path(self.save_path)
        if self.plan.run is None:
            write_plan(self.plan, run)
        checkpoint = TrainingCheckpoint(run / CHECKPOINTS, self.plan.checkpoint_every, monitor_dir=run, verbose=1)
        self.callbacks.append(checkpoint)  # the last one: the others have started when it restores them
        try:
            super().learn(model)
        except WorkerError as error:
            raise SystemExit(f"{error}\n{self._how_to_go_on(model.num_timesteps)}") from None
        finally:
            checkpoint.close()
            type(self).stopped_by = checkpoint.stopped_by

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """
        Save the final model, draw the learning curve, film the best policy, and say how to go on.

        :raises SystemExit: if the disk fails; with checkpoints, to go on is to save again
        """
        try:
            super().save_trained_model(model)
        except OSError as error:
            if not is_of_disk(error):
                raise
            raise SystemExit(f"The model could not be saved in {self.save_path}: {error}\n{self._how_to_save()}") from None
        environment = self.create_envs(1, eval_env=True)
        try:
            self._draw_learning_curve(environment)
            self._film(model, environment)
        except OSError as error:
            if not is_of_disk(error):
                raise
            logger.warning("learning curve and film of %s could not be written: %s", self.save_path, error)
        finally:
            environment.close()
        say(self._how_to_go_on(model.num_timesteps))

    def _draw_learning_curve(self, environment: VecEnv) -> None:
        evaluations = Path(self.save_path) / "evaluations.npz"
        repeats = int(environment.get_attr("action_repeat")[0]) if environment.has_attr("action_repeat") else 1
        if evaluations.exists():
            plot_learning_curve(evaluations, evaluations.with_name("learning_curve.png"), action_repeat=repeats)

    def _film(self, model: BaseAlgorithm, environment: VecEnv) -> None:
        if importlib.util.find_spec("av") is None:
            logger.warning("no policy.mp4: install the extra 'video' (pip install 'sb3-crc[video]')")
            return
        if environment.render_mode != "rgb_array":  # rl_zoo3 asks no environment for it; ours have it anyway
            logger.warning("no policy.mp4: for one, the configuration's env_kwargs need render_mode: rgb_array")
            return
        policy, best = model, Path(self.save_path) / "best_model.zip"
        try:
            if best.exists():
                policy = type(model).load(best, device=model.device)
        except Exception as error:  # whatever is wrong with that file, the run's own model can still be filmed
            logger.warning("%s cannot be loaded (%s): policy.mp4 shows the final model instead", best, error)
        unfinished = best.with_name(".unfinished.mp4")
        try:
            film(policy, environment, unfinished)
            os.replace(unfinished, best.with_name("policy.mp4"))
        except (RenderingUnavailable, gym.error.Error) as error:  # the latter: a renderer is not installed
            logger.warning("no policy.mp4: %s", error)
        finally:
            unfinished.unlink(missing_ok=True)

    def _make_logger(self, model: BaseAlgorithm) -> Logger:
        if self.tensorboard_log:
            run_logger = configure_logger(self.verbose, self.tensorboard_log, type(model).__name__)
            run_logger.output_formats.append(CSVOutputFormat(os.path.join(self.save_path, "progress.csv")))
            return run_logger
        formats = ["csv", *["tensorboard"] * (importlib.util.find_spec("tensorboard") is not None)]
        return configure(self.save_path, formats + ["stdout"] * (self.verbose > 0))

    def _how_to_save(self) -> str:
        if self.plan.checkpoint_every is None:
            return "Without --checkpoint-every nothing else holds the training."
        return f"When the disk is writable again, from the last checkpoint: {self._resume()}"

    def _resume(self) -> str:
        return shlex.join([*sys.orig_argv[: sys.orig_argv.index(sys.argv[0]) + 1], "--resume", self.save_path])

    def _how_to_go_on(self, done: int) -> str:
        more = self.n_timesteps - done if done < self.n_timesteps else self.n_timesteps
        state = "finished" if done >= self.n_timesteps else f"stopped at {done} of {self.n_timesteps} agent steps"
        if self.plan.checkpoint_every is not None and done < self.n_timesteps:
            return f"Training {state}. To go on from the last checkpoint: {self._resume()}"
        # The last of two equal flags counts, so the run's own command keeps its settings.
        command = [*sys.orig_argv, "-i", os.path.join(self.save_path, f"{self.env_name}.zip"), "-n", str(more)]
        return f"Training {state}. To go on: {shlex.join(command)}"

    # -- Search --------------------------------------------------------------------------------------------------------

    def objective(self, trial: optuna.Trial) -> float:
        """As in the zoo; a trial whose losses are no longer finite is pruned."""
        self._study = trial.study
        try:
            return float(super().objective(trial))
        except FloatingPointError as error:
            logger.warning("%s", error)
            raise optuna.TrialPruned(str(error)) from error

    def hyperparameters_optimization(self) -> None:
        """As in the zoo; the best trial is also written as a configuration that ``--conf-file`` takes."""
        if self.algo not in rl_zoo3.hyperparams_opt.HYPERPARAMS_SAMPLER:
            raise ValueError(
                f"-optimize draws nothing for {self.algo!r}: search for the settings of a method of ours, and give it those"
            )
        if self.algo in PRESETS:
            configuration = {**PRESETS[self.algo], **self._hyperparams}
            rl_zoo3.hyperparams_opt.HYPERPARAMS_SAMPLER[self.algo] = partial(sample, configuration)
        prepare_storage(self.storage)
        try:
            super().hyperparameters_optimization()
        except ValueError as error:  # what Optuna raises when asked for the best of no trial
            if self._completed_trials():
                raise
            say(f"No trial was completed, so there is no best one: {error}")
            return
        self._write_best_trial()

    def _completed_trials(self) -> list[optuna.trial.FrozenTrial]:
        return [] if self._study is None else self._study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))

    def _write_best_trial(self) -> None:
        if not self._completed_trials() or self._study is None or self.algo not in {*PRESETS, *STOCK}:
            return
        best = self._study.best_trial
        path = Path(self.log_folder) / self.algo / f"best_{(self.study_name or self.env_name).replace('/', '-')}.yml"
        drawn = best.user_attrs.get(ARGUMENTS)
        if drawn is None:  # rl_zoo3's own sampler keeps numbers only
            drawn = rl_zoo3.hyperparams_opt.HYPERPARAMS_CONVERTER[self.algo](best.params)
        configuration = {**self._configuration, **drawn}
        origin = (
            f"# Trial {best.number} of the study {self._study.study_name}: mean return {best.value} of its last evaluation\n"
        )
        path.write_text(origin + yaml.safe_dump({self.env_name.gym_id: configuration}, sort_keys=False))
        say(f"To train with trial {best.number}: --algo {self.algo} --env {self.env_name.gym_id} --conf-file {path}")


def prepare_storage(storage: str | None) -> None:
    """
    Make the tables of an SQLite storage, one process at a time: of workers that start together all but one would fail.

    :param storage: as in ``--storage``
    """
    if storage is None or not storage.startswith(SQLITE):
        return
    database = storage.removeprefix(SQLITE).partition("?")[0]
    if database in ("", ":memory:"):
        return
    Path(database).parent.mkdir(parents=True, exist_ok=True)
    with FileLock(f"{database}.lock"):
        optuna.storages.get_storage(storage).remove_session()
