"""The Python examples of the manual run as they are."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def photo(tmp_path_factory) -> Path:
    """A picture with smooth and sharp parts, 96x64."""
    y, x = np.mgrid[:64, :96] / 64
    pixels = np.stack([x / 1.5, y, (x - 0.7) ** 2 + (y - 0.5) ** 2 < 0.09], -1)
    path = tmp_path_factory.mktemp("photo") / "photo.png"
    Image.fromarray((255 * np.clip(pixels, 0, 1)).astype(np.uint8)).save(path)
    return path


@pytest.mark.integration
def test_a_script_written_for_gsplat_fits_an_image(photo, tmp_path) -> None:
    script, fitted = ROOT / "docs" / "examples" / "fit_image.py", tmp_path / "fit.png"
    imports = re.findall(r"^.*rasterization  # for gsplat: (.*)$", script.read_text("utf-8"), re.M)
    assert imports == ["from gsplat import rasterization"]
    done = subprocess.run(
        [sys.executable, str(script), str(photo), str(fitted), "120"], cwd=tmp_path,
        capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    quality = [float(value) for value in re.findall(r"([\d.]+) dB", done.stdout)]
    assert quality[-1] > 24 > quality[0]
    truth, fit = (np.asarray(Image.open(path), float) for path in (photo, fitted))
    assert truth.shape == fit.shape
    assert np.square(truth - fit).mean() < 255**2 * 10 ** -2.3


def test_the_example_of_the_page_runs() -> None:
    page = (ROOT / "docs" / "rasterization.md").read_text("utf-8")
    (code,) = re.findall(r"^```python\n(.*?)^```", page, re.M | re.S)
    names: dict[str, Any] = {}
    exec(compile(code, "docs/rasterization.md", "exec"), names)
    assert tuple(names["renders"].shape) == (1, 240, 320, 4)
    assert tuple(names["alphas"].shape) == (1, 240, 320, 1)
    assert names["means"].grad.any()
