"""The fenced code blocks of the project's pages."""

import re
from dataclasses import dataclass
from pathlib import Path

from markdown_it import MarkdownIt

ROOT = Path(__file__).parents[2]
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/*.md"), *ROOT.glob("docs/api/*.md")])


@dataclass(frozen=True)
class Block:
    """
    :param page: relative to the repository
    :param line: of the opening fence, from 1
    :param language: what stands behind the fence; "" for code without one
    :param text: the code
    """

    page: str
    line: int
    language: str
    text: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"


def blocks_of(markdown: str, page: str) -> list[Block]:
    """Blocks in a page, indented ones included, which have no language."""
    return [
        Block(page, token.map[0] + 1, token.info.strip() if token.type == "fence" else "", token.content)
        for token in MarkdownIt("commonmark").parse(markdown)
        if token.type in ("fence", "code_block") and token.map is not None
    ]


def all_blocks(language: str | None = None) -> list[Block]:
    """Blocks of all pages, or those of one language."""
    found = [block for page in PAGES for block in blocks_of(page.read_text(), str(page.relative_to(ROOT)))]
    return [block for block in found if language in (None, block.language)]


def command_lines(block: Block) -> list[str]:
    """The command lines of a console block, each on one line, without prompt and comments."""
    joined = re.sub(r"\\\n\s*", "", block.text)
    lines = [re.sub(r"(^|\s+)# .*", "", line).strip().removeprefix("$ ") for line in joined.splitlines()]
    return [line for line in lines if line]
