"""Stages that do next to nothing, for the tests of what runs them.

Every stage writes result.txt, made of its options and of what it reads. The seed changes nothing
in it, as an option may whose effect does not show on the data at hand.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from recon_cli.config import settings as layers
from recon_cli.config.fields import StageConfig
from recon_cli.config.settings import Settings
from recon_cli.config.stages import ComputeConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.pipeline import plan
from recon_cli.pipeline.plan import Job, Target
from recon_cli.stages import STAGES, Stage, stage
from recon_cli.workspace.atomic import write_bytes
from recon_cli.workspace.layout import Workspace
from recon_cli.workspace.summaries import JsonRecord


@dataclasses.dataclass(frozen=True)
class FakeSummary(JsonRecord):
    """The summary of every fake stage."""

    steps: int
    length: float
    names: tuple[str, ...]
    planned_iterations: int | None = None  # of train
    file: str | None = None  # of a part


def _fake(row: Stage) -> Stage:
    return dataclasses.replace(row, module="fake_stages", summary=FakeSummary, own_digests=False,
                               parts=tuple(map(_fake, row.parts)))


TABLE = tuple(map(_fake, STAGES))
NAMES = [row.name for row in TABLE]
STEPS = 6
DEFAULT_LENGTH = 3000  # iterations of train where none are asked for

ran: list[str] = []  # stages that have been run, in order
actions: dict[str, Callable[[], None]] = {}  # done by a stage before it writes anything
seen: dict[str, StageInputs] = {}  # what a stage was given to read


def run(config: StageConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> FakeSummary:
    """Writes result.txt in steps, each of which survives a crash."""
    name = out.name
    ran.append(name)
    seen[name] = inputs
    actions.get(name, lambda: None)()
    own = f"{inputs.part}-" * bool(inputs.part)  # parts share a folder
    for step in range(1, STEPS + 1):
        path = out / f"{own}step{step}.txt"
        if not path.exists():
            write_bytes(path, f"{step} of {name}".encode())
            ctx.record(step, STEPS)
            if seconds := os.environ.get(f"SLOW_{name.upper()}"):
                time.sleep(float(seconds))
    options = {key: value for key, value in stage(name).key_options(config).items()
               if key != "seed"}
    read = [(path / "result.txt").read_text() for path in inputs.folders.values()]
    read += [path.read_text() for path in inputs.sources if path.is_file()]
    read += [(inputs.continues / "result.txt").read_text()] if inputs.continues else []
    result = hashlib.sha256(json.dumps([name, options, read]).encode()).hexdigest()
    (out / f"{own}result.txt").write_text(result)
    for volatile in next((row.volatile for row in TABLE if row.name == name), ()):
        path = out / volatile.replace("*", "any")
        path.parent.mkdir(exist_ok=True)
        path.write_text(str(time.time_ns()))
    (out / f"{own}table.txt").write_text(f"the table of {name}\n")
    planned = (getattr(config, "iterations", None) or DEFAULT_LENGTH) if name == "train" else None
    return FakeSummary(STEPS, 1.5, ("a", "b"), planned, f"{own}result.txt" if own else None)


def job_at(root: Path, settings: Settings | None = None) -> Job:
    """Returns a job on the fake stages."""
    compute = ComputeConfig(backend="torch")  # which has nothing to compile
    return Job(Workspace(root), settings or {}, compute, table=TABLE)


def bring(
    job: Job,
    *names: str,
    video: Path | None = None,
    again: bool = False,
    changes: Settings | None = None,
) -> list[str]:
    """Runs stages as the CLI does, `changes` being what was typed, and returns which ran."""
    before = len(ran)
    values = layers.merge([job.settings, changes or {}])
    targets = [
        Target(row.name, layers.build(row.config, values),
               (video,) if video and row.name == "ingest" else ())
        for row in TABLE if row.name in names]
    plan.run(job, " ".join(names), targets, again=again)
    return ran[before:]


def stale(job: Job) -> dict[str, Sequence[str]]:
    """Returns the stages that are not fresh, each with the reasons."""
    return {one.name: one.reasons for one in plan.status(job) if one.state != "fresh"}


if __name__ == "__main__":  # python fake_stages.py WORKSPACE STAGE: run by the tests to be killed
    import sys

    bring(job_at(Path(sys.argv[1])), sys.argv[2])
