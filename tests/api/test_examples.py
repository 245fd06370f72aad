"""The examples of docs/python.md run as they stand there."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import assert_facts
from one_gaussian_scene import one_gaussian
from tiny_room import make_room, write_options

from recon_cli.api import Splats, Workspace

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"^```python\n(.*?)^```", re.M | re.S)
TOP, *SECTIONS = re.split(r"^## ", PAGE, flags=re.M)
EXAMPLES = {section.partition("\n")[0]: BLOCK.findall(section)[0]
            for section in SECTIONS if BLOCK.search(section)}


def execute(name: str, monkeypatch: pytest.MonkeyPatch, folder: Path) -> dict:
    """Runs an example in a folder and returns its variables."""
    monkeypatch.chdir(folder)
    names: dict = {}
    exec(compile(EXAMPLES[name], f"docs/python.md, {name}", "exec"), names)
    return names


@pytest.fixture
def room(build_once, sample_video: Path, tmp_path: Path) -> Path:
    """A folder with the trained workspace `room`."""
    made = build_once("api-room", lambda folder: make_room(folder / "room", sample_video))
    shutil.copytree(made / "room", tmp_path / "room")
    return tmp_path


def smooth_image(height: int, width: int) -> np.ndarray:
    y, x = np.mgrid[0:1:height * 1j, 0:1:width * 1j]
    waves = [0.5 + 0.4 * np.sin(5 * x + 2), 0.5 + 0.4 * np.sin(4 * y), 0.3 + 0.5 * x * y]
    return np.uint8(255 * np.stack(waves, axis=-1))


def test_there_are_six_examples_of_at_most_20_lines() -> None:
    assert len(EXAMPLES) == 6
    assert len(BLOCK.findall(PAGE)) == 7  # with the names to import at its top
    assert all(len(code.splitlines()) <= 20 for code in EXAMPLES.values())


def test_the_names_at_the_top_can_be_imported() -> None:
    exec(BLOCK.findall(TOP)[0], {})


@pytest.mark.integration
def test_an_image_is_fitted(monkeypatch, tmp_path) -> None:
    photo = smooth_image(64, 96)
    cv2.imwrite(str(tmp_path / "photo.jpg"), photo[..., ::-1])
    names = execute("Fit an image", monkeypatch, tmp_path)
    fitted = names["rgb"][0].detach().numpy()
    error = np.mean((fitted - photo / 255) ** 2)
    assert -10 * np.log10(error) > 22  # its mean colour alone gives 11 dB
    assert error < np.var(photo / 255, axis=(0, 1)).mean() / 10


def test_a_file_is_rendered(monkeypatch, tmp_path) -> None:
    one_gaussian(means=[[0, 0, 1]], opacities=[0.9]).write(tmp_path / "scene.ply")
    names = execute("Render a file", monkeypatch, tmp_path)
    picture = cv2.imread(str(tmp_path / "view.png"))
    assert picture.shape == (240, 320, 3)
    assert picture[0, 0].tolist() == [255, 255, 255]
    assert picture[120, 160].tolist() == pytest.approx([25, 82, 255], abs=2)  # BGR
    assert names["view"].depth.max() == pytest.approx(np.hypot(3, 0.5), rel=1e-3)
    assert len(Splats.read(tmp_path / "solid.spz")) == 1


def test_renders_of_another_program_are_scored(monkeypatch, tmp_path, capsys) -> None:
    truth = smooth_image(48, 64)
    for folder, images in (("truth", [truth, truth]), ("renders", [truth, np.maximum(truth, 80)])):
        (tmp_path / folder).mkdir()
        for number, image in enumerate(images):
            cv2.imwrite(str(tmp_path / folder / f"{number}.png"), image)
    execute("Score renders of any program", monkeypatch, tmp_path)
    expected = -10 * np.log10(np.mean((np.maximum(truth, 80) / 255 - truth / 255) ** 2))
    assert f"worst: 1, {expected:.2f} dB" in capsys.readouterr().out


@pytest.mark.integration
def test_a_workspace_is_run(monkeypatch, tmp_path, sample_video, capsys) -> None:
    write_options(tmp_path / "room")
    shutil.copy(sample_video, tmp_path / "room.mp4")
    execute("Run a workspace", monkeypatch, tmp_path)
    out = capsys.readouterr().out
    assert_facts(out, 16, "frames", "cameras")
    assert re.search(r"^pruned: \d\d\.\d\d dB", out, re.M)
    assert (tmp_path / "room" / "report.html").is_file()


@pytest.mark.integration
def test_an_own_loss_falls(monkeypatch, room) -> None:
    losses = execute("Train with your own loss", monkeypatch, room)["losses"]
    epoch = len(losses) // 8
    assert np.mean(losses[-epoch:]) < 0.9 * np.mean(losses[:epoch])
    before, after = Workspace(room / "room").splats("base"), Splats.read(room / "mine.ply")
    assert len(after) == len(before)
    assert after.scales.amin(dim=1).mean() < before.scales.amin(dim=1).mean()
    assert after.backdrop == before.backdrop


@pytest.mark.integration
def test_an_own_score_prunes(monkeypatch, room) -> None:
    names = execute("Prune with your own score", monkeypatch, room)
    pruned = Splats.read(room / "half.ply")
    assert len(pruned) == len(names["splats"]) // 2
    lowest = np.ones(len(names["splats"]), bool)
    lowest[names["keep"]] = False
    assert names["score"][lowest].max() <= names["score"][names["keep"]].min()
