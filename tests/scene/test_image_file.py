import mmap
import sys

import numpy as np
import psutil
import pytest
import torch

from recon_cli.scene import image_file
from recon_cli.scene.camera import Camera
from recon_cli.scene.image_file import ImageFile
from recon_cli.scene.train_view import TrainView


def images(count, shape=(30, 41, 3)):
    generator = np.random.default_rng(0)
    return [generator.integers(0, 256, shape, dtype=np.uint8) for _ in range(count)]


@pytest.mark.parametrize("segment", [1 << 20, 10_000, 100])
def test_images_come_back_after_they_were_let_out_of_memory(tmp_path, monkeypatch, segment):
    monkeypatch.setattr(image_file, "SEGMENT", segment)
    file, originals = ImageFile(tmp_path, window=5000), images(20)
    stored = [file.put(image) for image in originals]
    for _ in range(3):
        for image, original in zip(stored, originals, strict=True):
            file.look(image.nbytes)
            np.testing.assert_array_equal(image, original)
    assert not list(tmp_path.iterdir())  # nothing is left behind, whatever happens


@pytest.mark.integration
@pytest.mark.skipif(sys.platform == "win32", reason="lets pages out of memory by itself")
def test_no_more_than_the_window_stays_in_memory(tmp_path):
    process, size = psutil.Process(), 4 << 20
    window = 4 * size
    file = ImageFile(tmp_path, window)
    stored = []
    before = process.memory_info().rss
    peak = 0
    for number in range(40):
        stored.append(file.put(np.full((size,), number, np.uint8)))
    for image in stored:
        file.look(size)
        assert image.max() == image.min()
        peak = max(peak, process.memory_info().rss - before)
    assert peak < 2 * window < 40 * size


def test_a_view_of_a_file_is_read_as_any_other_and_stays_there(tmp_path):
    image, = images(1)
    camera = Camera(41, 30, 30.0, 30.0, 20.5, 15.0, np.eye(4))
    file = ImageFile(tmp_path, window=mmap.PAGESIZE)
    view = TrainView(camera, file.put(image), file=file)
    assert view.page_locked() is view
    assert torch.equal(view.pixels(torch.device("cpu")),
                       TrainView(camera, image).pixels(torch.device("cpu")))
