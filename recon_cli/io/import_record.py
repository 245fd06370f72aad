"""The record that `recon import` leaves beside a scene, for the stages that read the scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from recon_cli.workspace.atomic import read_json, write_json
from recon_cli.workspace.summaries import JsonRecord

NEEDS_VIEWS_HINT = (
    "Run `recon ingest CAPTURE` and `recon sfm` in this workspace, then `recon import` again.")
_FILE = "import.json"


@dataclass(frozen=True)
class ImportRecord(JsonRecord):
    """What is known about an imported scene."""

    file: str  # name of the file that it was read from
    format: str  # of the file, by its name in `io.splats.registry`
    sha256: str  # of the file
    gaussians: int  # count
    sh_degree: int  # of the colours
    z_up: bool  # up is z in the file; else it is -y. Given or assumed, never measured
    views: bool  # it was compared with views of this workspace
    doubt: str = ""  # why it may not be in their frame, as a sentence; empty if it fits

    def write(self, folder: Path) -> None:
        """Writes it into the folder of the scene."""
        write_json(folder / _FILE, self.to_json())

    def warnings(self) -> list[str]:
        """Returns the caveats of every score of this scene."""
        return [*([self.doubt] if self.doubt else []),
                f"the scene was imported from {self.file}: whoever trained it may have trained on "
                "the held-out views too"]

    @staticmethod
    def read(folder: Path) -> ImportRecord | None:
        """Returns the record of the scene in a folder; None if it was trained here.

        Raises:
            FormatError: the file is damaged.
            ManifestError: the file is of another version.
        """
        path = folder / _FILE
        return ImportRecord.from_json(read_json(path)) if path.exists() else None


def has_views(folders: Mapping[str, Path]) -> bool:
    """Returns whether the scene was trained on, or compared with, views of the workspace.

    Args:
        folders: the finished folders of train and perhaps sfm, by stage name.
    """
    record = ImportRecord.read(folders["train"])
    return (record is None or record.views) and "sfm" in folders
