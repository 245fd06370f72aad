"""The table of stages. A stage's module holds one `run(config, inputs, out, ctx) -> summary`.

An imported scene takes the place of a trained one, in the same folder: IMPORT is the row of such a
result. It is told by its inputs, for training reads no file of the user's.
"""

from __future__ import annotations

from dataclasses import dataclass

from recon_cli.config.fields import StageConfig
from recon_cli.config.stages import (
    DenoiseConfig,
    EvaluateConfig,
    ExportConfig,
    ImportConfig,
    IngestConfig,
    PruneConfig,
    SfmConfig,
    TrainConfig,
)
from recon_cli.workspace.summaries import (
    DenoiseSummary,
    IngestSummary,
    JsonRecord,
    SfmSummary,
)


@dataclass(frozen=True)
class Stage:
    """One row: what a stage needs and how it is run.

    Attributes:
        name: its folder in the workspace and its section in recon.toml.
        verb: what the user types.
        needs: stages that must be fresh before it starts.
        uses: stages whose result is taken where it is fresh and left out where it is not.
        config: the class of its options.
        version: goes up when its output changes meaning; every older result is then stale.
        auto: it may be started because another stage needs it; training never is.
        module: where its run() lives.
        volatile: patterns of outputs that hold times or logs, or are kept only to resume, and so
            take no part in the fingerprints of later stages.
        renders: it needs a rasterizer, and so torch and a device.
        takes: what the user hands in, as usage shows it; empty for stages that read others alone.
        spares: of `needs`, what an imported scene does without: then they are among `uses`.
        summary: the record that run() returns.
    """

    name: str
    verb: str
    needs: tuple[str, ...]
    uses: tuple[str, ...]
    config: type[StageConfig]
    version: int
    auto: bool
    module: str
    volatile: tuple[str, ...] = ()
    renders: bool = False
    takes: str = ""
    spares: tuple[str, ...] = ()
    summary: type[JsonRecord] | None = None


STAGES: tuple[Stage, ...] = (
    Stage("ingest", "ingest", (), (), IngestConfig, 3, False, "recon_cli.stages.ingest",
          takes="VIDEO", summary=IngestSummary),
    Stage("denoise", "denoise", ("ingest",), (), DenoiseConfig, 2, True,
          "recon_cli.stages.denoise", summary=DenoiseSummary),
    Stage("sfm", "sfm", ("ingest", "denoise"), (), SfmConfig, 3, True, "recon_cli.stages.sfm",
          ("database.db", "log.txt", "steps.json", "verdict.json", "model/*"),
          summary=SfmSummary),
    Stage("train", "train", ("ingest", "sfm"), (), TrainConfig, 4, False,
          "recon_cli.stages.train", ("log.jsonl", "plan.json"), renders=True),
    Stage("prune", "prune", ("ingest", "sfm", "train"), (), PruneConfig, 4, False,
          "recon_cli.stages.prune", ("log.jsonl",), renders=True),
    Stage("evaluate", "eval", ("ingest", "sfm", "train"), ("prune",), EvaluateConfig, 2, False,
          "recon_cli.stages.evaluate", renders=True),
    Stage("export", "export", ("ingest", "sfm", "train"), ("prune",), ExportConfig, 4, False,
          "recon_cli.stages.export", renders=True, spares=("ingest", "sfm")),
)

IMPORT = Stage("train", "import", (), ("ingest", "sfm"), ImportConfig, 1, False,
               "recon_cli.stages.import_scene", renders=True, takes="FILE")


def stage(name: str) -> Stage:
    """Returns the row of a stage by its name."""
    return next(row for row in STAGES if row.name == name)
