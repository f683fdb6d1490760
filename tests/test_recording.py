"""Recorded updates: on a CPU by a tracer that stands for CUDA graphs and writes down what an update does to which tensor."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch as th
from torch.fx.experimental.proxy_tensor import make_fx

from sb3_crc import CRCSAC
from sb3_crc.objectives import AuxiliaryObjective
from sb3_crc.presets import PRESETS
from sb3_crc.recording import WARM_UP, Metrics, RecordedUpdates, Replay
from sb3_crc.views import Views
from tests.conftest import POLICY_KWARGS, NoiseEnv, make_model

OWN = ("batch_size", "buffer_size", "learning_starts", "initial_updates")


class Tracer:
    """
    Like a CUDA graph, a trace knows tensors alone: what Python decided stays decided, and no value can be asked for. It is
    made without doing the work.
    """

    def __init__(self, model: CRCSAC):
        self.model = model

    def __call__(self, work: Callable[[], Metrics]) -> tuple[Replay, Metrics]:
        metrics: Metrics = {}

        def outputs() -> list[th.Tensor]:
            metrics.update(work())
            return list(metrics.values())

        before = [(tensor, tensor.detach().clone()) for tensor in tensors_of(self.model)]
        state = th.get_rng_state()
        traced = make_fx(outputs)()
        th.set_rng_state(state)
        with th.no_grad():
            for tensor, value in before:
                tensor.copy_(value)
        results = {name: th.zeros(()) for name in metrics}

        def replay() -> None:
            for result, value in zip(results.values(), traced(), strict=True):
                result.copy_(value.reshape(()))

        return replay, results


class Direct:
    """Does the work anew each time, on the memory of the recording."""

    made = 0

    def __call__(self, work: Callable[[], Metrics]) -> tuple[Replay, Metrics]:
        self.made += 1
        results: Metrics = {}

        def replay() -> None:
            for name, value in work().items():
                results[name] = value.reshape(())

        return replay, results


def tensors_of(model: CRCSAC) -> Iterator[th.Tensor]:
    yield from model.policy.state_dict(keep_vars=True).values()
    for optimizer in model._optimizers().values():
        for state in optimizer.state.values():
            yield from (value for value in state.values() if isinstance(value, th.Tensor))
    if model.log_ent_coef is not None:
        yield model.log_ent_coef


def recorded(record: Any = None, **kwargs: Any) -> CRCSAC:
    model = make_model(compile=True, **kwargs)
    record = Tracer(model) if record is None else record
    model._recorded = RecordedUpdates(model._update, model._optimizers().values(), record)
    model._weight_tensors = {name: th.zeros(()) for name in model._objective_weights}
    return model


def assert_same(one: CRCSAC, other: CRCSAC) -> None:
    for mine, theirs in zip(tensors_of(one), tensors_of(other), strict=True):
        th.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-6)


#: What takes longest to record, and is replayed as the others are
LONGER = dict.fromkeys(("crc_release", "drq", "sac_ae"), pytest.mark.slow)


@pytest.mark.parametrize(
    "own",
    [
        *(
            pytest.param({key: value for key, value in settings.items() if key not in OWN}, marks=LONGER.get(name, ()))
            for name, settings in PRESETS.items()
        ),
        {"joint_update": True, "policy_delay": 3, "n_steps": 3},
        {"balance": "grad_norm", "auxiliary_interval": 2, "max_grad_norm": 1.0, "ent_coef": 0.1},
        {"objectives": {"contrastive": {"weight": 1.0, "key": "next"}}, "n_steps": 3, "augmentation": "random_shift"},
        {"encoder_learning_rate": "lin_0.01_0.5"},
    ],
    ids=[*PRESETS, "joint", "balanced", "next", "resting"],
)
def test_replayed_updates_are_those_that_python_makes(own: dict[str, Any]) -> None:
    models = recorded(**own), recorded(Direct(), **own)
    for model in models:
        model.set_random_seed(1)
        for remaining in (1.0, 0.7, 0.4):
            model._current_progress_remaining = remaining
            model.train(gradient_steps=8, batch_size=16)
    tracer = models[0]._recorded
    assert tracer is not None and 0 < len(tracer._recordings) <= 6
    assert_same(*models)
    for name, value in models[1].logger.name_to_value.items():
        assert models[0].logger.name_to_value[name] == pytest.approx(value, rel=1e-4, abs=1e-5), name


class Ahead(AuxiliaryObjective):
    """Logs whether o_{t+1} is an observation of its own."""

    reads_next = True

    def forward(self, views: Views) -> th.Tensor:
        same = (views.next.images == views.bootstrap.images).float().mean()
        self.metrics = {"same": same}
        return views.anchor.latent.square().mean()


@pytest.mark.parametrize("record", [None, Direct()], ids=["traced", "direct"])
def test_an_update_with_longer_returns_is_another_one(record: Any) -> None:
    """With one step o_{t+1} is o_{t+n}, with more it is not: nothing of that shows in the shapes of a batch."""
    model = recorded(record, objectives={f"{__name__}.Ahead": 1.0}, augmentation="center_crop")
    same = []
    for n_steps in (1, 3, 1, 3):
        model.replay_buffer.n_steps = n_steps
        model.train(gradient_steps=8, batch_size=16)
        same.append(model.logger.name_to_value["representation/Ahead_same"])
    assert same[0] == same[2] == 1 and max(same[1], same[3]) < 0.5


def test_the_first_updates_are_made_as_ever_and_then_one_of_each_kind_is_recorded() -> None:
    recorder = Direct()
    model = recorded(recorder, policy_delay=2, target_update_interval=2)
    counts = []
    for _ in range(12):
        model.train(gradient_steps=1, batch_size=16)
        counts.append(recorder.made)
    assert counts == [0] * (2 * WARM_UP) + [1] + [2] * 5


def test_learning_rates_and_weights_reach_what_was_recorded() -> None:
    model = recorded(learning_rate="lin_0.01", objectives={"contrastive": 0.5, "reconstruction": 0.5})
    model.train(gradient_steps=8, batch_size=16)
    model._current_progress_remaining = 0.0
    before = [tensor.detach().clone() for tensor in model.policy.critic.parameters()]
    model.train(gradient_steps=4, batch_size=16)
    assert all(map(th.equal, before, model.policy.critic.parameters()))  # the rate is zero
    model._current_progress_remaining = 0.5
    model._objective_weights = {"contrastive": 0.0, "reconstruction": 2.0}
    model.train(gradient_steps=2, batch_size=16)
    logged = model.logger.name_to_value
    assert logged["representation/loss"] == pytest.approx(2 * logged["representation/reconstruction"], rel=1e-5)


class Plain(AuxiliaryObjective):
    """Has no parameters."""

    def forward(self, views: Views) -> th.Tensor:
        return views.query.latent.square().mean()


@pytest.mark.parametrize("joint_update", [False, True])
def test_an_objective_without_parameters_is_recorded(joint_update: bool) -> None:
    model = recorded(objectives={"tests.test_recording.Plain": 1.0}, joint_update=joint_update)
    model.train(gradient_steps=9, batch_size=16)
    optimizer = model.policy.encoder_optimizer
    assert optimizer is not None and all(isinstance(group["lr"], th.Tensor) for group in optimizer.param_groups)
    assert ("train/encoder_gradient_norm" in model.logger.name_to_value) is not joint_update


class Asks(AuxiliaryObjective):
    """Waits for the device in each update."""

    def forward(self, views: Views) -> th.Tensor:
        loss = views.query.latent.square().mean()
        return loss * (2.0 if loss.item() > 1 else 1.0)


def test_an_update_that_asks_for_a_value_cannot_be_recorded() -> None:
    model = recorded(objectives={"tests.test_recording.Asks": 1.0})
    with pytest.raises(RuntimeError, match="tracing tensor|data-dependent|get value"):
        model.train(gradient_steps=8, batch_size=16)


def test_another_shape_of_the_batch_is_another_recording() -> None:
    model = recorded(Direct(), policy_delay=1, target_update_interval=1)
    model.train(gradient_steps=WARM_UP + 2, batch_size=16)
    model.train(gradient_steps=2, batch_size=8)
    assert len(model._recorded._recordings) == 2  # type: ignore[union-attr]


def test_given_parameters_are_trained_on() -> None:
    model, other = recorded(policy_delay=1, target_update_interval=1), make_model(seed=1)
    model.train(gradient_steps=8, batch_size=16)
    other.train(gradient_steps=2, batch_size=16)
    model.set_parameters(other.get_parameters(), device="cpu")
    assert not model._recorded._recordings  # type: ignore[union-attr]
    for optimizer in model._optimizers().values():
        assert all(isinstance(group["lr"], float) and not group["capturable"] for group in optimizer.param_groups)
    model.train(gradient_steps=8, batch_size=16)
    assert all(th.isfinite(tensor).all() for tensor in model.policy.parameters())


def test_on_a_cpu_nothing_is_recorded_and_the_argument_is_kept(tmp_path: Any) -> None:
    model = make_model(compile=True, precision="bfloat16", replay_device="cpu")
    assert model._recorded is None
    model.train(gradient_steps=2, batch_size=16)
    model.save(tmp_path / "model")
    loaded = CRCSAC.load(tmp_path / "model")
    assert (loaded.compile, loaded.precision, loaded.replay_device) == (True, "bfloat16", "cpu")


def test_what_was_saved_of_recorded_updates_is_trained_on_without(tmp_path: Any) -> None:
    model = recorded(Direct())
    model.train(gradient_steps=8, batch_size=16)
    model.save(tmp_path / "model")
    loaded = CRCSAC.load(tmp_path / "model", env=NoiseEnv())
    loaded.replay_buffer = model.replay_buffer
    loaded._logger = model.logger
    loaded.train(gradient_steps=2, batch_size=16)
    assert loaded._n_updates == 10
    assert all(isinstance(group["lr"], float) for group in loaded.critic.optimizer.param_groups)


def test_an_optimizer_that_cannot_be_recorded_is_refused() -> None:
    own = {**POLICY_KWARGS, "optimizer_class": th.optim.SGD}
    with pytest.raises(ValueError, match="compile=True needs an optimizer whose steps can be recorded.*SGD"):
        make_model(compile=True, policy_kwargs=own)
