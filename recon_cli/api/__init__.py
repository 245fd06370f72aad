"""Everything that recon does, from Python: scenes, renders, scores, and workspaces with stages.

docs/python.md shows how, docs/api.md lists it. Whatever stands in `__all__` here, and in that of
`recon_cli`, is public; what else there is may change at any time. Each name is loaded when it is
first used. Nothing prints: notices go to the logger `recon`, and are part of results.
"""

from __future__ import annotations

import logging
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from recon_cli.api.cameras import look_at as look_at
    from recon_cli.api.cameras import make_camera as make_camera
    from recon_cli.api.cameras import read_cameras as read_cameras
    from recon_cli.api.rendering import Contributions as Contributions
    from recon_cli.api.rendering import Rendering as Rendering
    from recon_cli.api.rendering import measure_contributions as measure_contributions
    from recon_cli.api.rendering import render as render
    from recon_cli.api.rendering import render_depth as render_depth
    from recon_cli.api.results import EvaluateResult as EvaluateResult
    from recon_cli.api.results import ExportResult as ExportResult
    from recon_cli.api.results import IngestResult as IngestResult
    from recon_cli.api.results import ModelResult as ModelResult
    from recon_cli.api.results import SfmResult as SfmResult
    from recon_cli.api.results import StageResult as StageResult
    from recon_cli.api.results import TrainingCurve as TrainingCurve
    from recon_cli.api.results import View as View
    from recon_cli.api.scoring import Scores as Scores
    from recon_cli.api.scoring import evaluate as evaluate
    from recon_cli.api.splats import Splats as Splats
    from recon_cli.api.workspace import Workspace as Workspace
    from recon_cli.config.export import ExportConfig as ExportConfig
    from recon_cli.config.stages import ComputeConfig as ComputeConfig
    from recon_cli.config.stages import DenoiseConfig as DenoiseConfig
    from recon_cli.config.stages import EvaluateConfig as EvaluateConfig
    from recon_cli.config.stages import ImportConfig as ImportConfig
    from recon_cli.config.stages import IngestConfig as IngestConfig
    from recon_cli.config.stages import PruneConfig as PruneConfig
    from recon_cli.config.stages import SfmConfig as SfmConfig
    from recon_cli.config.stages import TrainConfig as TrainConfig
    from recon_cli.context import TrainCallback as TrainCallback
    from recon_cli.context import TrainReport as TrainReport
    from recon_cli.errors import BackendError as BackendError
    from recon_cli.errors import ConfigError as ConfigError
    from recon_cli.errors import FormatError as FormatError
    from recon_cli.errors import InputError as InputError
    from recon_cli.errors import ReconError as ReconError
    from recon_cli.errors import ReconstructionError as ReconstructionError
    from recon_cli.errors import StageError as StageError
    from recon_cli.errors import WorkspaceError as WorkspaceError
    from recon_cli.evaluation.scores import ModelMetrics as ModelMetrics
    from recon_cli.evaluation.scores import ViewScore as ViewScore
    from recon_cli.pipeline.plan import StageStatus as StageStatus
    from recon_cli.progress import Bar as Bar
    from recon_cli.progress import NullProgress as NullProgress
    from recon_cli.progress import Progress as Progress
    from recon_cli.progress import TqdmProgress as TqdmProgress
    from recon_cli.scene.camera import Camera as Camera
    from recon_cli.workspace.summaries import DenoiseSummary as DenoiseSummary
    from recon_cli.workspace.summaries import EvaluateSummary as EvaluateSummary
    from recon_cli.workspace.summaries import ExportSummary as ExportSummary
    from recon_cli.workspace.summaries import ImportSummary as ImportSummary
    from recon_cli.workspace.summaries import IngestSummary as IngestSummary
    from recon_cli.workspace.summaries import PlaceSummary as PlaceSummary
    from recon_cli.workspace.summaries import PruneSummary as PruneSummary
    from recon_cli.workspace.summaries import TrainSummary as TrainSummary

# Each module and the public names that are loaded from it, in the order of docs/api.md.
_PUBLIC: dict[str, tuple[str, ...]] = {
    "recon_cli.api.splats": ("Splats",),
    "recon_cli.scene.camera": ("Camera",),
    "recon_cli.api.cameras": ("make_camera", "look_at", "read_cameras"),
    "recon_cli.api.rendering": (
        "render", "Rendering", "render_depth", "measure_contributions", "Contributions"),
    "recon_cli.api.scoring": ("evaluate", "Scores"),
    "recon_cli.evaluation.scores": ("ViewScore", "ModelMetrics"),
    "recon_cli.api.workspace": ("Workspace",),
    "recon_cli.api.results": (
        "StageResult", "IngestResult", "SfmResult", "ModelResult", "TrainingCurve",
        "EvaluateResult", "ExportResult", "View"),
    "recon_cli.workspace.summaries": (
        "IngestSummary", "DenoiseSummary", "PlaceSummary", "TrainSummary", "ImportSummary",
        "PruneSummary", "EvaluateSummary", "ExportSummary"),
    "recon_cli.pipeline.plan": ("StageStatus",),
    "recon_cli.config.stages": (
        "IngestConfig", "DenoiseConfig", "SfmConfig", "TrainConfig", "PruneConfig",
        "EvaluateConfig", "ImportConfig", "ComputeConfig"),
    "recon_cli.config.export": ("ExportConfig",),
    "recon_cli.context": ("TrainCallback", "TrainReport"),
    "recon_cli.progress": ("Progress", "Bar", "NullProgress", "TqdmProgress"),
    "recon_cli.errors": (
        "ReconError", "ConfigError", "InputError", "FormatError", "StageError",
        "ReconstructionError", "BackendError", "WorkspaceError"),
}
_HOMES = {name: module for module, names in _PUBLIC.items() for name in names}

__all__ = list(_HOMES)

# Without a handler Python would print warnings on stderr.
logging.getLogger("recon").addHandler(logging.NullHandler())


def __getattr__(name: str) -> Any:
    """Loads a public name; AttributeError for any other."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value  # the next use does not come here
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
