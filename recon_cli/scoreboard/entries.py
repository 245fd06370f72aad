"""What is compared: the models of a workspace, by what its evaluate stage left, and splat files."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recon_cli.atomic import read_json
from recon_cli.errors import ConfigError, FormatError, InputError
from recon_cli.io.splats.registry import read_splats
from recon_cli.metrics import ModelScore, ViewScore
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import Splats
from recon_cli.scene.transformed import transformed
from recon_cli.stages.context import StageContext, StageInputs
from recon_cli.stages.fitting import load_scene, read_config
from recon_cli.stages.held_out import LABELS, Truth, scorable, scored, truth_digest
from recon_cli.train.plan import QUALITIES
from recon_cli.workspace import Workspace

_TRANSFORM = "transform.json"  # of an export, see stages.export

logger = logging.getLogger("recon")


@dataclass(frozen=True)
class Entry:
    """One row.

    Attributes:
        group: the workspace, or the folder whose views a file is scored on, as tables call it.
        model: base, pruned, or the name of a file.
        score: on the held-out views.
        truth: digest of what it was held against; scores can be paired where it is equal.
    """

    group: str
    model: str
    score: ModelScore
    truth: str


def checked(items: Sequence[Path]) -> None:
    """Raises InputError or ConfigError unless each path is a workspace or a file, none twice."""
    seen = set()
    for path in items:
        if not path.exists():
            raise InputError(f"{path} does not exist.", hint="Check the path.")
        if path.is_dir() and not Workspace(path).holds_results:
            raise InputError(
                f"{path} is neither a workspace nor a file of Gaussians.",
                hint="Give folders that `recon train` was run in, or files of Gaussians.")
        if path.resolve() in seen:
            raise ConfigError(f"{path} is there twice.", hint="Leave one out.")
        seen.add(path.resolve())


def of_workspace(name: str, folder: Path) -> list[Entry]:
    """Returns the models of an evaluate folder.

    Args:
        name: of the workspace.
        folder: of the stage, fresh.

    Raises:
        FormatError: metrics.json is damaged.
    """
    path = folder / "metrics.json"
    try:
        record = read_json(path)
        return [Entry(name, model, _model_score(f"{name}, {LABELS[model]}", values),
                      record["truth_digest"])
                for model, values in record["models"].items()]
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"{path} does not hold scores: {error!r}.",
            hint="Run `recon eval --again` in that workspace.") from error


def _model_score(label: str, values: Mapping[str, Any]) -> ModelScore:
    views = tuple(ViewScore(**view) for view in values["views"])
    return ModelScore(label, views, values["gaussians"], values["bytes"], values["render_ms"],
                      values["train_seconds"])


@dataclass(frozen=True, eq=False)
class Benchmark:
    """Held-out views that files are scored on.

    Attributes:
        name: of the workspace they come from.
        views: at the size they are scored at.
        ctx: backend and device.
    """

    name: str
    views: Sequence[Truth]
    ctx: StageContext


def benchmark_of(
    name: str, inputs: StageInputs, max_size: int | None, ctx: StageContext
) -> Benchmark:
    """Returns the held-out views of a workspace.

    Args:
        name: of the workspace.
        inputs: folders of ingest and sfm, and of train where there is one.
        max_size: longest side in pixels; None for that of the training, or of the default one.
        ctx: backend and device.

    Raises:
        ReconstructionError: no held-out view has a camera.
    """
    if max_size is None:
        train = inputs.folders.get("train")
        max_size = read_config(train).max_size if train else QUALITIES["normal"].max_size
    return Benchmark(name, scorable(load_scene(inputs, validation=0.0), max_size, ctx), ctx)


def of_file(path: Path, name: str, against: Benchmark) -> Entry:
    """Returns a file of Gaussians, scored on the views of a workspace, in whose world it must lie.

    A file beside which an export left transform.json is brought back into that world.

    Args:
        path: of the file.
        name: for the tables.
        against: the views.

    Raises:
        FormatError: it holds no Gaussians that can be read.
    """
    splats = _brought_back(read_splats(path), path.with_name(_TRANSFORM))
    splats = splats.map(lambda tensor: tensor.to(against.ctx.device))
    found = scored(splats, against.views, splats.sh_degree, against.ctx)
    score = ModelScore(
        name, found.views, len(splats), path.stat().st_size, found.render_ms, None)
    return Entry(against.name, name, score, truth_digest(against.views))


def _brought_back(splats: Splats, record: Path) -> Splats:
    """Returns the Gaussians in the world that an export took them from, where it says so.

    Raises:
        FormatError: what it says cannot be read.
    """
    if not record.is_file():
        return splats
    try:
        similarity = Similarity.from_json(read_json(record)["similarity"])
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"{record} does not hold the frame of an export: {error!r}.",
            hint="Run `recon export --again`, or score a copy of the file in another folder.",
        ) from error
    if similarity.is_identity:
        return splats
    logger.info("%s: brought back into the world of the training", record)
    return transformed(splats, similarity.inverse())
