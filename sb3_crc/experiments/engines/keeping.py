"""Files of runs, brought from where they are written to where they are kept, for clusters that share no folder."""

import getpass
import shutil
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sb3_crc.atomic import atomic_write
from sb3_crc.checkpoints.store import MANIFEST
from sb3_crc.experiments.engines.execution import LOCK

#: Seconds between two looks at what a run has written
EVERY = 5.0


class Keeper:
    """
    A Ray actor on the machine of the command, which has the files of all runs.

    :param root: folder of the comparison
    """

    def __init__(self, root: str):
        self.root = Path(root)

    def names(self, run: str) -> list[str]:
        """:param run: name of a run; :return: paths of its files, relative to its folder"""
        folder = self.root / run
        return [str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file() and path.name != LOCK]

    def read(self, run: str, name: str) -> bytes:
        """:param run: name of a run; :param name: of a file"""
        return (self.root / run / name).read_bytes()

    def write(self, run: str, name: str, content: bytes) -> None:
        """:param run: name of a run; :param name: of a file, which appears whole; :param content: of it"""
        target = self.root / run / name
        if self.root.resolve() not in target.resolve().parents:
            raise ValueError(f"{name} is no file in {self.root / run}")
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(target) as unfinished:
            unfinished.write_bytes(content)

    def remove(self, run: str, names: list[str]) -> None:
        """:param run: name of a run; :param names: of files, whose folders go with them when nothing else is there"""
        for name in names:
            target = self.root / run / name
            target.unlink(missing_ok=True)
            if not any(target.parent.iterdir()):
                target.parent.rmdir()


@contextmanager
def working_copy(run: str, keeper: Any, *, every: float = EVERY) -> Iterator[Path]:
    """
    A temporary folder with what is kept of a run; what is written there is kept, now and then and at the end.

    :param run: name of a run
    :param keeper: handle of the :class:`Keeper`
    :param every: seconds between two looks
    :return: a folder of comparisons with this run
    """
    import ray

    with tempfile.TemporaryDirectory(prefix=f"sb3_crc-{getpass.getuser()}-", ignore_cleanup_errors=True) as root:
        folder = Path(root) / run
        for name in ray.get(keeper.names.remote(run)):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(ray.get(keeper.read.remote(run, name)))
        kept = _stamps(folder)
        ended = threading.Event()

        def keep() -> None:
            while not ended.wait(every):
                _bring(run, folder, keeper, kept)

        thread = threading.Thread(target=keep, daemon=True)
        thread.start()
        try:
            yield Path(root)
        finally:
            ended.set()
            thread.join()
            _bring(run, folder, keeper, kept)
            shutil.rmtree(folder, ignore_errors=True)


def _bring(run: str, folder: Path, keeper: Any, kept: dict[str, tuple[int, int]]) -> None:
    """
    Bring what is new. The manifest of a checkpoint comes last and what is gone goes after that, so that the newest checkpoint
    which has a manifest is whole, whenever this ends.
    """
    import ray

    stamps = _stamps(folder)
    new = [name for name, stamp in stamps.items() if kept.get(name) != stamp]
    for name in sorted(new, key=lambda name: (Path(name).name == MANIFEST, name)):
        try:
            content = (folder / name).read_bytes()
        except FileNotFoundError:  # a later checkpoint has taken its place
            continue
        ray.get(keeper.write.remote(run, name, content))
        kept[name] = stamps[name]
    gone = [name for name in kept if name not in stamps]
    if gone:
        ray.get(keeper.remove.remote(run, sorted(gone, key=lambda name: Path(name).name != MANIFEST)))
        for name in gone:
            del kept[name]


def _stamps(folder: Path) -> dict[str, tuple[int, int]]:
    """:return: files of a run and when they were written last, but for those that are being written"""
    found = {}
    for path in folder.rglob("*"):
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if not hidden and path.name != LOCK and path.is_file():
            try:
                status = path.stat()
            except FileNotFoundError:
                continue
            found[str(path.relative_to(folder))] = status.st_mtime_ns, status.st_size
    return found
