"""Files that cannot be loaded: of another algorithm, for other images, cut off, damaged, or no model at all."""

from pathlib import Path

import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.torch_layers import NatureCNN

from sb3_crc import CRCSAC, PixelEncoder
from tests.conftest import NoiseEnv, make_model


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("saved") / "model.zip"
    make_model().save(path)
    return path


@pytest.mark.parametrize("extractor", [NatureCNN, PixelEncoder])
def test_a_zip_of_stock_sac_is_refused(extractor: type, tmp_path: Path) -> None:
    policy_kwargs = {"net_arch": [8], "features_extractor_class": extractor}
    SAC("CnnPolicy", NoiseEnv(), buffer_size=10, policy_kwargs=policy_kwargs).save(tmp_path / "sac.zip")
    with pytest.raises(ValueError, match=r"sac\.zip.*CRCSAC"):
        CRCSAC.load(tmp_path / "sac.zip")


def test_a_zip_of_another_image_size_is_refused(saved: Path) -> None:
    with pytest.raises(ValueError, match=r"\(9, 40, 40\).*\(9, 48, 48\)"):
        CRCSAC.load(saved, env=NoiseEnv(size=48))
    with pytest.raises(ValueError, match=r"\(9, 40, 40\).*\(9, 48, 48\)"):
        CRCSAC.load(saved).set_env(NoiseEnv(size=48))
    with pytest.raises(ValueError, match=r"\(9, 48, 48\).*\(9, 40, 40\)"):
        CRCSAC.load(saved).predict(np.zeros((9, 48, 48), np.uint8))


@pytest.mark.parametrize("share", [0.0, 0.001, 0.2, 0.5, 0.95, 0.9999])
def test_a_truncated_zip_is_refused(share: float, saved: Path, tmp_path: Path) -> None:
    whole = saved.read_bytes()
    (tmp_path / "truncated.zip").write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match=r"truncated\.zip.*(wasn't a zip-file|not a complete)"):
        CRCSAC.load(tmp_path / "truncated.zip")


def test_a_damaged_zip_is_refused(saved: Path, tmp_path: Path) -> None:
    damaged = bytearray(saved.read_bytes())
    damaged[len(damaged) // 2] ^= 0xFF
    (tmp_path / "damaged.zip").write_bytes(damaged)
    with pytest.raises(ValueError, match=r"damaged\.zip"):
        CRCSAC.load(tmp_path / "damaged.zip")


def test_what_is_no_model_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.zip").write_text("no zip at all")
    with pytest.raises(ValueError, match=r"text\.zip.*wasn't a zip-file"):
        CRCSAC.load(tmp_path / "text.zip")
    with pytest.raises(FileNotFoundError, match=r"absent\.zip'?$"):
        CRCSAC.load(tmp_path / "absent.zip")
    with pytest.raises(FileNotFoundError, match=r"absent"):
        CRCSAC.load(tmp_path / "absent")
