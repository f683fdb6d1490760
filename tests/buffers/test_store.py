"""FrameStore and the stacks that lie in it.

B batch, k frames in a stack, C channels of a frame, H, W height and width.
"""

import copy
import io
import pickle
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_crc.augmentations import CROPS, Images, bind_augmentation, center_crop, random_crop, random_crop_overlay
from sb3_crc.buffers import FrameReplayBuffer
from sb3_crc.buffers.store import FrameStacks, FrameStore
from tests.buffers.worlds import ACTIONS, World, assert_equal_buffers, assert_same, fill

needs_cuda = pytest.mark.skipif(not th.cuda.is_available(), reason="no CUDA")


def frames(count: int, shape: tuple[int, ...] = (3, 6, 8), dtype: Any = np.uint8) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (count, *shape)).astype(dtype)


def stacks(count: int = 12, batch: int = 16, k: int = 3, device: str = "cpu", **kwargs: Any) -> FrameStacks:
    """Of a store whose ring has been round once."""
    store = FrameStore(kwargs.get("shape", (3, 6, 8)), np.uint8, count, device)
    store.extend(frames(5, **kwargs))
    store.drop_before(5)
    store.extend(frames(count, **kwargs))
    return FrameStacks(store, np.random.default_rng(2).integers(5, count + 5, (batch, k)))


# -- The ring ----------------------------------------------------------------------------------------------------------


def test_numbers_stay_while_places_are_used_again() -> None:
    given, store = frames(20), FrameStore((3, 6, 8), np.uint8, 4, "cpu")
    for number in range(20):
        store.drop_before(number - 3)
        assert store.append(given[number]) == number
        assert np.array_equal(store.read(store.first, store.end), given[max(0, number - 3) : number + 1])
    assert (store.capacity, store.first, store.end, len(store)) == (4, 16, 20, 4)


def test_frames_are_dropped_only_forwards_and_only_those_that_are_there() -> None:
    store = FrameStore((3, 6, 8), np.uint8, 4, "cpu")
    store.extend(frames(4))
    store.drop_before(3)
    store.drop_before(1)
    assert (store.first, store.end) == (3, 4)
    store.drop_before(100)
    assert (store.first, store.end, len(store)) == (4, 4, 0)
    assert store.read(4, 4).shape == (0, 3, 6, 8)
    store.clear()
    assert (store.append(frames(1)[0]), len(store)) == (0, 1)


@pytest.mark.parametrize("at_once", [1, 3, 17, 40])
def test_a_full_store_grows_and_keeps_its_frames(at_once: int) -> None:
    given, store = frames(45), FrameStore((3, 6, 8), np.uint8, 4, "cpu")
    store.extend(given[:3])
    store.drop_before(2)  # the ring has been round when it grows
    store.extend(given[3:5])
    for start in range(5, 45, at_once):
        store.extend(given[start : start + at_once])
        assert store.capacity >= len(store)
    assert np.array_equal(store.read(2, 45), given[2:])


def test_memory_that_runs_out_while_it_grows_costs_no_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    given, store = frames(5), FrameStore((3, 6, 8), np.uint8, 4, "cpu")
    store.extend(given[:4])

    def too_much(*args: Any, **kwargs: Any) -> th.Tensor:
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory")

    with monkeypatch.context() as patch:
        patch.setattr(th, "empty", too_much)
        with pytest.raises(RuntimeError, match="allocate"):
            store.append(given[4])
    assert np.array_equal(store.read(0, 4), given[:4])
    store.append(given[4])
    assert np.array_equal(store.read(0, 5), given)


def test_growing_an_empty_store_takes_memory_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a GPU, memory is taken when it is asked for."""
    sizes, empty = [], th.empty
    monkeypatch.setattr(th, "empty", lambda size, **kwargs: sizes.append(size[0]) or empty(size, **kwargs))
    store = FrameStore((3, 6, 8), np.uint8, 4, "cpu")
    assert store.taken_bytes == 0
    store.extend(frames(20))
    assert sizes == [20]
    assert store.taken_bytes == 20 * store.frame_bytes == 20 * 3 * 6 * 8


@pytest.mark.parametrize("n_steps", [1, 3])
def test_one_step_episodes_make_the_store_grow(n_steps: int) -> None:
    """Each stores k + 1 frames, where room for one is made."""
    world = World(2, k=3)
    buffer, twin = world.buffer(40, n_steps=n_steps), world.twin(40, n_steps)
    room = buffer.store.capacity
    for _ in range(3):
        fill([world.step(["terminated", "truncated"], "arbitrary") for _ in range(21)], buffer, twin)
        assert_equal_buffers(buffer, twin)
    assert buffer.store.capacity >= len(buffer.store) > 3 * 2 * 40 > room


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))], ids=["deepcopy", "pickle"])
def test_copies_are_of_their_own(duplicate: Callable[[FrameStore], FrameStore]) -> None:
    store = stacks()._store
    other = duplicate(store)
    assert np.array_equal(other.read(other.first, other.end), store.read(store.first, store.end))
    other.append(frames(1)[0])
    assert (store.end, other.end, store.capacity) == (17, 18, 12)
    store.drop_before(7)
    store.append(255 - frames(1)[0])
    assert not np.array_equal(store.read(17, 18), other.read(17, 18))


def test_a_pickle_holds_the_frames_that_came() -> None:
    world = World(k=3, size=(20, 20))
    buffer = world.buffer(10_000)
    assert len(pickle.dumps(buffer.store)) < 2_000
    fill(world.episodes(10), buffer)
    assert len(pickle.dumps(buffer.store)) < 20 * 400 + 2_000


def test_what_was_pickled_beside_a_gpu_is_loaded_where_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(th.cuda, "is_available", lambda: False)
    world = World()
    buffer, twin = world.buffer(9), world.twin(9)
    fill(world.episodes(12), buffer, twin)
    state = buffer.store.__getstate__()
    buffer.store = FrameStore.__new__(FrameStore)
    buffer.store.__setstate__({**state, "device": th.device("cuda")})
    assert buffer.store.device.type == "cpu"
    assert_equal_buffers(buffer, twin)


# -- Stacks ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [1, 2, 4])
def test_stacks_are_their_frames_side_by_side(k: int) -> None:
    lying = stacks(k=k)
    whole = lying.whole()
    assert lying.shape == tuple(whole.shape) == (16, 3 * k, 6, 8)
    for stack, numbers in zip(whole.numpy(), lying.numbers, strict=True):
        assert np.array_equal(stack, np.concatenate([lying._store.read(n, n + 1)[0] for n in numbers]))


def test_windows_are_cut_out_of_the_stacks() -> None:
    lying = stacks()
    tops, lefts = (th.randint(high, (16,)) for high in (6 - 4 + 1, 8 - 3 + 1))
    windows = lying.windows(tops, lefts, (4, 3))
    for window, stack, top, left in zip(windows, lying.whole(), tops, lefts, strict=True):
        assert th.equal(window, stack[:, top : top + 4, left : left + 3])


def test_the_way_of_a_gpu_gathers_the_same() -> None:
    """On one, torch indexes; here it does so where the frames lie."""
    lying, tops, lefts = stacks(), th.arange(16) % 3, th.arange(16) % 6
    expected = lying.whole(), lying.windows(tops, lefts, (4, 3))
    lying._store.device, lying._device = th.device("cuda"), th.device("cpu")
    assert_same(lying.whole(), expected[0])
    assert_same(lying.windows(tops, lefts, (4, 3)), expected[1])


CROPPED: list[tuple[Callable[..., th.Tensor], Any, dict[str, Any]]] = [
    (random_crop, 4, {}),
    (random_crop, (5, 3), {"last_offset": False}),
    (random_crop, (6, 8), {}),
    (center_crop, 4, {}),
    (center_crop, (1, 7), {}),
    (random_crop_overlay, 4, {"alpha": 0.3}),
]


@pytest.mark.parametrize(("crop", "size", "kwargs"), CROPPED)
def test_crops_of_stored_stacks_equal_crops_of_whole_ones(
    crop: Callable[..., th.Tensor], size: Any, kwargs: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    lying = stacks()
    th.manual_seed(3)
    expected = crop(lying.whole(), size, **kwargs)
    after = th.rand(1)
    monkeypatch.setattr(FrameStacks, "whole", None)
    th.manual_seed(3)
    assert_same(crop(lying, size, **kwargs).contiguous(), expected.contiguous())
    assert th.equal(th.rand(1), after)  # as many random numbers were drawn


@pytest.mark.parametrize("name", sorted(CROPS))
def test_the_crops_of_the_registry_make_no_whole_batch(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    augment = bind_augmentation(name, {"size": 4}, (9, 6, 8))
    monkeypatch.setattr(FrameStacks, "whole", None)
    assert augment(stacks()).shape == (16, 9, 4, 4)


def test_other_augmentations_are_given_whole_stacks() -> None:
    lying: Images = stacks()
    shift = bind_augmentation("random_shift", {"pad": 2}, (9, 6, 8))
    th.manual_seed(3)
    expected = shift(lying.whole())
    th.manual_seed(3)
    assert th.equal(shift(lying), expected)


def test_a_crop_takes_the_memory_of_its_windows() -> None:
    lying = stacks(count=20, batch=64, shape=(3, 100, 100))
    lying.windows(th.zeros(64, dtype=th.long), th.zeros(64, dtype=th.long), (84, 84))
    tracemalloc.start()
    crops = random_crop(lying, 30)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert crops.nbytes <= peak < 1.2 * crops.nbytes < lying.whole().nbytes / 9


# -- CUDA --------------------------------------------------------------------------------------------------------------


@needs_cuda
def test_an_empty_store_on_cuda_takes_no_memory() -> None:
    before = th.cuda.memory_allocated()
    buffer = FrameReplayBuffer(100_000, World(k=3, c=3, size=(100, 100)).space, ACTIONS, "cuda", frame_channels=3)
    stream = io.BytesIO()
    pickle.dump(buffer, stream)
    pickle.loads(stream.getvalue())
    assert th.cuda.memory_allocated() == before


@needs_cuda
@pytest.mark.parametrize("move", [False, True])
def test_a_store_on_cuda_equals_one_on_the_cpu(move: bool) -> None:
    on_cpu, on_cuda = stacks(), stacks(device="cpu" if move else "cuda")
    on_cuda._store.to("cuda")
    assert on_cuda.device.type == on_cuda.whole().device.type == "cuda"
    assert_same(on_cuda.whole().cpu(), on_cpu.whole())
    for crop, size, kwargs in CROPPED:
        th.manual_seed(3)
        expected = crop(on_cpu, size, **kwargs)
        th.manual_seed(3)
        cropped = crop(on_cuda, size, **kwargs)
        assert cropped.device.type == "cuda"
        if crop is random_crop_overlay:
            assert (cropped.cpu().int() - expected.int()).abs().max() <= 1  # interpolation
        else:
            assert_same(cropped.cpu(), expected)


@needs_cuda
@pytest.mark.parametrize("n_steps", [1, 3])
def test_a_buffer_on_cuda_equals_sb3s(n_steps: int) -> None:
    world = World(2)
    buffer, twin = world.buffer(9, n_steps=n_steps), world.twin(9, n_steps)
    buffer.device = th.device("cuda")
    for transition in world.episodes(22, 3):
        fill([transition], buffer, twin)
    assert buffer.sample(4).observations.device.type == "cuda"
    loaded = pickle.loads(pickle.dumps(buffer))
    assert loaded.store.device.type == "cuda"
    loaded.device = th.device("cpu")
    assert_equal_buffers(loaded, twin)
