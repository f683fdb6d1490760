"""Where memory is short the error says what would fit."""

from typing import Any

import pytest
import torch as th

from tests.compared_models import parameters
from tests.conftest import make_model


@pytest.mark.parametrize(("fits", "hint"), [(5, "batch_size=4 fits"), (0, "no smaller one fits either")])
@pytest.mark.parametrize(
    "error",
    [
        th.OutOfMemoryError("CUDA out of memory. Tried to allocate 20 GiB"),
        RuntimeError("DefaultCPUAllocator: not enough memory"),
    ],
)
def test_where_memory_is_short_the_batch_that_fits_is_named(
    error: Exception, fits: int, hint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = make_model()
    convolve = type(model.critic.features_extractor).convolve

    def short(self: Any, images: Any) -> Any:
        if len(images) > fits:
            raise error
        return convolve(self, images)

    monkeypatch.setattr(type(model.critic.features_extractor), "convolve", short)
    before = parameters(model)
    message = rf"batch_size=16 does not fit into the memory of cpu \({type(error).__name__}: .*memory.*\); {hint}"
    with pytest.raises(MemoryError, match=message):
        model.train(gradient_steps=1, batch_size=16)
    assert all(map(th.equal, before, parameters(model)))


def test_other_errors_of_an_update_are_raised_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model()
    monkeypatch.setattr(model, "_critic_loss", lambda views: (_ for _ in ()).throw(RuntimeError("mat1 and mat2")))
    with pytest.raises(RuntimeError, match="mat1 and mat2"):
        model.train(gradient_steps=1, batch_size=16)
