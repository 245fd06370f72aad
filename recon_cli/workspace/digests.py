"""SHA-256 digests of files. A known digest is valid for the same size and modification time."""

from __future__ import annotations

import fnmatch
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from recon_cli.errors import InputError
from recon_cli.workspace.json_record import sha256_json
from recon_cli.workspace.paths import refuse_special


@dataclass(frozen=True)
class FileDigest:
    """The digest of a file when it was last read, and the signs that it has not changed."""

    sha256: str
    size: int  # bytes
    mtime_ns: int


@dataclass(frozen=True)
class Source:
    """One file or folder of the user's."""

    path: str  # absolute
    # digests by path relative to the folder; a single file goes by its name
    files: Mapping[str, FileDigest]

    def contents(self) -> list[str]:
        """Returns its part of a fingerprint: digests in order, and names below a folder."""
        if len(self.files) == 1:
            return [file.sha256 for file in self.files.values()]
        return [f"{name} {file.sha256}" for name, file in self.files.items()]


def digest_file(path: Path, known: FileDigest | None = None) -> FileDigest:
    """Returns the digest of a file; `known` is believed when size and time are still the same."""
    stat = path.stat()
    if known and (known.size, known.mtime_ns) == (stat.st_size, stat.st_mtime_ns):
        return known
    with path.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    return FileDigest(sha256, stat.st_size, stat.st_mtime_ns)


def read_source(path: Path, *, known: Source | None = None, without: Path) -> Source:
    """Returns the digest of a file, or of every file below a folder.

    Hidden files are skipped, as is `without`, the workspace, which may lie beside the photos.
    `known`, an earlier reading, saves time.

    Raises:
        InputError: the path is missing, is not a file or folder, or cannot be read.
    """
    path, known_files = path.absolute(), known.files if known else {}
    refuse_special(path)
    try:
        if path.is_dir():
            paths = {str(p.relative_to(path)): p for p in _files_below(path, without)}
        elif path.exists():
            paths = {path.name: path}
        else:
            raise InputError(f"{path} does not exist.", hint="Check the path.")
        return Source(str(path), {
            name: digest_file(paths[name], known_files.get(name)) for name in sorted(paths)})
    except OSError as error:
        raise InputError(
            f"{error.filename or path} cannot be read: {error.strerror}.",
            hint="Check the file and its permissions.") from error


def _files_below(folder: Path, without: Path) -> Iterator[Path]:
    for path in folder.iterdir():
        if path.name.startswith(".") or path == without:
            continue
        if path.is_dir() and not path.is_symlink():
            yield from _files_below(path, without)
        elif path.is_file():
            yield path


def digest_outputs(outputs: Mapping[str, FileDigest], volatile: Sequence[str]) -> str:
    """Returns the digest over all outputs but those whose path matches a pattern of `volatile`."""
    return sha256_json({
        name: file.sha256 for name, file in outputs.items() if not matches(name, volatile)})


def matches(name: str, patterns: Sequence[str]) -> bool:
    """Returns whether a relative path matches one of some shell patterns."""
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)
