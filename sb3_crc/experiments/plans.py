"""What a comparison would do and need: what ``--dry-run`` lists."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sb3_crc.experiments.needs import Needs, seconds_for_all
from sb3_crc.experiments.specs import RunSpec
from sb3_crc.experiments.watching import duration
from sb3_crc.memory import GIGABYTE


@dataclass(frozen=True)
class Plan:
    """
    :param specs: of the comparison
    :param root: folder of its runs
    :param waiting: those of them that are to be done
    :param jobs: runs at once
    :param threads: of each run; None: the runs are another machine's
    :param needs: of runs that are to be done, by name
    :param reasons: why others cannot even begin, by name
    """

    specs: Sequence[RunSpec]
    root: Path
    waiting: Sequence[RunSpec]
    jobs: int
    threads: int | None
    needs: Mapping[str, Needs]
    reasons: Mapping[str, str]

    def lines(self) -> Iterator[str]:
        """:return: for people: what state each run is in and what it needs, and all that is to be done"""
        for spec in self.specs:
            line = f"{self.root / spec.name}: {spec.agent_steps} agent steps, "
            if spec not in self.waiting:
                yield line + "finished"
            elif spec.name in self.reasons:
                yield line + f"to run, but it cannot begin: {self.reasons[spec.name]}"
            else:
                one = self.needs[spec.name]
                gpu = f", {one.gpu_memory / GIGABYTE:.1f} GB on the GPU" if one.gpu_memory else ""
                amounts = f"{_gigabytes(one.memory)} memory{gpu}, {_gigabytes(one.disk)} disk"
                yield line + f"to run: {duration(one.seconds)}, {amounts}"
        if self.needs:
            where = f"if {self.jobs} run at once"
            if self.threads is not None:
                where = f"{self.jobs} at once, threads each: {self.threads}"
            total = self._in_total()
            yield (
                f"{len(self.waiting)} of {len(self.specs)} runs to do, {where}: {duration(total.seconds)} or more, "
                f"{_gigabytes(total.memory)} memory, {_gigabytes(total.disk)} disk"
            )

    def document(self) -> dict[str, Any]:
        """:return: the same for programs, in bytes and seconds"""
        runs = [
            {
                "folder": self.root / spec.name,
                "method": spec.method,
                "task": spec.task,
                "seed": spec.seed,
                "agent_steps": spec.agent_steps,
                "environment_steps": spec.env_steps,
                "finished": spec not in self.waiting,
                "needs": self.needs.get(spec.name),
                "cannot_begin": self.reasons.get(spec.name),
            }
            for spec in self.specs
        ]
        total = asdict(self._in_total()) if self.needs else None
        return {"runs": runs, "to_do": len(self.waiting), "at_once": self.jobs, "threads": self.threads, "in_total": total}

    def _in_total(self) -> Needs:
        """Memory is that of the largest runs that may come together."""
        known = list(self.needs.values())
        at_once = sorted(known, key=lambda one: one.memory, reverse=True)[: self.jobs]
        return Needs(
            memory=sum(one.memory for one in at_once),
            gpu_memory=sum(one.gpu_memory for one in at_once),
            disk=sum(one.disk for one in known),
            seconds=seconds_for_all(known, self.jobs),
        )


def _gigabytes(number: int) -> str:
    return f"{number / GIGABYTE:.1f} GB"
