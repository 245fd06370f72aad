"""What `recon eval` calls for a comparison. Torch is imported only when it runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from recon_cli.config import EvaluateConfig
from recon_cli.execute import Job

FORMS = ("text", "markdown", "csv", "latex", "json")


def compare(
    opened: Callable[[Path], tuple[Job, EvaluateConfig]], workspace: Path, items: Sequence[Path],
    form: str,
) -> str:
    """Returns the scores of workspaces and files in one of FORMS; see `compare.compared`."""
    from recon_cli.scoreboard.compare import compared
    from recon_cli.scoreboard.report import report

    return report(compared(opened, workspace, items), form)


def over_seeds(job: Job, config: EvaluateConfig, count: int, form: str) -> str:
    """Returns the scores of a workspace over seeds in one of FORMS; see `seeds.over_seeds`."""
    from recon_cli.scoreboard import seeds

    return seeds.over_seeds(job, config, count).text(form)
