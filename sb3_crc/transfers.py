"""From the host's memory to a GPU without waiting for it."""

import numpy as np
import torch as th


def to_device(values: np.ndarray | th.Tensor, device: th.device) -> th.Tensor:
    """
    Copy to a device without waiting for what it has to do before. Work that is launched after this call finds the copy there.

    :param values: on the host, or there already
    :param device: on which they are needed
    :return: the values there; on a CPU these themselves
    """
    tensor = th.from_numpy(values) if isinstance(values, np.ndarray) else values
    if tensor.device.type == device.type:
        return tensor
    if device.type == "cuda" and tensor.device.type == "cpu":
        tensor = tensor.pin_memory()  # from other memory, copies wait
    return tensor.to(device, non_blocking=device.type == "cuda")
