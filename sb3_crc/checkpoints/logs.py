"""Files that SB3 opens anew when a script starts: what a stopped run had written is written again, and then continued."""

import time
from collections.abc import Iterator
from csv import DictReader, DictWriter
from csv import writer as csv_writer
from io import StringIO
from pathlib import Path
from typing import Any, TextIO

import gymnasium as gym
from stable_baselines3.common.logger import (
    CSVOutputFormat,
    HumanOutputFormat,
    JSONOutputFormat,
    Logger,
    TensorBoardOutputFormat,
)
from stable_baselines3.common.monitor import Monitor, ResultsWriter
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecMonitor

from sb3_crc.checkpoints.tree import Tree, copied, is_plain
from sb3_crc.disk import EnduringEvents, EnduringFile


def log_state(logger: Logger, env: VecEnv) -> Tree:
    """
    :param logger: of the model; TensorBoard's files are not held: a new one is begun, whose steps overlap
    :param env: of the training; Monitor's files are held where the environments live in this process: for others see
        :func:`distant_monitors`
    :return: what was recorded since the log was last written (figures and the like left out), and the files' contents
    """
    values = {name: value for name, value in logger.name_to_value.items() if is_plain(value)}
    excluded = {name: value for name, value in logger.name_to_excluded.items() if name in values}
    formats = list(_formats(logger))
    return {
        "recorded": copied({"values": values, "counts": dict(logger.name_to_count), "excluded": excluded}),
        "progress": [_read(format_.file) for format_ in formats],
        "keys": [list(format_.keys) if isinstance(format_, CSVOutputFormat) else None for format_ in formats],
        "monitors": [_read(monitor.results_writer.file_handler) for monitor in _monitors(env)],
        "seconds": [time.time() - monitor.t_start for monitor in _monitors(env)],
    }


def set_log_state(logger: Logger, env: VecEnv, state: Tree) -> None:
    """
    :param logger: with the formats of the one that was saved; the files of others stay as they are
    :param env: likewise
    :param state: of :func:`log_state`
    """
    recorded = copied(state["recorded"])
    logger.name_to_value.update(recorded["values"])
    logger.name_to_count.update(recorded["counts"])
    logger.name_to_excluded.update(recorded["excluded"])
    for format_, text, keys in zip(_formats(logger), state["progress"], state["keys"], strict=False):
        _write(format_.file, text)
        if isinstance(format_, CSVOutputFormat):
            format_.keys = list(keys)
    for monitor, text, seconds in zip(_monitors(env), state["monitors"], state["seconds"], strict=False):
        _write(monitor.results_writer.file_handler, text)
        monitor.t_start = time.time() - seconds


def endure(logger: Logger, env: VecEnv, folder: Path | None) -> None:
    """
    Let the log's files and Monitor's outlive a disk that fails.

    :param logger: of the model
    :param env: of the training
    :param folder: of Monitor's files where the environments live in other processes, see :func:`distant_monitors`
    """
    for place, format_ in enumerate(logger.output_formats):
        if isinstance(format_, TensorBoardOutputFormat) and not isinstance(format_, EnduringEvents):
            logger.output_formats[place] = EnduringEvents(format_)
        elif isinstance(format_, HumanOutputFormat) and not format_.own_file:
            continue  # a stream, as sys.stdout was when the logger was made
        elif isinstance(format_, CSVOutputFormat | JSONOutputFormat | HumanOutputFormat):
            format_.file = _enduring(format_.file)  # type: ignore[assignment]
    for monitor in _monitors(env):
        results = monitor.results_writer
        results.file_handler = _enduring(results.file_handler)
        results.logger.writer = csv_writer(results.file_handler)
    set_distant_monitors(env, folder, distant_monitors(env, folder))


def _enduring(file: Any) -> EnduringFile:
    return file if isinstance(file, EnduringFile) else EnduringFile(file)


def distant_monitors(env: VecEnv, folder: Path | None) -> Tree:
    """
    :param env: of the training
    :param folder: ``monitor_dir`` of :func:`~stable_baselines3.common.env_util.make_vec_env`
    :return: the files' contents where the environments live in other processes; None: otherwise, or without ``folder``
    """
    if folder is None or isinstance(env.unwrapped, DummyVecEnv):
        return None
    paths = [folder / f"{rank}.{Monitor.EXT}" for rank in range(env.num_envs)]
    if not all(path.exists() for path in paths):
        return None
    starts = env.get_attr("t_start")
    return {
        "texts": [path.read_text(encoding="utf-8") for path in paths],
        "seconds": [time.time() - start for start in starts],
    }


def set_distant_monitors(env: VecEnv, folder: Path | None, state: Tree) -> None:
    """
    :param env: of the training
    :param folder: where the files go on
    :param state: of :func:`distant_monitors`
    """
    if folder is None or state is None:
        return
    for rank, (text, seconds) in enumerate(zip(state["texts"], state["seconds"], strict=True)):
        writer = ContinuedResults(folder / f"{rank}.{Monitor.EXT}", text)
        env.env_method("set_wrapper_attr", "results_writer", writer, indices=rank)
        env.env_method("set_wrapper_attr", "t_start", time.time() - seconds, indices=rank)


class ContinuedResults(ResultsWriter):
    """
    Goes on with a file of Monitor's, also when its disk fails; it is opened in the process to which this is sent.

    :param path: of the file
    :param text: what it has held so far
    """

    def __init__(self, path: Path, text: str):
        self.path, self.text = path, text

    def __reduce__(self) -> tuple[Any, ...]:
        return _opened, (self.path, self.text)


def _opened(path: Path, text: str) -> ContinuedResults:
    writer = ContinuedResults(path, text)
    file: Any = _enduring(path.open("a", encoding="utf-8"))
    writer.file_handler = file
    writer.logger = DictWriter(file, DictReader(StringIO(text.partition("\n")[2])).fieldnames or [])
    _write(file, text)
    return writer


def _formats(logger: Logger) -> Iterator[CSVOutputFormat | JSONOutputFormat]:
    yield from (one for one in logger.output_formats if isinstance(one, CSVOutputFormat | JSONOutputFormat))


def _monitors(env: VecEnv) -> Iterator[Any]:
    """Those that write files."""
    while isinstance(env, VecEnvWrapper):
        if isinstance(env, VecMonitor) and env.results_writer is not None:
            yield env
        env = env.venv
    for one in env.envs if isinstance(env, DummyVecEnv) else []:
        wrapper: gym.Env[Any, Any] = one
        while isinstance(wrapper, gym.Wrapper):
            if isinstance(wrapper, Monitor) and wrapper.results_writer is not None:
                yield wrapper
            wrapper = wrapper.env


def _read(file: TextIO | EnduringFile) -> str:
    if isinstance(file, EnduringFile):
        return file.contents()
    file.flush()
    return Path(file.name).read_text(encoding="utf-8")


def _write(file: TextIO | EnduringFile, text: str) -> None:
    file.seek(0)
    file.truncate()
    file.write(text)
    file.flush()
