"""Places that commands are called with."""

from pathlib import Path
from typing import Any

import pytest

from sb3_crc.export import export_policy
from tests.analysis.conftest import ENV_KWARGS, make_model, make_run
from tests.cli.cases import make_places


@pytest.fixture(scope="session")
def places(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("places")
    about: dict[str, Any] = {"task": "cartpole-balance", "env_kwargs": ENV_KWARGS}
    policy = export_policy(make_model("rad", 0), folder / "policy.sb3crc", **about)  # type: ignore[arg-type]
    runs = {name: make_run(folder / name, "rad", seed) for seed, name in enumerate(("real", "other"))}
    return {**make_places(folder), **runs, "policy": policy}
