"""Files of saved models: are they whole, and what in them is executed when they are read?"""

import io
import json
import pathlib
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import IO, Any

from stable_baselines3.common.save_util import open_path

from sb3_crc.plain import NotPlain, plain_attributes, read_plain_attributes

#: In the zip, beside SB3's own "data"
PLAIN = "plain.json"
#: Key of what SB3 has pickled among the settings
PICKLE = ":serialized:"
#: Bytes of the plain attributes when they are unpacked, at most
LARGEST = 1 << 29


def check_saved_model(path: str | pathlib.Path | io.BufferedIOBase) -> dict[str, object]:
    """
    :param path: what :meth:`CRCSAC.load` is given
    :return: the saved arguments and attributes, not deserialized
    :raises FileNotFoundError: if there is no such file, with or without ``.zip``
    :raises ValueError: if it is damaged, truncated, no zip, or the model of another algorithm
    """
    try:
        with _opened(path) as file:
            settings = _read_settings(file, path)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"there is no saved model {path}") from error
    if not isinstance(settings, dict) or "encoder_tau" not in settings:
        policy = settings.get("policy_class") if isinstance(settings, dict) else None
        module = policy.get("__module__") if isinstance(policy, dict) else None
        raise ValueError(
            f"{path} was not saved by CRCSAC (its policy is of {module or 'an unknown module'}); "
            "load it with the class that saved it, e.g. stable_baselines3.SAC"
        )
    return settings


def add_plain_attributes(file: pathlib.Path | io.BufferedIOBase, attributes: Mapping[str, Any]) -> None:
    """
    Give what SB3 has pickled into a saved model a plain form, where there is one.

    :param file: a zip that SB3 has just written
    :param attributes: of the model
    """
    with zipfile.ZipFile(file, "a") as archive:
        pickled = pickled_names(json.loads(archive.read("data")))
        archive.writestr(PLAIN, plain_attributes({name: attributes[name] for name in pickled if name in attributes}))


def read_saved_attributes(path: str | pathlib.Path | io.BufferedIOBase) -> dict[str, Any]:
    """
    :param path: of a whole saved model
    :return: attributes that have a plain form in it; nothing is executed
    :raises ValueError: if they cannot be read
    """
    with _opened(path) as file, zipfile.ZipFile(file) as archive:
        if PLAIN not in archive.namelist():
            return {}
        if archive.getinfo(PLAIN).file_size > LARGEST:
            raise ValueError(f"{path}: {PLAIN} would be {archive.getinfo(PLAIN).file_size} bytes")
        try:
            return read_plain_attributes(archive.read(PLAIN))
        except NotPlain as error:
            raise ValueError(f"{path}: {PLAIN} cannot be read: {error}") from error


def check_pickles(path: object, saved: Mapping[str, object], given: Mapping[str, Any], *, safe: bool) -> None:
    """
    :param path: of the model, to be named
    :param saved: what :func:`check_saved_model` has found
    :param given: attributes that need not be unpickled
    :param safe: whether pickles are refused
    :raises ValueError: if there are others, and they are
    """
    executed = [name for name in pickled_names(saved) if name not in given]
    if not executed:
        return
    names = ", ".join(executed)
    if safe:
        raise ValueError(
            f"{path}: reading {names} would execute what is in the file; load it with safe=False if you trust it, or give "
            "them as custom_objects"
        )
    warnings.warn(f"{path}: reading {names} executes what is in the file: load only files that you trust", stacklevel=4)


def pickled_names(saved: Mapping[str, object]) -> list[str]:
    """:param saved: what SB3 has written about a model; :return: attributes that it would unpickle"""
    return [name for name, value in saved.items() if isinstance(value, dict) and PICKLE in value]


def _read_settings(file: IO[bytes], path: object) -> Any:
    try:
        with zipfile.ZipFile(file) as archive:
            # A truncated file may end with a whole .pth, which is a zip as well: hence the look for "data"
            damaged = "data" if "data" not in archive.namelist() else archive.testzip()
            settings = {} if damaged else json.loads(archive.read("data"))
    except Exception as error:  # damaged bytes make zipfile, zlib and json raise nearly anything
        raise ValueError(f"{path} wasn't a zip-file, or is truncated or damaged: {error}") from error
    if damaged:
        raise ValueError(f"{path} is not a complete model: {damaged!r} is missing or damaged (truncated copy?)")
    return settings


@contextmanager
def _opened(path: str | pathlib.Path | io.BufferedIOBase) -> Iterator[IO[bytes]]:
    own_file = isinstance(path, str | pathlib.Path)
    file: Any = open_path(path, "r", suffix="zip")
    try:
        yield file
    finally:
        if own_file:
            file.close()
        else:
            file.seek(0)
