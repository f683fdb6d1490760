"""The training that all others are compared with."""

import pytest
import torch as th

from sb3_crc import CRCSAC
from tests.checkpoints.runs import train


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> CRCSAC:
    """Nothing has stopped it."""
    th.set_num_threads(1)  # fixtures of tests, which set it too, come later
    return train(tmp_path_factory.mktemp("whole"))
