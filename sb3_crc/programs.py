"""Policies as programs for other runtimes: ONNX, and torch.export. From bytes of pixels to actions, scaling included."""

import io
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_crc.atomic import atomic_write
from sb3_crc.crc_sac import CRCSAC
from sb3_crc.policies import CRCPolicy

ONNX, TORCH = ".onnx", ".pt2"
#: Largest difference between an action of the program and one of the policy, in units of the action space
TOLERANCE = 1e-5


class DeterministicActions(nn.Module):
    """
    What ``predict(deterministic=True)`` does with a batch.

    :param policy: whose actor acts
    """

    low: th.Tensor
    high: th.Tensor

    def __init__(self, policy: CRCPolicy):
        super().__init__()
        assert isinstance(policy.action_space, spaces.Box)
        self.actor = policy.actor
        self.register_buffer("low", th.as_tensor(policy.action_space.low))
        self.register_buffer("high", th.as_tensor(policy.action_space.high))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """:param observations: ``(B, C, H, W)``, uint8; :return: mean actions within the action space ``(B, A)``"""
        mean_actions, _, _ = self.actor.get_action_dist_params(observations)
        return self.low + 0.5 * (th.tanh(mean_actions) + 1) * (self.high - self.low)


def export_program(model: CRCSAC | CRCPolicy, path: str | Path) -> Path:
    """
    Write the deterministic policy as a program, for any batch size, and compare what it does with what the policy does.

    :param model: a CRCSAC, or its policy, of image observations
    :param path: ``.onnx`` (input ``observations``, output ``actions``), or ``.pt2`` for ``torch.export.load``
    :return: the file
    :raises ValueError: for another suffix or Dict observations, without the extra ``onnx``, or if the program acts differently
    """
    policy, target = model.policy if isinstance(model, CRCSAC) else model, Path(path)
    if target.suffix not in (ONNX, TORCH):
        raise ValueError(f"{target}: a program is written to a file that ends in {ONNX} or {TORCH}")
    if not isinstance(policy.observation_space, spaces.Box):
        raise ValueError(f"a program takes images alone; the policy was made for {policy.observation_space}")
    was_training, device, own_type = policy.training, policy.device, policy.actor.features_extractor.convolution_dtype
    policy.actor.features_extractor.convolution_dtype = th.float32
    acting = DeterministicActions(policy).cpu().eval()
    bytes_of_pixels = np.random.default_rng(0).integers(0, 256, (4, *policy.observation_space.shape), np.uint8)
    observations = th.as_tensor(bytes_of_pixels)
    try:
        with th.no_grad():
            wanted = acting(observations)
            program = th.export.export(acting, (observations,), dynamic_shapes=({0: th.export.Dim("batch")},))
    finally:
        policy.actor.features_extractor.convolution_dtype = own_type
        policy.to(device)
        policy.set_training_mode(was_training)
    with atomic_write(target) as unfinished:
        write, run = (_write_onnx, _run_onnx) if target.suffix == ONNX else (_write_torch, _run_torch)
        write(program, observations, unfinished)
        for size in (1, len(observations)):
            apart = float((run(unfinished, observations[:size]) - wanted[:size]).abs().max())
            if not apart <= TOLERANCE:
                raise ValueError(f"the program's actions differ from the policy's by {apart}, more than {TOLERANCE}")
    return target


def _write_torch(program: th.export.ExportedProgram, observations: th.Tensor, path: Path) -> None:
    buffer = io.BytesIO()  # by name, it would have to end in .pt2
    th.export.save(program, buffer)
    path.write_bytes(buffer.getvalue())


def _run_torch(path: Path, observations: th.Tensor) -> th.Tensor:
    actions: th.Tensor = th.export.load(io.BytesIO(path.read_bytes())).module()(observations).detach()
    return actions


def _write_onnx(program: th.export.ExportedProgram, observations: th.Tensor, path: Path) -> None:
    try:
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError:
        raise ValueError("ONNX needs the extra 'onnx': pip install 'sb3-crc[onnx]'") from None
    with redirect_stdout(io.StringIO()):  # what torch says on the way
        names: dict[str, Any] = {"input_names": ["observations"], "output_names": ["actions"]}
        exported = th.onnx.export(program, (observations,), dynamo=True, verbose=False, **names)
    assert exported is not None
    exported.save(path)


def _run_onnx(path: Path, observations: th.Tensor) -> th.Tensor:
    import onnxruntime

    session = onnxruntime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    return th.as_tensor(session.run(["actions"], {"observations": observations.numpy()})[0])
