"""Feeds damaged files to the readers: `python tests/bench/fuzz_readers.py [FORMAT...] --minutes 5`.

Beside bytes it damages what lies inside: what a .spz packs, the files in a .sog, numbers in
headers and JSON. A reader must refuse with a typed error or return Gaussians that can be drawn,
within 2 GB and ten seconds. The seed of a failure is printed, and `--seed` repeats it alone.
"""

from __future__ import annotations

import gzip
import io
import random
import re
import resource
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import click
import torch
from splat_cases import damaged, edge_splats

from recon_cli.errors import ReconError
from recon_cli.splats.registry import FORMATS, read_splats
from recon_cli.splats.spz import write_spz

_MOST_BYTES = 2 << 30  # beyond what is taken before the first file
_MOST_SECONDS = 10.0
_NUMBERS = (b"0", b"1", b"-1", b"3", b"255", b"65536", b"2147483648", b"99999999999", b"1e999",
            b"NaN", b"null", b"[]", b'"x"')


def seeds_of(name: str, folder: Path) -> list[bytes]:
    """Returns sound files of a format, of every degree."""
    found, path = [], folder / f"sound.{name}"
    for degree in range(4):
        splats = edge_splats(degree, 7).select(torch.arange(9))
        for write in [FORMATS[name].write, *(
                [lambda at, one: write_spz(at, one, version=4)] if name == "spz" else [])]:
            write(path, splats)
            found.append(path.read_bytes())
    return found


def renumbered(data: bytes, rng: random.Random) -> bytes:
    """Returns the bytes with a number in their text replaced."""
    places = list(re.finditer(rb"(?<![\w.])-?\d+(\.\d+)?", data[:4096]))
    if not places:
        return damaged(data, rng.randrange(2**31))
    at = rng.choice(places)
    return data[:at.start()] + rng.choice(_NUMBERS) + data[at.end():]


def hurt(data: bytes, rng: random.Random) -> bytes:
    """Returns the bytes with something wrong, inside a container or in the container itself."""
    change: Callable[[bytes], bytes] = (
        (lambda one: damaged(one, rng.randrange(2**31))) if rng.random() < 0.6
        else (lambda one: renumbered(one, rng)))
    if data[:2] == b"\x1f\x8b" and rng.random() < 0.8:
        return gzip.compress(change(gzip.decompress(data)), 1)
    if data[:2] == b"PK" and rng.random() < 0.9:
        return _rezipped(data, change, rng)
    return change(data)


def _rezipped(data: bytes, change: Callable[[bytes], bytes], rng: random.Random) -> bytes:
    """Returns an archive with one member changed, renamed, doubled or gone."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    at = rng.randrange(len(members))
    name, body = members[at]
    kind = rng.choice(["change"] * 6 + ["rename", "double", "drop", "swap"])
    other = members[rng.randrange(len(members))][1]
    members[at:at + 1] = {
        "change": [(name, change(body))], "rename": [("../" + name, body)],
        "double": [(name, body), (name, body)], "drop": [], "swap": [(name, other)]}[kind]
    out = io.BytesIO()
    packing = rng.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
    with warnings.catch_warnings(), zipfile.ZipFile(out, "w", packing) as made:
        warnings.simplefilter("ignore")  # a name that is there twice
        for name, body in members:
            made.writestr(name, body)
    return out.getvalue()


def tried(path: Path, data: bytes) -> bool:
    """Returns whether a file was read; raises where it was neither read nor refused."""
    path.write_bytes(data)
    begin = time.perf_counter()
    refused, splats = None, None
    try:
        splats = read_splats(path)
    except ReconError as error:
        refused = error
    assert time.perf_counter() - begin < _MOST_SECONDS, "too slow"
    if refused is not None:
        assert refused.hint, f"no hint: {refused.message}"
        return False
    assert splats is not None
    for field in ("means", "quats", "log_scales", "logit_opacities", "sh_dc", "sh_rest"):
        assert torch.isfinite(getattr(splats, field)).all(), f"{field} is not finite"
    return True


@click.command()
@click.argument("names", metavar="[FORMAT]...", nargs=-1, type=click.Choice(list(FORMATS)))
@click.option("--minutes", type=float, default=5.0, help="For each format.  [default: 5]")
@click.option("--seed", type=int, help="Repeat this one.  [default: new ones]")
def main(names: tuple[str, ...], minutes: float, seed: int | None) -> None:
    """Damage files of each FORMAT until something breaks or the time is up."""
    warnings.simplefilter("error")
    failures = 0
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        for name in names or FORMATS:
            sound, path = seeds_of(name, Path(folder)), Path(folder) / f"damaged.{name}"
            tried(path, sound[0])
            _limit_memory()
            end, count, read = time.monotonic() + 60 * minutes, 0, 0
            while time.monotonic() < end and failures < 20:
                number = random.randrange(2**31) if seed is None else seed
                rng = random.Random(number)
                data = hurt(rng.choice(sound), rng)
                try:
                    read += tried(path, data)
                except Exception:
                    failures += 1
                    click.echo(f"{name}: --seed {number}\n{traceback.format_exc(limit=-3)}")
                count += 1
                if seed is not None:
                    break
            click.echo(f"{name}: {count:,} files, {read:,} read, the others refused")
    sys.exit(bool(failures))


def _limit_memory() -> None:
    """Lets this process take no more than _MOST_BYTES beyond what it has."""
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (taken + _MOST_BYTES, hard))


if __name__ == "__main__":
    main()
