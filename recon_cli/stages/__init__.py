"""The table of stages. A stage's module holds one `run(config, inputs, out, ctx) -> summary`.

IMPORT is the row of a scene that was imported: it takes the place (and folder) of a trained one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from recon_cli.config.export import ExportConfig
from recon_cli.config.fields import StageConfig
from recon_cli.config.stages import (
    DenoiseConfig,
    EvaluateConfig,
    ImportConfig,
    IngestConfig,
    PruneConfig,
    SfmConfig,
    TrainConfig,
)
from recon_cli.workspace.export_formats import (
    EXPORT_FORMATS,
    FORMAT_OPTIONS,
    TRANSFORM,
    ExportFormat,
)
from recon_cli.workspace.summaries import (
    DenoiseSummary,
    EvaluateSummary,
    ExportedFile,
    ExportSummary,
    ImportSummary,
    IngestSummary,
    JsonRecord,
    PlaceSummary,
    PruneSummary,
    SfmSummary,
    TrainSummary,
)


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One row: the needs of a stage and how it is run."""

    name: str  # its folder in the workspace and its section in recon.toml
    verb: str  # that the user types
    needs: tuple[str, ...] = ()  # stages that must be fresh before it starts
    uses: tuple[str, ...] = ()  # stages whose result is read if it is fresh and ignored otherwise
    config: type[StageConfig]  # class of its options
    summary: type[JsonRecord]  # that run() returns
    version: int  # goes up when its output changes meaning; every older result is then stale
    auto: bool = False  # it may be started because another stage needs it; training never is
    module: str  # of its run()
    # patterns of outputs (times, logs, for resuming) that later stages' fingerprints leave out
    volatile: tuple[str, ...] = ()
    # patterns of outputs that only continue it: without them it is fresh, and begins anew
    states: tuple[str, ...] = ()
    from_states: tuple[str, ...] = ()  # the `needs` whose states it starts from
    renders: bool = False  # it needs a rasterizer, and so torch and a device
    own_digests: bool = False  # it finds damage in its unfinished work by itself
    input_metavar: str = ""  # the user's input in usage; empty for stages that only read others
    optional_when_imported: tuple[str, ...] = ()  # `needs` that an imported scene only `uses`
    # another version of recon may have made its needs: it only shows, scores or writes the scene
    reads_other_versions: bool = False
    # folder of outputs that a user may change, remove or add: the next run is given its last result
    # to read them from
    edits: str = ""
    options: tuple[str, ...] | None = None  # of `config` that decide its result; None: all
    # patterns of the outputs that decide its result, of the stages of which not all do
    reads: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    parts: tuple[Stage, ...] = ()  # results beside its own in its folder, each made by itself

    @property
    def part(self) -> str:
        """The name that a part has in its stage; empty for a stage."""
        return self.name.partition(".")[2]

    def key_options(self, config: StageConfig) -> dict[str, Any]:
        """Returns the options that decide the result, for its fingerprint."""
        return {name: value for name, value in config.hashed_fields().items()
                if self.options is None or name in self.options}


_EXPORT_VERSION = 7
_PLACE_OPTIONS = ("part", "gravity", "scale_between")
_SCENE_OPTIONS = tuple(item.name for item in fields(ExportConfig)
                       if item.name not in FORMAT_OPTIONS)


def _format_stage(row: ExportFormat) -> Stage:
    """Returns the row of an exported format, which fits the .ply or, of cameras, its frame."""
    cameras = row.kind == "cameras"
    return Stage(
        name=f"export.{row.name}", verb="export", needs=("ingest", "place", "train", "export"),
        uses=() if cameras else ("prune",), config=ExportConfig, summary=ExportedFile,
        version=_EXPORT_VERSION, module="recon_cli.stages.export", renders=True,
        optional_when_imported=("ingest", "place"), reads_other_versions=True,
        options=row.key_options, reads={"train": (), "export": (TRANSFORM,)} if cameras else {})


STAGES: tuple[Stage, ...] = (
    Stage(name="ingest", verb="ingest", config=IngestConfig, summary=IngestSummary, version=6,
          module="recon_cli.stages.ingest", input_metavar="VIDEO"),
    Stage(name="denoise", verb="denoise", needs=("ingest",), config=DenoiseConfig,
          summary=DenoiseSummary, version=5, auto=True, module="recon_cli.stages.denoise"),
    Stage(name="sfm", verb="sfm", needs=("ingest",), config=SfmConfig, summary=SfmSummary,
          version=6, auto=True, module="recon_cli.stages.sfm", own_digests=True,
          volatile=("database.db", "log.txt", "steps.json*", "segments.json"),
          options=tuple(
              item.name for item in fields(SfmConfig) if item.name not in _PLACE_OPTIONS)),
    Stage(name="place", verb="sfm", needs=("ingest", "denoise", "sfm"), config=SfmConfig,
          summary=PlaceSummary, version=1, auto=True, module="recon_cli.stages.place",
          own_digests=True, volatile=("log.txt", "steps.json*", "verdict.json"),
          options=_PLACE_OPTIONS),
    Stage(name="train", verb="train", needs=("ingest", "place"), config=TrainConfig,
          summary=TrainSummary, version=5, module="recon_cli.stages.train", renders=True,
          volatile=("log.jsonl", "plan.json"), states=("mid.safetensors", "final.safetensors"),
          edits="masks"),
    Stage(name="prune", verb="prune", needs=("ingest", "place", "train"), config=PruneConfig,
          summary=PruneSummary, version=4, module="recon_cli.stages.prune", renders=True,
          volatile=("log.jsonl",), from_states=("train",)),
    Stage(name="evaluate", verb="eval", needs=("ingest", "place", "train"), uses=("prune",),
          config=EvaluateConfig, summary=EvaluateSummary, version=4,
          module="recon_cli.stages.evaluate", renders=True, reads_other_versions=True),
    Stage(name="export", verb="export", needs=("ingest", "place", "train"), uses=("prune",),
          config=ExportConfig, summary=ExportSummary, version=_EXPORT_VERSION,
          module="recon_cli.stages.export", renders=True,
          optional_when_imported=("ingest", "place"), reads_other_versions=True,
          options=_SCENE_OPTIONS,
          parts=tuple(map(_format_stage, list(EXPORT_FORMATS.values())[1:]))))

IMPORT = Stage(name="train", verb="import", uses=("ingest", "place"), config=ImportConfig,
               summary=ImportSummary, version=1, module="recon_cli.stages.import_scene",
               renders=True, input_metavar="FILE")


def stage(name: str) -> Stage:
    """Returns the row of a stage, or of a part of one, by its name."""
    return next(row for top in STAGES for row in (top, *top.parts) if row.name == name)
