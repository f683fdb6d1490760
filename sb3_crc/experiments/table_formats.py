"""The paper's tables as text, Markdown, LaTeX and CSV: what ``sb3-crc table`` prints."""

import csv
import io
import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass

from sb3_crc.experiments.comparison_summary import markdown
from sb3_crc.experiments.published import STEPS
from sb3_crc.experiments.tables import OurScore, PaperTable, PublishedScore, same_steps
from sb3_crc.settings import check_name

MISSING = "Not in the table:"
#: Of CSV. kind: published, ours, missing or note
CSV_COLUMNS = (
    "kind",
    "method",
    "task",
    "environment_steps",
    "mean",
    "std",
    "seeds",
    "iqm",
    "lowest",
    "highest",
    "percent_over_our_curl",
    "percent_over_published_curl",
    "seed",
    "note",
    "source",
)


def render(table: PaperTable, format: str) -> str:
    """
    :param table: of :func:`paper_table`
    :param format: a key of :data:`FORMATS`: text, markdown, latex (needs the package booktabs) or csv (a row per score, note
        and missing run, told apart by ``kind``)
    :return: without a newline at its end
    :raises ValueError: if there is no such format
    """
    check_name("format", format, FORMATS)
    return FORMATS[format](table)


@dataclass(frozen=True)
class Grid:
    """Cells as text, the first column naming the row; ``names``: how many columns do so"""

    title: str
    header: list[str]
    rows: list[list[str]]
    names: int


def grids(table: PaperTable) -> list[Grid]:
    """:param table: of :func:`paper_table`; :return: the table itself and, with scores of ours, these in detail"""
    header = ["task", *table.published, *(f"ours: {method}" for method in table.ours)]
    rows = [
        [
            row,
            *(_published_cell(table.name, of.get(row)) for of in table.published.values()),
            *(_our_cell(table.name, of.get(row)) for of in table.ours.values()),
        ]
        for row in table.rows
    ]
    grids = [Grid(f"Return after {table.name} environment steps", header, rows, 1)]
    if table.ours:
        header = ["task", "ours", "seeds", "mean", "std", "IQM", "lowest", "highest", "over our curl", "over published CURL"]
        rows = [[row, method, *_detail_cells(of[row])] for row in table.rows for method, of in table.ours.items() if row in of]
        grids.append(Grid("Ours in detail", header, rows, 2))
    return grids


def _published_cell(table: str, score: PublishedScore | None) -> str:
    if score is None:
        return ""
    number = f"{score.mean:.0f}" if score.std is None else f"{score.mean:.0f} ± {score.std:.0f}"
    return number + _other_steps(table, () if score.environment_steps is None else (score.environment_steps,))


def _our_cell(table: str, score: OurScore | None) -> str:
    if score is None:
        return ""
    other = _other_steps(table, score.budgets)
    if score.seeds is None:
        return f"{score.mean:.0f} (seeds differ){other}"
    if score.std is None:
        return f"{score.mean:.0f} (1 seed){other}"
    return f"{score.mean:.0f} ± {score.std:.0f} ({score.seeds} seeds){other}"


def _other_steps(table: str, steps: Sequence[int]) -> str:
    """Says so in the cell itself if it is not after as many steps as the title says."""
    if all(same_steps(one, STEPS[table][0]) for one in steps):
        return ""
    return f" at {' and '.join(f'{one / 1000:g}k' for one in steps)}"


def _detail_cells(score: OurScore) -> list[str]:
    numbers = (score.mean, score.std, score.iqm, score.lowest, score.highest)
    percents = (score.percent_over_our_curl, score.percent_over_published_curl)
    return [
        "differ" if score.seeds is None else str(score.seeds),
        *("" if number is None else f"{number:.0f}" for number in numbers),
        *("" if percent is None else f"{percent:+.0f} %" for percent in percents),
    ]


def _text(table: PaperTable) -> str:
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(file=io.StringIO(), width=10_000, color_system=None)  # a row is one line, however long
    for grid in grids(table):
        shown = Table(box=box.SIMPLE, title=Text(grid.title), title_justify="left")
        for index, name in enumerate(grid.header):  # as Text: in a string, [K=2,M=2] would be markup
            shown.add_column(Text(name), justify="left" if index < grid.names else "right", no_wrap=True)
        for row in grid.rows:
            shown.add_row(*map(Text, row))
        console.print(shown)
    assert isinstance(console.file, io.StringIO)
    lines = [line.rstrip() for line in console.file.getvalue().splitlines()]
    for note in table.notes:
        lines += textwrap.wrap(note, 120, initial_indent="- ", subsequent_indent="  ", break_long_words=False)
    if table.missing:
        lines += ["", MISSING, *(f"- {missing}" for missing in table.missing)]
    return "\n".join(lines)


def _markdown(table: PaperTable) -> str:
    blocks = []
    for grid in grids(table):
        marks = [":--" if index < grid.names else "--:" for index in range(len(grid.header))]
        blocks += [f"**{grid.title}**", "\n".join(markdown(grid.header, grid.rows, marks))]
    blocks.append("\n".join(f"- {note}" for note in table.notes))
    if table.missing:
        blocks += [MISSING, "\n".join(f"- {missing}" for missing in table.missing)]
    return "\n\n".join(blocks)


def _latex(table: PaperTable) -> str:
    lines = [r"% needs \usepackage{booktabs}"]
    for grid in grids(table):
        lines += [
            rf"\paragraph{{{_escaped(grid.title)}}}",
            "",
            rf"\begin{{tabular}}{{{'l' * grid.names}{'r' * (len(grid.header) - grid.names)}}}",
            r"\toprule",
            _latex_row(grid.header),
            r"\midrule",
            *map(_latex_row, grid.rows),
            r"\bottomrule",
            r"\end{tabular}",
            "",
        ]
    lines += _latex_list(table.notes)
    if table.missing:
        lines += ["", MISSING, *_latex_list(str(missing) for missing in table.missing)]
    return "\n".join(lines)


def _latex_row(cells: Iterable[str]) -> str:
    return f"{' & '.join(map(_escaped, cells))} \\\\"


def _latex_list(sentences: Iterable[str]) -> list[str]:
    return [r"\begin{itemize}", *(rf"\item {_escaped(sentence)}" for sentence in sentences), r"\end{itemize}"]


_LATEX = {"\\": r"\textbackslash{}", "±": r"$\pm$", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_LATEX |= {sign: f"\\{sign}" for sign in "_&%#${}"}


def _escaped(text: str) -> str:
    return "".join(_LATEX.get(sign, sign) for sign in text)


def _csv(table: PaperTable) -> str:
    file = io.StringIO()
    writer = csv.DictWriter(file, CSV_COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for column, of_task in table.published.items():
        for task in table.rows:
            if task in of_task:
                writer.writerow(asdict(of_task[task]) | {"kind": "published", "method": column, "task": task})
    for method, of_our_task in table.ours.items():
        for task in table.rows:
            if task in of_our_task:
                score = asdict(of_our_task[task])
                steps = " and ".join(str(budget) for budget in score["budgets"])
                writer.writerow(score | {"kind": "ours", "method": method, "task": task, "environment_steps": steps})
    for missing in table.missing:
        row = {"method": missing.method, "task": missing.task, "seed": missing.seed, "note": missing.reason}
        writer.writerow({"kind": "missing"} | row)
    for note in table.notes:
        writer.writerow({"kind": "note", "note": note})
    return file.getvalue().rstrip("\n")


#: Name -> what renders a table in it
FORMATS: dict[str, Callable[[PaperTable], str]] = {"text": _text, "markdown": _markdown, "latex": _latex, "csv": _csv}
