"""A scene whose units are so large that the rasterizer would not draw it is refused."""

from dataclasses import replace

import pytest
from facts import raises
from tiny_scene import make_inputs

from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext
from recon_cli.errors import TrainingError
from recon_cli.io.training_scene import load_scene
from recon_cli.scene.camera import Camera
from recon_cli.train.fit.train_data import load_task


def in_units(scene, factor):
    def moved(view):
        viewmat = view.camera.viewmat.copy()
        viewmat[:3, 3] *= factor
        return replace(view, camera=Camera(**{**vars(view.camera), "viewmat": viewmat}))

    return replace(scene, train=tuple(map(moved, scene.train)), points=factor * scene.points)


def test_half_of_the_points_before_the_near_plane_are_too_many(tmp_path):
    scene = load_scene(make_inputs(tmp_path).folders, validation=0.0)
    config, ctx = RunConfig(max_gaussians=100), StageContext(backend="numba")
    assert len(load_task(scene, config, ctx).train) == len(scene.train)
    assert load_task(in_units(scene, 1000), config, ctx).extent == pytest.approx(
        1000 * scene.extent)
    with raises(TrainingError, "units", "scene") as failure:
        load_task(in_units(scene, 0.001), config, ctx)
    assert "--scale-between" in failure.value.hint
