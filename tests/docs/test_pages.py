"""What the pages say about the code is what the code says."""

import ast
import inspect
import re
from itertools import pairwise
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

from sb3_crc import CRCSAC, PRESETS
from sb3_crc.augmentations import AUGMENTATIONS
from sb3_crc.envs.dmc import make_dmc
from sb3_crc.stock import STOCK
from tests.conftest import make_model
from tests.docs.fences import PAGES, ROOT

WRITTEN = sorted([*PAGES, *ROOT.glob("results/*/README.md"), ROOT / "SECURITY.md", ROOT / "CHANGELOG.md"])


def page(name: str) -> str:
    return (ROOT / "docs" / name).read_text()


def rows(text: str) -> list[list[str]]:
    """Cells of all tables."""
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


def test_every_argument_is_explained_with_its_default() -> None:
    written = {row[0].strip("`"): row[1].strip("`") for row in rows(page("hyperparameters.md")) if len(row) == 3}
    skipped = {"self", "policy", "env", "kwargs", "_init_setup_model"}
    for name, parameter in inspect.signature(CRCSAC.__init__).parameters.items():
        if name in skipped:
            continue
        assert name in written, f"docs/hyperparameters.md does not explain {name}"
        default = eval(written[name]) if name == "objectives" else ast.literal_eval(written[name])  # has 1/3
        assert default == parameter.default, name


def test_every_logged_number_is_explained() -> None:
    names = [name for row in rows(page("metrics.md")) for name in re.findall(r"`(\w+/[^`]+)`", row[0])]
    patterns = [re.compile(re.escape(name).replace("<objective>", "[a-z]+").replace(r"\*", ".*")) for name in names]
    model = make_model(objectives=PRESETS["crc"]["objectives"])
    model.train(gradient_steps=100, batch_size=16)  # every hundredth update looks at the latent's health
    logged = {name for name in model.logger.name_to_value if name.startswith(("train/", "representation/"))}
    assert len(logged) > 25
    unexplained = {name for name in logged if not any(pattern.fullmatch(name) for pattern in patterns)}
    assert unexplained <= {"train/n_updates"}  # SB3's


def test_every_augmentation_and_preset_is_named() -> None:
    assert all(f"`{name}`" in page("hyperparameters.md") for name in AUGMENTATIONS)
    assert {*PRESETS, *STOCK} <= {row[0].strip("`") for row in rows(page("presets.md"))}


def test_every_argument_of_make_dmc_is_explained() -> None:
    text = page("environments.md")
    assert all(f"`{name}`" in text for name in inspect.signature(make_dmc).parameters if name != "task")


@pytest.mark.parametrize("file", WRITTEN, ids=lambda file: str(file.relative_to(ROOT)))
def test_links_lead_somewhere(file: Path) -> None:
    """Relative links, on GitHub as in a checkout; of pages also the heading."""
    for token in MarkdownIt("commonmark").enable("table").parse(file.read_text()):
        for child in token.children or []:
            target = child.attrs.get("href") or child.attrs.get("src") or ""
            if not isinstance(target, str) or not target or "://" in target or target.startswith("mailto:"):
                continue
            name, _, anchor = target.partition("#")
            linked = (file.parent / name).resolve() if name else file
            assert linked.exists(), f"{file.name}: {target}"
            assert linked.is_relative_to(ROOT), f"{file.name}: {target}"
            if anchor:
                assert anchor in anchors(linked), f"{file.name}: {target}"


def anchors(file: Path) -> set[str]:
    """Of a page's headings, as GitHub makes them."""
    tokens = MarkdownIt("commonmark").parse(file.read_text())
    headings = [after.content for token, after in pairwise(tokens) if token.type == "heading_open"]
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_every_page_is_in_the_site() -> None:
    """A page of docs/ that no table of contents names would be a warning, and so an error, of `make docs`."""
    text = page("index.md") + page("api/index.md").replace("\n", "\n" + "api/")
    for file in (ROOT / "docs").glob("*.md"):
        assert file.stem == "index" or re.search(rf"^{file.stem}$", text, re.M), file.name
