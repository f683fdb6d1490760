"""Edited configurations, sweeps and overrides: they are read, or one clear error says why not."""

import json
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import strategies as st

from sb3_crc.configurations import read_settings, with_overrides
from sb3_crc.experiments.specs import read_sweep
from tests.fuzz.documented import DOCUMENTED, says_why
from tests.fuzz.tiers import tiers
from tests.test_zoo import ROOT

LAPTOP = (ROOT / "zoo_configs" / "laptop.yml").read_text(encoding="utf-8")
SWEEP = (ROOT / "zoo_configs" / "sweeps" / "ablation_1.yml").read_text(encoding="utf-8")
EDITS = st.lists(
    st.tuples(
        st.floats(0, 1),
        st.sampled_from(
            ["", "\n", ": ", "- ", "{", "]", "'", "&a ", "*a", "!!python/name:os.system ", "null", "  ", "\t", "\x00"]
        )
        | st.text(max_size=3),
        st.integers(0, 30),
    ),
    min_size=1,
    max_size=4,
)


def edited(text: str, edits: list[tuple[float, str, int]]) -> str:
    for where, new, length in edits:
        place = round(where * len(text))
        text = text[:place] + new + text[place + length :]
    return text


def check_configurations(edits: list[tuple[float, str, int]], algorithm: str) -> None:
    """A configuration is read, or the error names the file."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "edited.yml"
        file.write_text(edited(LAPTOP, edits), encoding="utf-8", errors="surrogatepass")
        try:
            settings = read_settings(file, algorithm, "dmc_pixels/cartpole-swingup-v0")
        except ValueError as error:
            says_why(error, "" if isinstance(error, UnicodeDecodeError) else "edited.yml")
            return
        assert isinstance(settings, dict)


test_configurations, test_configurations_long = tiers(
    2_000, edits=EDITS, algorithm=st.sampled_from(["crc", "rad", "sac", "sac_matched", "state_sac"])
)(check_configurations)


def check_sweeps(edits: list[tuple[float, str, int]]) -> None:
    """A sweep is read, or refused."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "edited.yml"
        shutil.copy(ROOT / "zoo_configs" / "laptop.yml", folder)
        file.write_text(edited(SWEEP, edits), encoding="utf-8", errors="surrogatepass")
        with suppress(*DOCUMENTED):
            assert read_sweep(file)


test_sweeps, test_sweeps_long = tiers(2_000, edits=EDITS)(check_sweeps)


def check_overrides(settings: dict[str, Any], path: str, value: Any) -> None:
    """A path leads somewhere, or is refused; what it was applied to stays as it was."""
    before = json.dumps(settings)
    with suppress(ValueError):
        with_overrides(settings, {path: value})
    assert json.dumps(settings) == before


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=3),
    lambda inner: st.dictionaries(st.text("ab.", max_size=3), inner, max_size=3) | st.lists(inner, max_size=2),
    max_leaves=6,
)
test_overrides, test_overrides_long = tiers(
    2_000, settings=st.dictionaries(st.sampled_from("ab"), PLAIN, max_size=2), path=st.text("ab.", max_size=6), value=PLAIN
)(check_overrides)


# -- What was found ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("variants:", "variants: [1]\nconf_file:", "variants must be a mapping from names to changes; it is \\[1\\]"),
        ("seeds: 3", "seeds: [1, x]", "seeds must be a number of trainings, or a list of whole numbers; 'x' is among them"),
        ("seeds: 3", "seeds: true", "seeds must be a number of trainings"),
        ("env_steps:", "env_steps: many #", "env_steps must be a whole number; it is 'many'"),
    ],
)
def test_a_sweep_of_other_types_is_refused(old: str, new: str, message: str, tmp_path: Path) -> None:
    """Lists in place of mappings ended in an AttributeError."""
    text = "env_steps: 100_000\ntasks: [cartpole-swingup]\nseeds: 3\nvariants:\n  C: {preset: crc}\n"
    (tmp_path / "sweep.yml").write_text(text, encoding="utf-8")
    assert len(read_sweep(tmp_path / "sweep.yml")) == 3
    changed = text.replace(old, new) if old != "variants:" else text[: text.index(old)] + "variants: [1]\n"
    (tmp_path / "sweep.yml").write_text(changed, encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        read_sweep(tmp_path / "sweep.yml")


def test_a_path_that_is_no_text_is_refused() -> None:
    """A sweep with ``null:`` among a variant's changes ended in an AttributeError."""
    with pytest.raises(ValueError, match="None is no path"):
        with_overrides({"a": 1}, {None: 2})  # type: ignore[dict-item]


def test_the_unedited_files_are_read() -> None:
    """Else the checks above would show nothing."""
    assert read_settings(ROOT / "zoo_configs" / "laptop.yml", "crc", "dmc_pixels/cartpole-swingup-v0")
    assert read_sweep(ROOT / "zoo_configs" / "sweeps" / "ablation_1.yml")
    assert edited(LAPTOP, [(0.0, "", 0)]) == LAPTOP and edited(SWEEP, [(0.0, "#", 0)]) == f"#{SWEEP}"
