"""The script that asks which objective moves the encoder."""

import json
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest

from sb3_crc import CRCSAC
from tests.conftest import make_model

SCRIPT = Path(__file__).parents[2] / "results" / "laptop" / "heard.py"


@pytest.fixture(scope="module")
def heard() -> ModuleType:
    spec = spec_from_file_location("heard", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def model() -> CRCSAC:
    return make_model(objectives={"contrastive": 1.0, "reconstruction": 1e-6})


def test_what_is_not_heard_moves_nothing(heard: ModuleType) -> None:
    as_it_was, again = (heard.ways(model(), (1, 5)) for _ in range(2))
    assert as_it_was.shape[0] == 2 and as_it_was.norm() > 0 and as_it_was.equal(again)
    length = as_it_was.norm(dim=1)
    changes = {"without": "reconstruction"}, {"without": "contrastive"}, {"seed": 1}, {"nudge": 1e-7}
    quiet, loud, crops, digits = (
        (heard.ways(model(), (1, 5), **change) - as_it_was).norm(dim=1) / length for change in changes
    )
    assert quiet.max() < 0.1 and digits.max() < 0.1
    assert loud.min() > 0.3 and crops.min() > 0.3


def test_the_page_has_what_was_measured() -> None:
    page = (SCRIPT.parent / "README.md").read_text()
    measured = json.loads(SCRIPT.with_suffix(".json").read_text())
    assert len(measured) == 5
    for shares in measured.values():
        assert " | ".join(f"{share:.4f}" for share in shares.values()) in page
    balanced = json.loads(SCRIPT.with_name("heard_balanced.json").read_text())
    for name in ("without contrastive", "without reconstruction", "without consistency", "weights differ by 1e-7"):
        assert f" {balanced[name]['200']:.4f} " in page.replace("\n", " ")
