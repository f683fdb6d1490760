"""Runs are compared with scores from before."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from sb3_crc.cli import app
from sb3_crc.experiments.reproduction import compare_with
from sb3_crc.experiments.scores import MixedProtocols
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


@pytest.mark.parametrize(
    ("column", "value"), [("budget", 50_000), ("render_quality", "fast"), ("first_seed", 40_000), ("action_repeat", 4)]
)
def test_runs_of_another_protocol_are_no_reproduction(tmp_path: Path, column: str, value: object) -> None:
    committed, new = scores(tmp_path / "committed.csv", "crc", {1: 800, 2: 820}), scores(tmp_path / "new.csv", "crc", {1: 812})
    pd.read_csv(new).assign(**{column: value}).to_csv(new, index=False)
    with pytest.raises(MixedProtocols, match=rf"{column} differs: .*\(committed\).*\(reproduced\)|reproduced.*committed"):
        compare_with(committed, new)
    done = CliRunner().invoke(app, ["reproduced", str(new), str(committed)])
    assert done.exit_code == 2 and f"{column} differs" in done.stderr and "--allow-mixed" not in done.stderr


def test_other_tasks_and_methods_of_another_protocol_do_not_matter(tmp_path: Path) -> None:
    scores(tmp_path / "rad.csv", "rad", {1: 800})
    committed = pd.concat(
        [pd.read_csv(scores(tmp_path / "crc.csv", "crc", {1: 800})), pd.read_csv(tmp_path / "rad.csv").assign(budget=50_000)]
    )
    committed.to_csv(tmp_path / "committed.csv", index=False)
    found = compare_with(tmp_path / "committed.csv", scores(tmp_path / "new.csv", "crc", {1: 812}))
    assert found["committed"] == {1: 800}
