"""The site as ``make docs`` builds it: no warning, no network, and pages that show what they should."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.docs.fences import ROOT

pytest.importorskip("furo")
pytestmark = pytest.mark.slow

#: As in the Makefile
BUILD = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "-c", "docs", "."]
#: Any connection that Python opens fails
NO_NETWORK = """
import socket, sys
def refuse(*_, **__): raise OSError("the documentation must be built offline")
socket.socket.connect = socket.create_connection = socket.getaddrinfo = refuse
from sphinx.cmd.build import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-c", NO_NETWORK, *BUILD[3:], str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_the_makefile_builds_the_same() -> None:
    assert " ".join(BUILD[3:]) in (ROOT / "Makefile").read_text()


def test_nothing_is_fetched_by_readers(site: Path) -> None:
    """No script, style or font of another host."""
    for file in site.glob("docs/**/*.html"):
        loaded = re.findall(r'<(?:script|link|img)[^>]+(?:src|href)="(https?://[^"]+)"', file.read_text())
        assert loaded == [], file.name


def test_what_the_site_holds(site: Path) -> None:
    algorithm = (site / "docs" / "algorithm.html").read_text()
    assert algorithm.count("<math") > 30 and "architecture.svg" in algorithm
    assert "_modules/sb3_crc/crc_sac.html" in algorithm  # links to the package lead to its source
    assert (site / "index.html").exists() and (site / "_images" / "learning_curves.png").exists()
    reference = (site / "docs" / "api" / "algorithm.html").read_text()
    assert 'id="sb3_crc.CRCSAC"' in reference and "encoder_learning_rate" in reference
    assert "update.json" in (site / "docs" / "performance.html").read_text()
    extending = (site / "docs" / "extending.html").read_text()
    assert all(name in extending for name in ("InverseDynamics", "random_cutout", "KeypointEncoder", "CentreTheDisc"))


def test_pages_in_a_browser(site: Path, browser: Any) -> None:
    """Light and dark, on a phone too: nothing fails, no picture is missing, nothing sticks out."""
    for width, scheme in ((1300, "light"), (390, "dark")):
        page = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme)
        said: list[str] = []
        page.on("console", lambda message, said=said: said.append(message.text))
        page.on("pageerror", lambda error, said=said: said.append(str(error)))
        for name in ("index", "algorithm", "hyperparameters", "extending", "fidelity", "api/algorithm"):
            page.goto((site / "docs" / f"{name}.html").as_uri())
            missing = "[...document.images].filter(image => image.complete && !image.naturalWidth).map(image => image.src)"
            assert page.evaluate(missing) == []
            assert page.evaluate("document.documentElement.scrollWidth") <= width, name
        assert said == []
