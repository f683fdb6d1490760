"""What AuxiliaryLossCallback does to a stock SB3 algorithm: settings, updates, and the file beside the model."""

import io
import json
import math
import os
import warnings
import zipfile
from collections.abc import Iterable, Mapping
from copy import deepcopy
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import safetensors.torch
import torch as th
from safetensors import SafetensorError
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.utils import polyak_update

from sb3_crc.atomic import atomic_write
from sb3_crc.augmentations import AUGMENTATIONS, Images, center_crop
from sb3_crc.encoder import PixelEncoder
from sb3_crc.extractors import ExtractorEncoder, checked_augmentation, trainable_extractor, trainable_parameters
from sb3_crc.image_spaces import image_shape
from sb3_crc.objectives import AuxiliaryObjective, ObjectiveSettings, build_objectives, objective_weights, reads_next
from sb3_crc.representation import checked_loss
from sb3_crc.schedules import lr_schedule, set_learning_rate
from sb3_crc.settings import check_name
from sb3_crc.views import Views

#: Version of the file's layout
FORMAT = 1


@dataclass(frozen=True)
class AuxiliarySettings:
    """
    The arguments of :class:`~sb3_crc.callbacks.AuxiliaryLossCallback`, as they are stored: plain values only.

    :raises ValueError: naming the argument that cannot work and what is allowed
    """

    objectives: ObjectiveSettings
    gradient_steps: int
    learning_rate: float | str
    augmentation: str
    augmentation_kwargs: Mapping[str, Any] | None
    batch_size: int | None
    encoder_tau: float

    def __post_init__(self) -> None:
        if not objective_weights(self.objectives, without="leave the callback away"):
            raise ValueError("objectives={} leaves nothing to train: name at least one, or leave the callback away")
        for name, value in (("gradient_steps", self.gradient_steps), ("batch_size", self.batch_size)):
            if value is None and name == "batch_size":
                continue
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{name}={value!r} must be an integer of at least 1")
        if not (isinstance(self.encoder_tau, int | float) and 0 < self.encoder_tau <= 1):
            raise ValueError(f"encoder_tau={self.encoder_tau!r} must be above 0 and at most 1")
        if not isinstance(self.learning_rate, int | float | str):
            raise ValueError(f"learning_rate={self.learning_rate!r} must be a number or 'lin_x' (a function cannot be stored)")
        rate = lr_schedule(self.learning_rate)(1.0)
        if not (math.isfinite(rate) and rate > 0):
            raise ValueError(f"learning_rate={self.learning_rate!r} must be finite and above 0")
        check_name("augmentation", self.augmentation, AUGMENTATIONS)
        try:
            json.dumps(asdict(self))
        except TypeError as error:
            raise ValueError(f"settings must be plain values, so that they can be stored beside the model: {error}") from error


class AuxiliaryLearner:
    """
    Trains one model's features extractor with weighted objectives, with an optimizer and a key encoder of its own.

    :param model: an off-policy algorithm with image observations
    :param settings: what to train it with
    :raises ValueError: if model and settings do not go together
    """

    def __init__(self, model: BaseAlgorithm, settings: AuxiliarySettings):
        self.extractor = trainable_extractor(model)
        assert isinstance(model, OffPolicyAlgorithm)
        self.model = model
        self.settings = settings
        self.weights = objective_weights(settings.objectives)
        self.batch_size = settings.batch_size or model.batch_size
        assert model.replay_buffer is not None
        capacity = model.replay_buffer.buffer_size * model.replay_buffer.n_envs
        if self.batch_size > capacity:
            raise ValueError(f"batch_size={self.batch_size} is more than the replay buffer holds: {capacity}")
        self.key_encoder = deepcopy(self.extractor).requires_grad_(False).train(False)
        space, normalize_images = model.observation_space, model.policy.normalize_images
        # Views and objectives only read what ExtractorEncoder has, though they are annotated with the encoder of CRCSAC
        self._encoder = cast(PixelEncoder, ExtractorEncoder(self.extractor, space, normalize_images))
        self._key = cast(PixelEncoder, ExtractorEncoder(self.key_encoder, space, normalize_images))
        self._augmentation = checked_augmentation(
            settings.augmentation, settings.augmentation_kwargs or {}, image_shape(space), self._encoder.input_shape
        )
        self.objectives = build_objectives(settings.objectives, self._encoder, get_action_dim(model.action_space))
        self.objectives.to(model.device)
        self._reads_next = reads_next(self.objectives, model.replay_buffer)
        self._lr_schedule = lr_schedule(settings.learning_rate)
        self._parameters = {
            "encoder": trainable_parameters(self.extractor),
            "objectives": trainable_parameters(self.objectives),
        }
        parameters = [parameter for part in self._parameters.values() for parameter in part.values()]
        self.optimizer = th.optim.Adam(parameters, lr=self._lr_schedule(1.0))
        self.n_updates = 0

    def ready(self) -> bool:
        """:return: whether the model has started to learn and a batch without repetitions could be drawn"""
        buffer = self.model.replay_buffer
        assert buffer is not None
        stored = buffer.size() * buffer.n_envs
        return self.model.num_timesteps > self.model.learning_starts and stored >= self.batch_size

    def train(self) -> dict[str, float]:
        """
        Make ``gradient_steps`` updates.

        :return: log name -> mean over the updates, fetched from the device in one transfer
        :raises FloatingPointError: if a loss is not finite
        """
        learning_rate = self._lr_schedule(self.model._current_progress_remaining)
        set_learning_rate(self.optimizer, learning_rate)
        was_training = self.extractor.training
        self.extractor.train(True)
        self.objectives.train(True)
        records: dict[str, list[th.Tensor]] = {}
        for _ in range(self.settings.gradient_steps):
            for name, value in self._update().items():
                records.setdefault(name, []).append(value.detach().reshape(()).float())
        self.extractor.train(was_training)

        means = th.stack([th.stack(values).mean() for values in records.values()]).tolist()
        metrics = dict(zip(records, means, strict=True))
        for name, mean in metrics.items():
            if name.rpartition("/")[2] in {"loss", *self.objectives} and not math.isfinite(mean):
                raise FloatingPointError(f"{name} is {mean} after {self.n_updates} auxiliary updates: training has diverged")
        return {**metrics, "representation/learning_rate": learning_rate}

    def _update(self) -> dict[str, th.Tensor]:
        buffer = self.model.replay_buffer
        assert buffer is not None
        batch = buffer.sample(self.batch_size, env=self.model.get_vec_normalize_env())
        views = Views(batch, self._augment, self._encoder, self._key, gamma=self.model.gamma, offers_next=self._reads_next)
        losses = {name: checked_loss(name, objective, views) for name, objective in self.objectives.items()}
        loss = th.stack([self.weights[name] * value for name, value in losses.items()]).sum()

        encoder, objectives = (list(part.values()) for part in self._parameters.values())
        leaves = views.query.leaves
        gradients = th.autograd.grad(loss, [*leaves, *objectives], allow_unused=True)
        encoder_gradients = views.query.backward(gradients[: len(leaves)], encoder)
        for parameter, gradient in zip([*encoder, *objectives], [*encoder_gradients, *gradients[len(leaves) :]], strict=True):
            parameter.grad = gradient
        self.optimizer.step()
        self.optimizer.zero_grad()  # the algorithm must not find these gradients on its extractor

        polyak_update(self.extractor.parameters(), self.key_encoder.parameters(), self.settings.encoder_tau)
        for buffer_, key_buffer in zip(self.extractor.buffers(), self.key_encoder.buffers(), strict=True):
            key_buffer.copy_(buffer_)  # polyak_update cannot: BatchNorm counts its batches in integers
        self.n_updates += 1
        metrics = {f"representation/{name}": value for name, value in losses.items()}
        for name, objective in self.objectives.items():
            assert isinstance(objective, AuxiliaryObjective)
            metrics |= {f"representation/{name}_{key}": value for key, value in objective.metrics.items()}
        return metrics | {"representation/loss": loss}

    def _augment(self, images: Images) -> th.Tensor:
        return center_crop(self._augmentation(images), self._encoder.input_shape[1:])  # a PixelEncoder may see less

    # -- On disk -------------------------------------------------------------------------------------------------------

    def save_model(
        self, path: str | Path | io.BufferedIOBase, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None
    ) -> None:
        """SB3's ``model.save``, and beside its zip the ``.aux.zip``; put in its place on the model."""
        # This method sits in the model's __dict__, which SB3 pickles: without "save", nothing of ours gets into the zip
        included = [name for name in include or () if name != "save"]
        type(self.model).save(self.model, path, [*(exclude or ()), "save"], included)
        if isinstance(path, str | os.PathLike):
            self.save(path)
        else:
            warnings.warn(
                "the model was saved to a stream: nothing lies beside it; AuxiliaryLossCallback.save(path) stores the rest",
                stacklevel=2,
            )

    def save(self, path: str | os.PathLike[str]) -> Path:
        """
        Write key encoder, objectives and Adam's state as safetensors, settings as JSON.

        :param path: of the model
        :return: the file written, ``<model>.aux.zip``
        """
        header, tensors = self.state()
        tensors = {name: th.clone(value.cpu(), memory_format=th.contiguous_format) for name, value in tensors.items()}
        target = aux_path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(target) as unfinished, zipfile.ZipFile(unfinished, "w") as archive:
            archive.writestr("header.json", json.dumps(header, indent=2))
            archive.writestr("tensors.safetensors", safetensors.torch.save(tensors))
        return target

    def state(self) -> tuple[dict[str, Any], dict[str, th.Tensor]]:
        """:return: what :meth:`load_state` takes; the tensors are the living ones"""
        header = {
            "format": FORMAT,
            "settings": asdict(self.settings),
            "n_updates": self.n_updates,
            "model_updates": self.model._n_updates,
        }
        return header, {name: value.detach() for name, value in self._state()}

    def _state(self) -> Iterable[tuple[str, th.Tensor]]:
        for part, module in (("key_encoder", self.key_encoder), ("objectives", self.objectives)):
            for name, tensor in module.state_dict().items():
                yield f"{part}/{name}", tensor
        for part, parameters in self._parameters.items():
            for name, parameter in parameters.items():
                for key, value in self.optimizer.state.get(parameter, {}).items():
                    yield f"adam/{part}/{name}/{key}", value

    def load_state(self, header: Mapping[str, Any], tensors: Mapping[str, th.Tensor]) -> None:
        """
        Take over what :func:`read_aux` returned.

        :raises ValueError: if it belongs to other objectives or another extractor
        """
        try:
            for part, module in (("key_encoder", self.key_encoder), ("objectives", self.objectives)):
                own = {name.partition("/")[2]: tensor for name, tensor in tensors.items() if name.startswith(f"{part}/")}
                module.load_state_dict(own)
        except RuntimeError as error:
            raise ValueError(f"the auxiliary state does not fit this model and these objectives: {error}") from error
        for part, parameters in self._parameters.items():
            for name, parameter in parameters.items():
                prefix = f"adam/{part}/{name}/"
                own = {key[len(prefix) :]: tensor for key, tensor in tensors.items() if key.startswith(prefix)}
                if own:
                    self.optimizer.state[parameter] = {key: _like(parameter, key, value) for key, value in own.items()}
        self.n_updates = header["n_updates"]
        model_updates = self.model._n_updates
        if header["model_updates"] != model_updates:
            warnings.warn(
                f"the auxiliary state was saved after {header['model_updates']} updates of the model, this model has made "
                f"{model_updates}: are they from the same save?",
                stacklevel=2,
            )


def aux_path(path: str | os.PathLike[str]) -> Path:
    """:param path: of a model, with or without ``.zip``, or of the file itself; :return: ``<model>.aux.zip``"""
    path = Path(path)
    if path.name.endswith(".aux.zip"):
        return path
    return path.with_name(path.name.removesuffix(".zip") + ".aux.zip")


def read_aux(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, th.Tensor]]:
    """
    Read a file of :meth:`AuxiliaryLearner.save`; nothing in it is unpickled.

    :param path: of the model or of the file
    :return: header and tensors
    :raises FileNotFoundError: if there is none
    :raises ValueError: if it is something else
    """
    source = aux_path(path)
    if not source.exists():
        raise FileNotFoundError(f"no auxiliary state at {source}")
    try:
        with zipfile.ZipFile(source) as archive:
            header = json.loads(archive.read("header.json"))
            tensors = safetensors.torch.load(archive.read("tensors.safetensors"))
    except (zipfile.BadZipFile, KeyError, json.JSONDecodeError, SafetensorError) as error:
        raise ValueError(f"{source} is not an auxiliary state, or it is damaged: {error}") from error
    if header.get("format") != FORMAT:
        raise ValueError(f"{source} has format {header.get('format')!r}, this version reads {FORMAT}")
    return header, tensors


def _like(parameter: th.Tensor, key: str, value: th.Tensor) -> th.Tensor:
    # Adam counts its steps on the host; its moments lie on the parameter's device and in its memory order
    return value if key == "step" else th.empty_like(parameter).copy_(value)
