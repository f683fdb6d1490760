"""The views of one batch, each augmented once and encoded at most once per network.

========== ============================= =========== ============== ===================================================
view       what it is                    online      key encoder    who reads it
========== ============================= =========== ============== ===================================================
anchor     augmented o_t                 yes, with   no             critic; actor (features detached)
                                         gradient
query      the anchor; with another      yes, with   no             query of the contrastive loss; input and target of the
           augmentation for the          gradient                   reconstruction; s of the consistency loss
           objectives (``soda``), o_t
           augmented by that
positive   o_t, augmented anew           no          yes            key of the contrastive loss; s' of the consistency
                                                                    loss
clean      the middle of o_t             no          yes            target of the consistency loss with its predictor
                                                                    on the online side (``crc_release``); what the
                                                                    reconstruction paints with ``target="clean"``
next       augmented o_{t+1}             yes,        yes            objectives that declare ``reads_next``: the contrastive
                                         detached                   loss with ``key="next"``
bootstrap  augmented o_{t+n}             yes,        yes            next actions (online), Q targets (key encoder); the
                                         detached                   contrastive loss with ``key="bootstrap"``
========== ============================= =========== ============== ===================================================

Of anchor and bootstrap there may be several, each augmented for itself (DrQ's M and K): the critic averages over all of them,
the actor and the objectives see the first.

For every preset: what no consumer asks for is neither augmented nor encoded, so ``rad`` and ``pixel_sac`` make no positive
and only ``crc_release`` a clean view. With ``anchor="center_crop"`` the anchor is the middle of o_t, not augmented. With
``reencode=True`` (``crc_release``) the anchor is encoded anew after the critic's step: twice per update, thrice where the
actor is updated too.

B batch, C channels (of the whole frame stack), H, W height and width of the encoder's input, F flattened convolution
output, Z latent, P proprioception, A action. With ``n_steps=1``, next and bootstrap are one view.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from functools import cached_property, reduce

import torch as th
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples

from sb3_crc.augmentations import Images, center_crop
from sb3_crc.buffers.samples import FrameSamples
from sb3_crc.encoder import PixelEncoder, scale_pixels
from sb3_crc.gradients import gradients_of
from sb3_crc.image_spaces import split_observations

#: What is read of a batch beside its images
COMMON = ("actions", "rewards", "discounts")


class View:
    """
    One augmented batch of images; pixels and encodings are computed on first use and kept.

    What is read of a view that trains the encoder are leaves: a loss is differentiated with respect to ``latent`` (and to
    ``features``, if it reads those), and :meth:`backward` carries such gradients on into the encoder. So each loss is seen at
    the latent for itself, and the encoder is passed once per optimizer, not once per loss.

    :param images: uint8 ``(B, C, H, W)``
    :param encoder: the online encoder
    :param key_encoder: its exponential moving average
    :param trains_encoder: keep the graph of the online encoding
    :param proprioception: what was observed beside the images, ``(B, P)``, or None
    """

    def __init__(
        self,
        images: th.Tensor,
        encoder: PixelEncoder,
        key_encoder: PixelEncoder,
        *,
        trains_encoder: bool,
        proprioception: th.Tensor | None = None,
    ):
        self.images = images
        self.proprioception = proprioception
        self._encoder = encoder
        self._key_encoder = key_encoder
        self._trains_encoder = trains_encoder

    @cached_property
    def pixels(self) -> th.Tensor:
        """The images as floats in [0, 1], ``(B, C, H, W)``."""
        return scale_pixels(self.images)

    @cached_property
    def features(self) -> th.Tensor:
        """Convolution output of the online encoder, ``(B, F)``."""
        return self._leaf(self._features)

    @cached_property
    def latent(self) -> th.Tensor:
        """Latent of the online encoder, ``(B, Z)``."""
        return self._leaf(self._latent)

    @cached_property
    def key_latent(self) -> th.Tensor:
        """Latent of the key encoder, ``(B, Z)``, without gradient."""
        with th.no_grad():
            latents: th.Tensor = self._key_encoder(self.pixels)
        return latents

    @property
    def leaves(self) -> tuple[th.Tensor, th.Tensor]:
        """``latent`` and ``features``, with respect to which losses are differentiated."""
        return self.latent, self.features

    def backward(
        self, gradients: Sequence[th.Tensor | None], parameters: Sequence[th.Tensor], *, retain_graph: bool = False
    ) -> tuple[th.Tensor | None, ...]:
        """
        Carry gradients at the leaves on into the encoder.

        :param gradients: of some loss, at ``leaves``; None where the loss does not depend on a leaf
        :param parameters: of the online encoder
        :param retain_graph: keep the encoder's graph for another call
        :return: the loss's gradient for each parameter; None where it has none
        """
        if all(gradient is None for gradient in gradients):
            return (None,) * len(parameters)
        pairs = zip((self._latent, self._features), gradients, strict=True)
        outputs, at_outputs = zip(*(pair for pair in pairs if pair[1] is not None), strict=True)
        return gradients_of(outputs, parameters, at_outputs, retain_graph=retain_graph)

    def forget_encoding(self) -> None:
        """Encode anew when an online encoding is asked for next, by the weights of then."""
        for name in ("features", "latent", "_features", "_latent"):
            self.__dict__.pop(name, None)

    @cached_property
    def _features(self) -> th.Tensor:
        with th.set_grad_enabled(self._trains_encoder):
            return self._encoder.convolve(self.pixels)

    @cached_property
    def _latent(self) -> th.Tensor:
        with th.set_grad_enabled(self._trains_encoder):
            return self._encoder.project(self._features)

    def _leaf(self, encoding: th.Tensor) -> th.Tensor:
        return encoding.detach().requires_grad_(self._trains_encoder)


class Views:
    """
    What one update sees of a sampled batch.

    :param batch: a sample of the replay buffer, images on the training device as uint8, or still in the buffer
    :param augment: maps uint8 ``(B, C, *, *)`` to uint8 of the encoder's input size, anew at each call
    :param encoder: the online encoder
    :param key_encoder: its exponential moving average
    :param gamma: discount for buffers that return none of their own
    :param reward_scale: factor on the rewards
    :param augment_anchor: False: the anchor is the middle of o_t (the literal reading of CRC-RL's consistency section)
    :param n_anchors: how many independent augmentations of o_t the critic is fitted on; the first is ``anchor``
    :param n_bootstraps: how many of o_{t+n} the Q targets are averaged over; the first is ``bootstrap``
    :param offers_next: an objective has declared that it reads ``next``
    :param augment_query: as ``augment``, of what the objectives see of o_t instead of the anchor; None: the anchor
    """

    def __init__(
        self,
        batch: ReplayBufferSamples | DictReplayBufferSamples | FrameSamples,
        augment: Callable[[Images], th.Tensor],
        encoder: PixelEncoder,
        key_encoder: PixelEncoder,
        *,
        gamma: float = 0.99,
        reward_scale: float = 1.0,
        augment_anchor: bool = True,
        n_anchors: int = 1,
        n_bootstraps: int = 1,
        offers_next: bool = False,
        augment_query: Callable[[Images], th.Tensor] | None = None,
    ):
        self._batch = batch
        self._augment = augment
        self._encoders = encoder, key_encoder
        self._size = encoder.input_shape[1:]
        self._observation_space = encoder.observation_space
        self._augment_anchor = augment_anchor
        self._n_anchors = n_anchors
        self._n_bootstraps = n_bootstraps
        self._offers_next = offers_next
        self._augment_query = augment_query
        self.actions = batch.actions  # (B, A)
        self.rewards = batch.rewards * reward_scale  # (B, 1)
        discounts = gamma if batch.discounts is None else batch.discounts
        self.discounts = (1 - batch.dones) * discounts  # (B, 1), zero where the episode has terminated
        #: Name of each view that was asked for -> its images, and proprioception or None
        self.drawn: dict[str, tuple[th.Tensor, th.Tensor | None]] = {}

    @cached_property
    def anchors(self) -> list[View]:
        """Augmentations of o_t, the views whose online encodings carry gradients."""
        augment = self._augment if self._augment_anchor else self._middle
        return [self._view(f"anchors/{i}", "observations", augment, trains_encoder=True) for i in range(self._n_anchors)]

    @property
    def anchor(self) -> View:
        """Augmented o_t, the one of ``anchors`` that the actor sees."""
        return self.anchors[0]

    @cached_property
    def query(self) -> View:
        """What the objectives train the encoder through: the anchor, or o_t in an augmentation of their own."""
        if self._augment_query is None:
            return self.anchor
        return self._view("query", "observations", self._augment_query, trains_encoder=True)

    @cached_property
    def positive(self) -> View:
        """o_t again, augmented independently of the anchor."""
        return self._view("positive", "observations", self._augment)

    @cached_property
    def clean(self) -> View:
        """The middle of o_t, not augmented."""
        return self._view("clean", "observations", self._middle)

    @property
    def has_next(self) -> bool:
        """Whether o_{t+1} is another observation than o_{t+n}."""
        batch = self._batch
        return getattr(batch, "one_step_observations", batch.next_observations) is not batch.next_observations

    @cached_property
    def next(self) -> View:
        """Augmented o_{t+1}."""
        if not self._offers_next:
            raise RuntimeError("an objective that reads views.next must declare it: reads_next = True in its class")
        if not self.has_next:
            return self.bootstrap
        return self._view("next", "one_step_observations", self._augment)

    @cached_property
    def bootstraps(self) -> list[View]:
        """Augmentations of o_{t+n}, from which the return is bootstrapped."""
        return [self._view(f"bootstraps/{i}", "next_observations", self._augment) for i in range(self._n_bootstraps)]

    @property
    def bootstrap(self) -> View:
        """Augmented o_{t+n}, the one of ``bootstraps`` that objectives may read."""
        return self.bootstraps[0]

    def backward(
        self,
        td_gradients: Sequence[th.Tensor],
        parameters: Sequence[th.Tensor],
        leaves: tuple[th.Tensor | None, th.Tensor | None] = (None, None),
        *,
        retain_graph: bool = False,
    ) -> list[th.Tensor | None]:
        """
        Carry the critic's gradients on into the encoder.

        :param td_gradients: at the latent of each of ``anchors``
        :param parameters: of the online encoder
        :param leaves: of another loss at the leaves of ``query``, to carry on in the same pass where that is the anchor
        :param retain_graph: keep the graph of ``anchor``'s encoding for another call
        :return: the gradient for each parameter, summed over the views
        """
        passes = []
        if self._augment_query is not None:
            if any(leaf is not None for leaf in leaves):
                passes.append(self.query.backward(leaves, parameters))
            leaves = (None, None)
        latent, features = leaves
        first = td_gradients[0] if latent is None else td_gradients[0] + latent
        passes.append(self.anchor.backward((first, features), parameters, retain_graph=retain_graph))
        for anchor, td_gradient in zip(self.anchors[1:], td_gradients[1:], strict=True):
            passes.append(anchor.backward((td_gradient, None), parameters))
        by_parameter = (list(filter(th.is_tensor, gradients)) for gradients in zip(*passes, strict=True))
        return [reduce(th.add, gradients) if gradients else None for gradients in by_parameter]

    def forget_encodings(self) -> None:
        """Encode what trains the encoder anew when it is read next, by the weights of then."""
        for view in (*self.anchors, self.query):
            view.forget_encoding()

    def draw(self, names: Iterable[str]) -> None:
        """:param names: keys of ``drawn`` of other views of this kind, whose images are to be drawn now, in this order"""
        for name in names:
            getattr(self, name.partition("/")[0])

    def tensors(self) -> dict[str, th.Tensor]:
        """:return: all that was drawn and all that is read beside it, by name"""
        tensors = {name: getattr(self, name) for name in COMMON}
        for name, (images, proprioception) in self.drawn.items():
            tensors[name] = images
            if proprioception is not None:
                tensors[f"{name}/proprioception"] = proprioception
        return tensors

    def of(self, tensors: Mapping[str, th.Tensor]) -> "Views":
        """:param tensors: as :meth:`tensors` returns them; :return: views of these, not encoded yet"""
        other = copy(self)
        for name in ("anchors", "query", "positive", "clean", "next", "bootstraps"):
            other.__dict__.pop(name, None)
        for name in COMMON:
            setattr(other, name, tensors[name])
        other.drawn = {name: (tensors[name], tensors.get(f"{name}/proprioception")) for name in self.drawn}
        return other

    def _view(
        self, name: str, observations: str, augment: Callable[[Images], th.Tensor], *, trains_encoder: bool = False
    ) -> View:
        if name not in self.drawn:
            images, proprioception = split_observations(getattr(self._batch, observations), self._observation_space)
            self.drawn[name] = augment(images), proprioception
        images, proprioception = self.drawn[name]
        return View(images, *self._encoders, trains_encoder=trains_encoder, proprioception=proprioception)

    def _middle(self, images: Images) -> th.Tensor:
        return center_crop(images, self._size)
