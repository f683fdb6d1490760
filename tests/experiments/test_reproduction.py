"""Runs are compared with scores from before."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from sb3_crc.cli import app
from sb3_crc.experiments.reproduction import compare_with
from tests.experiments.test_evidence import scores


def test_a_reproduction_is_compared_with_what_is_committed(tmp_path: Path) -> None:
    committed = scores(tmp_path / "committed.csv", "crc", {1: 800, 2: 820, 3: 840})
    found = compare_with(committed, scores(tmp_path / "new.csv", "crc", {1: 812}))
    assert found["committed"] == {1: 800, 2: 820, 3: 840} and found["reproduced"] == {1: 812}
    # the prediction interval of one more draw: mean +- t(0.975, 2) s sqrt(1 + 1/3)
    assert np.allclose(found["interval"], (820 - 4.3027 * 20 * np.sqrt(4 / 3), 820 + 4.3027 * 20 * np.sqrt(4 / 3)), atol=0.01)

    run = CliRunner().invoke(app, ["reproduced", str(tmp_path / "new.csv"), str(committed)])
    assert run.exit_code == 0 and "expected if nothing has changed: 721 to 919" in run.stdout
    scores(tmp_path / "new.csv", "crc", {1: 500})
    run = CliRunner().invoke(app, ["reproduced", str(tmp_path / "new.csv"), str(committed)])
    assert run.exit_code == 1 and "outside of it" in run.stderr
    with pytest.raises(ValueError, match="has no final score of rad on cartpole-swingup"):
        compare_with(committed, scores(tmp_path / "rad.csv", "rad", {1: 500}))
