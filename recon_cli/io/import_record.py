"""Where an imported scene comes from: what `import` leaves beside it for the stages behind."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from recon_cli.workspace.atomic import read_json, write_json

_FILE = "import.json"


@dataclass(frozen=True)
class Origin:
    """What is known of an imported scene.

    Attributes:
        file: name of the file that it was read from.
        format: of the file, by its name in `io.splats.registry`.
        sha256: of the file.
        gaussians: count.
        sh_degree: of the colours.
        z_up: up is z in the file; else it is -y. Asked for or assumed, never found out.
        views: it was held against views of this workspace.
        doubt: what speaks against its being in their frame, as a sentence, or nothing.
    """

    file: str
    format: str
    sha256: str
    gaussians: int
    sh_degree: int
    z_up: bool
    views: bool
    doubt: str = ""

    def write(self, folder: Path) -> None:
        """Writes it into the folder of the scene."""
        write_json(folder / _FILE, dataclasses.asdict(self))

    def warnings(self) -> list[str]:
        """Returns what whoever reads a score of this scene must know."""
        return [*([self.doubt] if self.doubt else []),
                f"the scene was imported from {self.file}: whoever trained it may have trained on "
                "the held-out views too"]

    @staticmethod
    def of(folder: Path) -> Origin | None:
        """Returns the origin of the scene in a folder; None where it was trained.

        Raises:
            FormatError: the record is damaged.
        """
        path = folder / _FILE
        return Origin(**read_json(path)) if path.exists() else None
