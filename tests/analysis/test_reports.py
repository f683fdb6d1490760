"""Figures, pages and tables of the analyses, from rollouts made by hand."""

import base64
import csv
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from PIL import Image

from sb3_crc.analysis.cluster_report import write_clusters
from sb3_crc.analysis.figures import correlation_figure, evolution_figure, probe_figure, save
from sb3_crc.analysis.html import data_uri
from sb3_crc.analysis.latent_report import write_latents
from sb3_crc.analysis.saliency_film import principal_components
from sb3_crc.analysis.subjects import Subject, common_states
from sb3_crc.analysis.tables import write_rows


def is_drawn(picture: Path) -> bool:
    colours = (imread(picture)[..., :3] * 255).astype(int) @ (1 << 16, 1 << 8, 1)
    return len(np.unique(colours)) > 20 and imread(picture)[..., :3].std() > 0.02


def read(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def test_tsne_writes_panels_numbers_and_a_page(subjects: list[Subject], tmp_path: Path) -> None:
    written = write_clusters(subjects, tmp_path / "out", clusters=3, neighbours=5)
    assert {path.name for path in written} == {"tsne.png", "tsne.html", "tsne.csv", "tsne.json", "tsne.md"}
    assert is_drawn(tmp_path / "out" / "tsne.png")
    rows = read(tmp_path / "out" / "tsne.csv")
    numbers = {"silhouette, latent", "purity, latent", "silhouette, plane", "purity, plane"}
    assert {row["number"] for row in rows} == numbers
    assert {row["model"] for row in rows if row["model"]} == {"crc, seed 1", "crc, seed 2", "rad, seed 1"}
    assert len(rows) == 4 * (3 + 2)  # models and methods
    for row in rows:
        if row["number"] == "purity, latent":  # the action follows from the latent
            assert float(row["value"]) > 0.7 and float(row["chance"]) < 0.5
            has_interval = row["model"] or row["method"] == "crc"
            assert bool(row["low"]) == bool(has_interval)
            assert not has_interval or float(row["low"]) <= float(row["value"]) <= float(row["high"])
    mean = [float(row["value"]) for row in rows if row["number"] == "purity, latent" and row["method"] == "crc"]
    assert mean[2] == pytest.approx((mean[0] + mean[1]) / 2)
    assert json.loads((tmp_path / "out" / "tsne.json").read_text())[0]["low"] is not None
    text = (tmp_path / "out" / "tsne.md").read_text()
    assert "| crc, seed 2 |" in text and "| crc |" in text and "chance" in text


def test_the_page_loads_nothing_and_shows_every_frame(subjects: list[Subject], tmp_path: Path) -> None:
    write_clusters(subjects, tmp_path, clusters=3, neighbours=5)
    page = (tmp_path / "tsne.html").read_text()
    assert page.count("data:image\\u002fpng;base64,") == 3 * 120
    assert not re.search(r"<(script|img|iframe|link)[^>]+(src|href)\s*=", page)
    assert not re.search(r"""@import\s+["'u]|url\(["']?https?:|(import|fetch)\(["']https?:""", page)
    assert "plotly_hover" in page and "{plot_id}" not in page
    assert len(page) < 6_500_000


def test_a_frame_becomes_a_small_png() -> None:
    colour, grey = np.zeros((3, 96, 96), np.uint8), np.full((1, 20, 20), 200, np.uint8)
    colour[0] = 255
    for frame, expected, size in ((colour, (255, 0, 0), 48), (grey, (200, 200, 200), 20)):
        image = Image.open(io.BytesIO(base64.b64decode(data_uri(frame).partition(",")[2])))
        assert image.size == (size, size) and image.convert("RGB").getpixel((5, 5)) == expected


def test_an_overview_of_latents(subjects: list[Subject], tmp_path: Path) -> None:
    write_latents(subjects, tmp_path)
    assert is_drawn(tmp_path / "latents.png")
    rows = {(row["model"], row["number"]): float(row["value"]) for row in read(tmp_path / "latents.csv")}
    assert rows["crc, seed 1", "return"] == 20
    assert 2 < rows["crc, seed 1", "effective rank"] < 4


def test_common_states_are_taken_from_all_evenly(subjects: list[Subject]) -> None:
    states = common_states(subjects, 60)
    assert len(states.observations) == len(states.physics) == len(states.episodes) == 60
    for part, subject in zip(np.split(states.observations, 3), subjects, strict=True):
        assert np.array_equal(part[0], subject.rollout.observations[0])
        assert np.array_equal(part[-1], subject.rollout.observations[-1])
    assert len(common_states(subjects, 10_000).episodes) == 360
    assert np.bincount(common_states(subjects, 180).episodes).tolist() == [30] * 6


def test_curves_over_training_have_a_point_for_each_model(tmp_path: Path) -> None:
    common = {"method": "crc", "seed": 1, "number": "R^2 of all", "chance": 0.1, "model": ""}
    rows = [
        {**common, "file": f"run/{step}.zip", "environment_steps": step, "value": step / 400, "low": 0.0, "high": 1.0}
        for step in (300, 100, 200)
    ]
    figure = evolution_figure(rows, ["R^2 of all"])
    line, chance = figure.axes[0].lines
    assert line.get_xdata().tolist() == [100, 200, 300] and line.get_ydata().tolist() == [0.25, 0.5, 0.75]
    assert chance.get_ydata().tolist() == [0.1] * 3
    assert is_drawn(save(figure, tmp_path / "curves.png"))


def test_bars_are_means_over_models_and_the_heat_map_has_four_blocks(tmp_path: Path) -> None:
    common = {"method": "crc", "number": "R^2 of all", "low": None, "high": None}
    rows = [
        {**common, "file": "a.zip", "value": 0.4},
        {**common, "file": "b.zip", "value": 0.8},
        {**common, "method": "PCA", "file": None, "value": -3.0, "low": -4.0, "high": -2.0},
    ]
    figure = probe_figure(rows, ["all"], "a title")
    assert [bar.get_height() for bar in figure.axes[0].patches] == pytest.approx([0.6, -0.25])  # the axis ends there
    assert is_drawn(save(figure, tmp_path / "bars.png"))
    blocks = np.kron([[1.0, 0.1], [0.1, 0.5]], np.ones((30, 30)))
    assert is_drawn(save(correlation_figure(blocks, ("A", "B"), "vectors"), tmp_path / "map.png"))


def test_what_is_beside_the_models_has_the_same_greys_however_many_there_are() -> None:
    common = {"number": "R^2 of all", "value": 0.5, "low": 0.4, "high": 0.6}
    beside = [{**common, "method": method, "file": None} for method in ("untrained encoder", "PCA of pixels")]
    for methods in (["crc"], ["crc", "rad"], ["crc", "curl", "rad"]):
        rows = [{**common, "method": method, "file": f"{method}.zip"} for method in methods] + beside
        bars = probe_figure(rows, ["all"], "a title").axes[0].patches
        assert [bar.get_facecolor()[0] for bar in bars[-2:]] == [0.55, 0.8]


def test_numbers_that_do_not_exist_are_null_in_json(tmp_path: Path) -> None:
    write_rows([{"value": float("nan"), "low": None, "name": "x"}], tmp_path, "numbers")
    assert json.loads((tmp_path / "numbers.json").read_text()) == [{"value": None, "low": None, "name": "x"}]


def test_the_trace_of_a_latent_is_its_principal_components() -> None:
    time = np.linspace(0, 20, 200)
    latents = np.outer(np.sin(time), [3.0, 4.0, 0.0]) + np.outer(np.cos(3 * time), [0.0, 0.0, 0.5]) + 7
    found = principal_components(latents, 2)
    assert abs(np.corrcoef(found[:, 0], np.sin(time))[0, 1]) > 0.999 and found[:, 0].std() == pytest.approx(1)
    assert found[:, 1].std() == pytest.approx(0.1, rel=0.1)
