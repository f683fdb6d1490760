"""What an earlier release has written can be read, and does what it did: models, replay buffers, checkpoints, policies.

tests/fixtures/<version>/ holds the files of that release, written by tests/fixtures/make.py; this version's own are written
anew beside them.
"""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from sb3_crc import CRCSAC, TrainingCheckpoint, load_policy, load_weights
from tests.fixtures import make

ROOT = Path(__file__).parents[1]
RELEASES = sorted(path.name for path in make.FOLDER.iterdir() if re.fullmatch(r"\d+\.\d+\.\d+\w*", path.name))
#: Other processors add in another order
CLOSE = {"rtol": 1e-5, "atol": 1e-5}


@pytest.fixture(scope="module", params=[*RELEASES, "written now"])
def files(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of a release's folder: readers may leave locks and the like."""
    folder = tmp_path_factory.mktemp("files") / "release"
    if request.param == "written now":
        make.write(folder)
    else:
        shutil.copytree(make.FOLDER / request.param, folder)
    return folder


@pytest.fixture
def expected(files: Path) -> dict[str, np.ndarray]:
    with np.load(files / "expected.npz") as arrays:
        return dict(arrays)


def test_each_file_is_among_those_that_are_read_here(files: Path) -> None:
    names = {path.name for path in files.iterdir()}
    assert names == {*make.MODELS, "buffer.pkl", "training", "policy.sb3crc", "expected.npz"}
    assert sum(path.stat().st_size for path in files.rglob("*") if path.is_file()) < 500_000


@pytest.mark.parametrize("name", make.MODELS)
def test_models_act_and_judge_as_they_did_and_go_on_learning(name: str, files: Path, expected: dict[str, np.ndarray]) -> None:
    model = CRCSAC.load(files / name, env=make.Stripes(), device="cpu")
    np.testing.assert_allclose(make.behaviour(model), expected[name], **CLOSE)
    assert (model.num_timesteps, model._n_updates) == (make.END, make.END - make.SMALL["learning_starts"])
    model.learn(make.SMALL["learning_starts"] + 2)
    assert model._n_updates == make.END - make.SMALL["learning_starts"] + 2
    assert not np.allclose(make.behaviour(model), expected[name])


def test_replay_buffers_give_what_they_gave(files: Path, expected: dict[str, np.ndarray]) -> None:
    model = make.new_model()
    model.load_replay_buffer(files / "buffer.pkl")
    assert model.replay_buffer.size() == make.END
    for name, array in make.batch(model).items():
        np.testing.assert_array_equal(array, expected[name])


def test_policies_act_as_they_did(files: Path, expected: dict[str, np.ndarray]) -> None:
    policy = load_policy(files / "policy.sb3crc", device="cpu")
    actions, _ = policy.predict(make.observations(), deterministic=True)
    np.testing.assert_allclose(actions, expected["policy.sb3crc"], **CLOSE)
    model = make.new_model()
    load_weights(model, files / "policy.sb3crc")
    np.testing.assert_allclose(make.behaviour(model), expected["crc.zip"], **CLOSE)


def test_trainings_go_on_to_the_end_that_they_would_have_had(files: Path, expected: dict[str, np.ndarray]) -> None:
    start = make.Start()
    model = make.new_model()
    model.learn(make.END, callback=[TrainingCheckpoint(files / "training", keep=1), start])
    assert start.steps == make.STOPPED
    here = str(expected["machine"]) == make.machine()
    # Eight updates by Adam make more of other roundings than one pass does
    np.testing.assert_allclose(make.behaviour(model), expected["end of training"], **(CLOSE if here else {"atol": 1e-2}))


def missing(changelog: str, folders: list[str]) -> list[str]:
    """Versions with a date in the changelog of which no files are kept."""
    return [
        version for version in re.findall(r"^## (\S+) \(\d{4}-\d\d-\d\d\)", changelog, re.MULTILINE) if version not in folders
    ]


def test_files_of_every_released_version_are_kept() -> None:
    assert missing((ROOT / "CHANGELOG.md").read_text(), RELEASES) == []
    assert RELEASES  # those of the first release are there before it is
    assert missing("## 0.2.0 (unreleased)\n\n## 0.1.9 (2026-01-02)\n\n## 0.1.0 (2026-01-01)\n", ["0.1.0"]) == ["0.1.9"]
