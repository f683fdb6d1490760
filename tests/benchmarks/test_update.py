"""An update of CRC-RL stays cheaper than stock SAC's, and its needed operations are those that the method needs."""

import gc
from functools import partial

import pytest
import torch as th

from benchmarks.flops import operations
from benchmarks.networks import NETWORKS
from benchmarks.report import Target, judged
from benchmarks.update import STOCK, count, measure, ours, textbook


@pytest.mark.slow
@pytest.mark.alone
def test_crc_is_cheaper_than_stock_sac() -> None:
    measured = measure("paper", 128, 2, repeats=5, methods=("crc", "rad"), peers=(STOCK,))
    rows = {row["method"]: row for row in measured}
    print({name: round(row["/ stock"], 2) for name, row in rows.items()})
    assert rows["crc"]["/ stock"] < 0.9
    assert rows["rad"]["/ stock"] < 0.6


def test_no_pass_is_made_twice() -> None:
    """By hand: passes through the encoder and, where there is one, the decoder; heads are 1 to 5 % beside these."""
    model = NETWORKS["paper"].crc_sac("crc", 16)
    encoder, decoder = model.critic.features_extractor, model.policy.objectives["reconstruction"].decoder
    images, latents = th.zeros(16, *encoder.input_shape), th.zeros(16, encoder.features_dim, requires_grad=True)
    forward = operations(lambda: encoder(images))
    with_backward = operations(lambda: encoder(images).sum().backward())
    painting = operations(lambda: decoder(latents).sum().backward())
    heads = 1.08
    # Anchor, once more backwards for the objectives; the bootstrap by both encoders, the positive by the key encoder
    crc = with_backward + (with_backward - forward) + 3 * forward + painting
    assert crc <= count(partial(ours, "crc", "paper", 16, 2)) / 2 <= heads * crc
    joint = with_backward + 3 * forward + painting
    assert joint <= count(partial(ours, "crc joint_update *", "paper", 16, 2)) / 2 <= heads * joint
    rad = with_backward + 2 * forward
    assert rad <= count(partial(ours, "rad", "paper", 16, 2)) / 2 <= heads * rad
    # The textbook encodes o_t for each of its four losses, half a time more for the actor, and the positive twice
    plain = 4 * with_backward + (2 + 0.5 + 2) * forward + painting
    assert plain <= count(partial(textbook, "paper", 16, 2)) / 2 <= heads * plain


def test_a_target_is_met_from_one_side() -> None:
    row = judged({"ms": 3.0, "peak %": 70.0}, [Target("ms", 2.5), Target("peak %", 70, at_least=True)])
    assert row["targets"] == {"ms": "<= 2.5 MISS", "peak %": ">= 70 PASS"}


def test_memory_is_kept_until_the_process_ends() -> None:
    import sb3_crc.memory
    from benchmarks.interleave import keep_memory

    before = sb3_crc.memory._keepers
    keep_memory()
    gc.collect()
    assert sb3_crc.memory._keepers == before + (sb3_crc.memory._glibc() is not None)
