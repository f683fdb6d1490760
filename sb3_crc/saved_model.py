"""Is this file a model that CRCSAC has saved?"""

import io
import json
import pathlib
import zipfile

from stable_baselines3.common.save_util import open_path


def check_saved_model(path: str | pathlib.Path | io.BufferedIOBase) -> dict[str, object]:
    """
    :param path: what :meth:`CRCSAC.load` is given
    :return: the saved arguments and attributes, not deserialized
    :raises FileNotFoundError: if there is no such file, with or without ``.zip``
    :raises ValueError: if it is damaged, truncated, no zip, or the model of another algorithm
    """
    own_file = isinstance(path, str | pathlib.Path)
    try:
        file = open_path(path, "r", suffix="zip")
    except FileNotFoundError as error:
        raise FileNotFoundError(f"there is no saved model {path}") from error
    try:
        with zipfile.ZipFile(file) as archive:
            # A truncated file may end with a whole .pth, which is a zip as well: hence the look for "data"
            damaged = "data" if "data" not in archive.namelist() else archive.testzip()
            settings = {} if damaged else json.loads(archive.read("data"))
    except zipfile.BadZipFile as error:
        raise ValueError(f"{path} wasn't a zip-file, or is truncated or damaged: {error}") from error
    finally:
        if own_file:
            file.close()
        else:
            file.seek(0)
    if damaged:
        raise ValueError(f"{path} is not a complete model: {damaged!r} is missing or damaged (truncated copy?)")
    if "encoder_tau" not in settings:
        policy = settings.get("policy_class", {})
        raise ValueError(
            f"{path} was not saved by CRCSAC (its policy is of {policy.get('__module__', 'an unknown module')}); "
            "load it with the class that saved it, e.g. stable_baselines3.SAC"
        )
    return settings
