"""The folder of the frames: what is there, what it was made with, and what is to be made still.

render.json says with which settings. Frames are whole or not there, so those of the same settings
are kept; with others everything starts anew.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from recon_cli.errors import FormatError, WorkspaceError
from recon_cli.flythrough.images import FOLDERS
from recon_cli.workspace.atomic import LEFTOVERS, clear_leftovers, read_json, write_json
from recon_cli.workspace.digests import sha256_json
from recon_cli.workspace.lock import HOLDER, LOCK

RECORD = "render.json"
PATH = "camera_path.json"
_SCHEMA = 1  # goes up when a picture changes meaning

logger = logging.getLogger("recon")


def refuse_foreign(root: Path) -> None:
    """Raises WorkspaceError where a folder holds files that no earlier run left."""
    others = {one.name for one in root.iterdir() if not one.match(LEFTOVERS)} - {LOCK, HOLDER}
    if others and RECORD not in others:
        raise WorkspaceError(
            f"{root} is in the way: it holds {min(others)}, but no {RECORD}, so recon did not make "
            "it.", hint="Give a new or an empty folder with --out.")


class Frames:
    """The frames below one folder.

    Args:
        root: an existing folder.
        names: stems of all frames, in order.
        outputs: which of rgb, depth, alpha.
    """

    def __init__(self, root: Path, names: Sequence[str], outputs: Sequence[str]) -> None:
        self.root, self.names, self.outputs = root, tuple(names), tuple(outputs)
        self._folders = [folder for output in outputs for folder in FOLDERS[output]]

    def begin(self, settings: Mapping[str, Any], about: Mapping[str, Any]) -> tuple[str, ...]:
        """Makes the folder ready for these settings and returns which frames are missing.

        Args:
            settings: JSON values of all that decides what a frame shows.
            about: further JSON values for readers of the record.

        Raises:
            FormatError: the record of an earlier run is damaged.
        """
        settings = {"schema": _SCHEMA, **settings}
        before = self._record()
        if before is not None and before["digest"] != sha256_json(settings):
            changed = sorted(key for key in {*settings, *before["settings"]}
                             if settings.get(key) != before["settings"].get(key))
            logger.warning("%s starts anew, for there are other settings: %s", self.root,
                           ", ".join(changed) or "its record was changed by hand")
            self._clear()
            before = None
        clear_leftovers(self.root)
        missing = tuple(name for name in self.names if not all(
            self.picture(folder, name).is_file() for folder in self._folders))
        video = before["video"] if before and not missing else None
        write_json(self.root / RECORD, {
            "digest": sha256_json(settings), "settings": settings, "frames": len(self.names),
            **about, "video": video})
        for folder in self._folders:
            (self.root / folder).mkdir(exist_ok=True)
        return missing

    def picture(self, folder: str, name: str) -> Path:
        """Returns where a picture of a frame lies."""
        return self.root / folder / f"{name}.png"

    @property
    def video(self) -> Any:
        """What the finished video was made with, None where there is none of these frames."""
        record = self._record()
        return record["video"] if record else None

    @video.setter
    def video(self, made: Any) -> None:
        write_json(self.root / RECORD, {**(self._record() or {}), "video": made})

    def _record(self) -> dict[str, Any] | None:
        """Returns what an earlier run left; None where the folder is new."""
        path = self.root / RECORD
        if not path.exists():
            return None
        record = read_json(path)
        if not isinstance(record, dict) or not isinstance(record.get("settings"), dict) or not (
                {"digest", "video"} <= record.keys()):
            raise FormatError(
                f"{path} is no record of recon render.", hint=f"Delete {self.root}.")
        return record

    def _clear(self) -> None:
        """Removes what an earlier run made; the record stays until there is another."""
        for folder in {one for folders in FOLDERS.values() for one in folders}:
            for picture in (self.root / folder).glob("*.png"):
                picture.unlink()
        for path in (*(self.root / f"{output}.mp4" for output in FOLDERS), self.root / PATH):
            path.unlink(missing_ok=True)
