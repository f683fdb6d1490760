"""Callbacks: auxiliary objectives for stock SB3 algorithms; reconstructions as images and schedules for CRCSAC.

B batch, C channels (of the whole frame stack), H, W image height and width.
"""

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Image
from stable_baselines3.common.utils import FloatSchedule
from typing_extensions import Self

from sb3_crc.augmentations import center_crop
from sb3_crc.auxiliary import AuxiliaryLearner, AuxiliarySettings, read_aux
from sb3_crc.buffers import FrameReplayBuffer
from sb3_crc.crc_sac import CRCSAC
from sb3_crc.encoder import scale_pixels
from sb3_crc.extractors import trainable_extractor
from sb3_crc.image_spaces import split_observations
from sb3_crc.objectives import ObjectiveSettings, Reconstruction, objective_weights
from sb3_crc.presets import PRESETS
from sb3_crc.schedules import LearningRate, lr_schedule


class AuxiliaryLossCallback(BaseCallback):
    """
    Give a *stock* SB3 off-policy algorithm with image observations the auxiliary objectives of CRC-RL, or others.

    After each rollout, once the algorithm itself learns and a batch is stored, it trains the critic's features extractor (DQN:
    the Q network's) on the replay buffer, with an Adam and a key encoder (a moving average of the extractor) of its own. It
    needs nothing of the algorithm but its buffer and works with SAC, TD3, DDPG, TQC, DQN and QR-DQN::

        model = SAC("CnnPolicy", env, buffer_size=20_000)
        model.learn(100_000, callback=AuxiliaryLossCallback())

    With ``share_features_extractor=True`` the actor sees through the trained extractor too. Without (SB3's default), the
    actor's own extractor stays the algorithm's business: the objectives do not touch it. Target networks follow in the
    algorithm's own way. For discrete actions, ``views.actions`` are indices ``(B, 1)``.

    Watch ``representation/contrastive``: at log(batch size) the latents of different frames are alike. SB3's NatureCNN ends
    in a ReLU without normalisation; with few features, or frames that hardly differ, the consistency loss can collapse it.
    Then leave that one away, or use ``policy_kwargs={"features_extractor_class": PixelEncoder}``, whose latent is normalised.

    **Saving.** SB3's zip of the model contains nothing of this package and loads without it. What the objectives need to go on
    lies beside it: from the first ``learn()`` on, *every* ``model.save(path)`` of this model (CheckpointCallback's,
    EvalCallback's best model, yours, during and after training) also writes ``<model>.aux.zip``: key encoder, objectives,
    Adam's state, settings; no pickles. To that end ``model.save`` is replaced on this one object;
    ``del model.save`` ends that. (An extractor of this package, ``features_extractor_class=PixelEncoder``, is part of the
    model: loading that one needs the package.) To continue::

        model = SAC.load("model", env)
        model.learn(100_000, callback=AuxiliaryLossCallback.load("model"), reset_num_timesteps=False)

    One callback belongs to one model: with another model it starts afresh. With the same model a later ``learn()`` goes on.

    :param objectives: name -> weight, or name -> ``{"weight": w, **settings}``, as for :class:`~sb3_crc.CRCSAC`
    :param gradient_steps: updates after each rollout (of ``train_freq`` steps or episodes)
    :param learning_rate: of extractor and objectives under the auxiliary losses; a number, or ``"lin_x"``: from x down to 0
    :param augmentation: name in :data:`~sb3_crc.augmentations.AUGMENTATIONS`; it must keep the images' size
    :param augmentation_kwargs: its arguments
    :param batch_size: transitions per update; None: the algorithm's
    :param encoder_tau: rate at which the key encoder follows, per update
    :param verbose: 1: say when training starts
    :raises ValueError: for arguments that cannot work; when ``learn()`` begins, for an algorithm that is on-policy or a
        CRCSAC, observations that are not images, an extractor without parameters, an augmentation that changes the size
    """

    def __init__(
        self,
        objectives: ObjectiveSettings = PRESETS["crc"]["objectives"],
        gradient_steps: int = 1,
        *,
        learning_rate: float | str = 1e-3,
        augmentation: str = "random_shift",
        augmentation_kwargs: Mapping[str, Any] | None = None,
        batch_size: int | None = None,
        encoder_tau: float = 0.05,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        self.settings = AuxiliarySettings(
            objectives, gradient_steps, learning_rate, augmentation, augmentation_kwargs, batch_size, encoder_tau
        )
        self.learner: AuxiliaryLearner | None = None
        self._loaded: tuple[dict[str, Any], dict[str, th.Tensor]] | None = None

    @classmethod
    def load(cls, path: str | os.PathLike[str], **changes: Any) -> Self:
        """
        A callback that continues where the saved one was, on the model that was saved with it.

        :param path: of the model or of its ``.aux.zip``
        :param changes: arguments to change, such as ``gradient_steps=2``
        :raises FileNotFoundError: if there is no ``.aux.zip`` beside the model
        :raises ValueError: if the file is damaged; when ``learn()`` begins, if it does not fit the model
        """
        header, tensors = read_aux(path)
        callback = cls(**{**header["settings"], **changes})
        callback._loaded = header, tensors
        return callback

    def save(self, path: str | os.PathLike[str]) -> Path:
        """
        Write ``<model>.aux.zip`` alone, for a model that was saved to a stream or by other means.

        :param path: of the model
        :return: the file written
        :raises RuntimeError: before the first ``learn()``: there is nothing to save yet
        """
        if self.learner is None:
            raise RuntimeError("nothing to save: the callback has not been with a model in learn() yet")
        return self.learner.save(path)

    def training_state(self) -> tuple[dict[str, Any], dict[str, th.Tensor]] | None:
        """For :class:`~sb3_crc.TrainingCheckpoint`."""
        if self.learner is None:
            return None
        header, tensors = self.learner.state()
        return {name: header[name] for name in ("n_updates", "model_updates")}, tensors

    def set_training_state(self, state: tuple[dict[str, Any], dict[str, th.Tensor]] | None) -> None:
        """:raises ValueError: if it belongs to other objectives"""
        if state is not None and self.learner is not None:
            self.learner.load_state(*state)

    def _init_callback(self) -> None:
        extractor = trainable_extractor(self.model)
        if self.learner is None or self.learner.extractor is not extractor:
            learner = AuxiliaryLearner(self.model, self.settings)
            if self._loaded is not None:
                learner.load_state(*self._loaded)
            self.learner, self._loaded = learner, None
        vars(self.model)["save"] = self.learner.save_model

    def _on_training_start(self) -> None:
        assert self.learner is not None
        if vars(self.model).get("save") != self.learner.save_model:
            raise ValueError("a model takes one AuxiliaryLossCallback: name all objectives in that one")

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        assert self.learner is not None
        if not self.learner.ready():
            return
        if self.verbose > 0 and self.learner.n_updates == 0:
            print(f"AuxiliaryLossCallback trains {type(self.learner.extractor).__name__} from now on")
        for name, value in self.learner.train().items():
            self.logger.record(name, value)
        self.logger.record("representation/n_updates", self.learner.n_updates, exclude="tensorboard")


#: Frames from which the picture's mean image is taken, where the reconstruction is standardised
STATISTICS_BATCH = 64


class ReconstructionImageCallback(BaseCallback):
    """
    Log frames above what the decoder of a :class:`~sb3_crc.CRCSAC` makes of their latents, as an image in TensorBoard.

    The run itself does not change: the frames are drawn without advancing the random numbers.

    :param every: agent steps between two images
    :param n_images: frames beside each other
    :param frame_channels: channels of the newest frame, which are shown: 3 or 1; None: 3 if the stack divides by 3, else 1
    :param verbose: as in SB3
    :raises ValueError: for a number below 1; when ``learn()`` begins, if the model has no reconstruction objective
    """

    #: Log name of the images
    key = "representation/reconstruction_image"

    def __init__(self, every: int = 5_000, n_images: int = 4, *, frame_channels: int | None = None, verbose: int = 0):
        super().__init__(verbose)
        for name, value in (("every", every), ("n_images", n_images)):
            if value < 1:
                raise ValueError(f"{name}={value} must be at least 1")
        if frame_channels not in (None, 1, 3):
            raise ValueError(f"frame_channels={frame_channels} must be 1, 3 or None")
        self.every = every
        self.n_images = n_images
        self.frame_channels = frame_channels
        self._last = 0

    def _init_callback(self) -> None:
        model = _checked_crcsac(self.model, type(self).__name__)
        modules = [module for module in model.policy.objectives.values() if isinstance(module, Reconstruction)]
        if not modules:
            raise ValueError(f"no reconstruction among the model's objectives, only {sorted(model.policy.objectives)}")
        self._reconstruction = modules[0]

    def _on_training_start(self) -> None:
        self._last = self.num_timesteps

    def _on_step(self) -> bool:
        buffer = self.model.replay_buffer  # type: ignore[attr-defined]  # a CRCSAC, as _init_callback has checked
        if self.num_timesteps - self._last >= self.every and buffer.size() > 0:
            self._last = self.num_timesteps
            image = Image(self.picture(), "CHW")
            self.logger.record(self.key, image, exclude=("stdout", "log", "json", "csv"))
        return True

    def picture(self) -> th.Tensor:
        """:return: uint8 ``(3, 2 H, n_images W)``: frames above their reconstructions"""
        model = _checked_crcsac(self.model, type(self).__name__)
        assert model.replay_buffer is not None
        state = np.random.get_state()
        count = max(self.n_images, STATISTICS_BATCH) if self._reconstruction.standardize else self.n_images
        frames = model.replay_buffer.sample(count).observations
        np.random.set_state(state)
        encoder, decoder = model.critic.features_extractor, self._reconstruction.decoder
        modes = encoder.training, decoder.training
        encoder.train(False)
        decoder.train(False)
        images, _ = split_observations(frames, model.observation_space)
        images = center_crop(images, encoder.input_shape[1:])
        pixels = scale_pixels(images)
        with th.no_grad(), th.random.fork_rng():  # quantisation draws noise
            decoded = self._reconstruction.as_pixels(decoder(encoder(pixels)), images)  # (B, C, H, W)
        encoder.train(modes[0])
        decoder.train(modes[1])
        shown = self.frame_channels or (3 if pixels.shape[1] % 3 == 0 else 1)
        rows = [th.cat(list(one[: self.n_images, -shown:]), dim=2) for one in (pixels, decoded)]  # (shown, H, n_images W)
        picture = th.cat(rows, dim=1).expand(3, -1, -1)
        return (picture * 255).round().to(th.uint8).cpu()


class ObjectiveScheduleCallback(BaseCallback):
    """
    Change the weights of a :class:`~sb3_crc.CRCSAC`'s objectives, and the learning rate of its encoder, as training proceeds.

    Adam divides out the common scale of the auxiliary loss, so weights set the ratios between objectives;
    ``encoder_learning_rate`` sets how strong all of them are (with ``joint_update`` the weights do both, and that rate is the
    objectives' own). After ``learn()`` the model has its constructor's values again.

    :param weights: name of an objective -> number, function of the remaining progress (1 at the start, 0 at the end), or
        ``"lin_x"``: from x down to 0. Objectives that are not named keep their weight.
    :param encoder_learning_rate: the same for the learning rate
    :param verbose: as in SB3
    :raises ValueError: if nothing is scheduled, or for values that are not finite and at least 0; when ``learn()`` begins, for
        names that are not among the model's objectives
    """

    def __init__(
        self,
        weights: Mapping[str, LearningRate] | None = None,
        *,
        encoder_learning_rate: LearningRate | None = None,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        if not weights and encoder_learning_rate is None:
            raise ValueError("nothing to schedule: give weights, encoder_learning_rate or both")
        self.weights = {name: lr_schedule(weight) for name, weight in (weights or {}).items()}
        self.encoder_learning_rate = None if encoder_learning_rate is None else lr_schedule(encoder_learning_rate)
        rates = [] if self.encoder_learning_rate is None else [("encoder_learning_rate", self.encoder_learning_rate)]
        for name, schedule in [*self.weights.items(), *rates]:
            for progress in (1.0, 0.5, 0.0):
                _scheduled(name, schedule, progress)

    def _init_callback(self) -> None:
        model = _checked_crcsac(self.model, type(self).__name__)
        known = objective_weights(model.objectives)
        unknown = [name for name in self.weights if name not in known]
        if unknown:
            raise ValueError(f"no objective {unknown[0]!r} to schedule; the model has: {', '.join(known) or 'none'}")
        if not known:
            raise ValueError("the model has objectives={}: there is neither a weight nor an encoder_learning_rate to schedule")

    def _on_training_start(self) -> None:
        model = _checked_crcsac(self.model, type(self).__name__)
        if self.encoder_learning_rate is not None:
            model._lr_schedules["encoder_learning_rate"] = self.encoder_learning_rate  # train() reads it at each call
        model.before_updates.append(self._apply)
        self._apply()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:  # for the log, also before there are updates
        self._apply()

    def _apply(self) -> None:
        model = _checked_crcsac(self.model, type(self).__name__)
        progress = model._current_progress_remaining
        values = {name: _scheduled(name, schedule, progress) for name, schedule in self.weights.items()}
        model._objective_weights = {**model._objective_weights, **values}
        for name, value in values.items():
            self.logger.record(f"representation/{name}_weight", value)


class NStepScheduleCallback(BaseCallback):
    """
    Change over how many rewards the returns of a :class:`~sb3_crc.buffers.FrameReplayBuffer` sum as training proceeds.

    Long returns carry rewards back quickly while the critic knows nothing, but old policies' actions are in them; short ones
    have no such bias (annealed as in BBF, arXiv 2305.19452). After ``learn()`` the buffer has its own number again.

    :param n_steps: share of the training that is done, from 0 to below 1 -> number of rewards from there on, at least 1; until
        the first share the buffer's own number stays
    :param verbose: as in SB3
    :raises ValueError: for an empty mapping or one with other keys or values; when ``learn()`` begins, if the model's replay
        buffer is none of ours
    """

    def __init__(self, n_steps: Mapping[float, int], *, verbose: int = 0):
        super().__init__(verbose)
        if not n_steps:
            raise ValueError("n_steps={}: nothing to schedule")
        for share, number in n_steps.items():
            if not 0 <= share < 1:
                raise ValueError(f"n_steps={dict(n_steps)}: {share!r} is no share of the training, from 0 to below 1")
            if not isinstance(number, int) or isinstance(number, bool) or number < 1:
                raise ValueError(f"n_steps={dict(n_steps)}: {number!r} must be a whole number, at least 1")
        self.n_steps = dict(sorted(n_steps.items()))
        self._own: int | None = None  # the buffer's, while it is scheduled

    def _init_callback(self) -> None:
        buffer = getattr(self.model, "replay_buffer", None)
        if not isinstance(buffer, FrameReplayBuffer):
            raise ValueError(f"NStepScheduleCallback needs a FrameReplayBuffer, the model has {type(buffer).__name__}")

    def _on_training_start(self) -> None:
        if self._own is None:  # else a stock algorithm was interrupted
            self._own = self._buffer.n_steps
        self._buffer.n_steps = self._own
        if isinstance(self.model, CRCSAC):
            self.model.before_updates.append(self._apply)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:  # right before train()
        self._apply()

    def _apply(self) -> None:
        done = 1 - self.model._current_progress_remaining
        for share, number in self.n_steps.items():
            if done >= share:
                self._buffer.n_steps = number
        self.logger.record("train/n_steps", self._buffer.n_steps)

    def _on_training_end(self) -> None:
        if self._own is not None:
            self._buffer.n_steps, self._own = self._own, None

    @property
    def _buffer(self) -> FrameReplayBuffer:
        buffer = self.model.replay_buffer  # type: ignore[attr-defined]
        assert isinstance(buffer, FrameReplayBuffer)
        return buffer


def _checked_crcsac(model: BaseAlgorithm, callback: str) -> CRCSAC:
    if not isinstance(model, CRCSAC):
        raise ValueError(f"{callback} is for CRCSAC, got {type(model).__name__}")
    return model


def _scheduled(name: str, schedule: FloatSchedule, progress: float) -> float:
    value = schedule(progress)
    if not (math.isfinite(value) and value >= 0):
        raise ValueError(f"schedule of {name!r}: the value must be finite and >= 0, got {value} at progress {progress}")
    return value
