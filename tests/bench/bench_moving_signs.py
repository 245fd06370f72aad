"""Shows what the first look finds: clean, and with people drawn in.

    python tests/bench/bench_moving_signs.py bedroom office ...

The short model is that of a trial, at half the size and without stereo. Its depth says what hides
the people.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from pathlib import Path

import bench_moving
import workbench

from recon_cli.config.stages import TrainConfig
from recon_cli.scene.scene import Scene
from recon_cli.scene.splats import Splats
from recon_cli.train.fit.train_data import load_task
from recon_cli.train.parts.moving import ViewComparer, find_detections, have_evidence, preview_rows
from recon_cli.train.parts.part import TrialScene
from recon_cli.train.parts.trials import Trials
from recon_cli.train.plan import first_config

_SIZE, _LEVEL = 300, 2  # pixels of the views, and what the trial reduces them by


def look_at(scene: Scene, name: str) -> Splats:
    """Prints what the first look finds in a scene, and returns the short model."""
    config = dataclasses.replace(first_config(TrainConfig(
        sh_degree=1, background="off", exposure="off", max_size=_SIZE)), stereo="off")
    task = load_task(scene, config, workbench.numba_context())
    trials = Trials(TrialScene(task, scene.points, scene.colors, None))
    model = trials.model(config, _LEVEL)
    start = time.process_time()
    compared = ViewComparer(config.sh_degree, "numba").compare(
        model, [task.train[row] for row in preview_rows(len(task.train))])
    signs = find_detections(compared)
    workbench.print_row(name, str(len(signs)), str(signs.sum()), f"{signs.mean():.0%}",
                        "yes" if have_evidence(signs) else "no",
                        f"{time.process_time() - start:.1f}")
    return model


@workbench.click.command()
@workbench.workspaces_argument
def main(workspaces: tuple[Path, ...]) -> None:
    """Prints a table of the workspaces, clean and with people."""
    workbench.print_head("capture", "views", "with signs", "share", "searched", "CPU s")
    for workspace in workspaces:
        scene = workbench.open_scene(workspace, 0.0)
        model = look_at(scene, f"{workspace.name}, clean")
        stage = bench_moving.Stage(scene, model, bench_moving.Metres.from_scene(scene))
        for kind, place in bench_moving.KINDS.items():
            things = place(stage.cameras)
            with tempfile.TemporaryDirectory() as folder:
                made, _ = stage.draw_into(things, Path(folder) / "photos")
                look_at(made, f"{workspace.name}, {kind}")


if __name__ == "__main__":
    main()
