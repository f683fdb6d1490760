"""Files of films."""

import sys
from pathlib import Path

import av
import numpy as np
import pytest

from sb3_crc.analysis.films import film_file


def test_an_odd_row_and_column_are_cut_off(tmp_path: Path) -> None:
    with film_file(tmp_path / "film.mp4", 12.5) as add:
        for shade in (0, 100, 200):
            add(np.full((35, 37, 3), shade, np.uint8))
    with av.open(str(tmp_path / "film.mp4")) as container:
        stream = container.streams.video[0]
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert (stream.codec_context.name, float(stream.average_rate)) == ("h264", 12.5)
    assert [picture.shape for picture in pictures] == 3 * [(34, 36, 3)]
    assert [round(float(picture.mean()), -1) for picture in pictures] == [0, 100, 200]


def test_what_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="format"), film_file(tmp_path / "film.nothing", 30):
        pass
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ImportError, match=r"sb3-crc\[video\]"), film_file(tmp_path / "film.mp4", 30):
        pass
