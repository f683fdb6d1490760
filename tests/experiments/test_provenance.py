"""A run that goes on says with what, beside what it began with."""

from argparse import Namespace
from pathlib import Path

import pytest
from rl_zoo3.exp_manager import ExperimentManager

from sb3_crc.experiments.runs import PROVENANCE, add_provenance, read_json, write_json
from sb3_crc.zoo import CRCExperimentManager
from sb3_crc.zoo.resume import Plan
from tests.conftest import make_model

ENV = "dmc_pixels/cartpole-swingup-v0"


def test_each_resume_adds_what_it_ran_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ExperimentManager, "learn", lambda self, model: None)
    manager = CRCExperimentManager(Namespace(), "crc", ENV, str(tmp_path), verbose=0)
    run = Path(manager.save_path)
    run.mkdir(parents=True)
    for revision in ("first", "second", "second"):
        monkeypatch.setattr("sb3_crc.zoo.manager.provenance", lambda found=revision: {"git_revision": found})
        manager.learn(make_model())
        manager.plan = Plan([], None, run)
    recorded = {"git_revision": "first", "resumed": [{"git_revision": "second"}, {"git_revision": "second"}]}
    assert read_json(run / PROVENANCE) == recorded


def test_a_file_of_one_entry_and_none_are_gone_on_with(tmp_path: Path) -> None:
    add_provenance({"git_revision": "later"}, tmp_path)
    assert read_json(tmp_path / PROVENANCE) == {"resumed": [{"git_revision": "later"}]}
    write_json({"git_revision": "old"}, tmp_path / PROVENANCE)
    add_provenance({"git_revision": "new"}, tmp_path)
    assert read_json(tmp_path / PROVENANCE) == {"git_revision": "old", "resumed": [{"git_revision": "new"}]}
