"""Gaussians at the edges of what the formats hold, and ways to damage files."""

from __future__ import annotations

import gzip
import random
import re
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from recon_cli.errors import FormatError
from recon_cli.scene.splats import TERMS, Splats

N = 700  # three chunks of a compressed .ply, the last not full


def edge_splats(degree: int = 3, colored: int = N, *, far: float = 2000.0, seed: int = 0) -> Splats:
    """N Gaussians: from far to near, huge to tiny, solid to clear, quaternions of any length."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(N, 4)) * np.exp(rng.uniform(-20, 20, (N, 1)))
    quats[:9] = [*np.eye(4), *-np.eye(4), np.zeros(4)]
    means = rng.normal(size=(N, 3)) * np.exp(rng.uniform(-9, 3, (N, 1)))
    means[:2] = [[far, -far, far], [-far, far, -far]]
    logits = rng.normal(0, 4, N)
    logits[:4] = [-40, 40, -6, 6]
    log_scales = rng.uniform(-9.9, 5.9, (N, 3))
    log_scales[5] = [-10, 5.9375, 0]
    values = {
        "means": means, "quats": quats, "log_scales": log_scales, "logit_opacities": logits,
        "sh_dc": rng.uniform(-1.7, 1.7, (N, 3)),
        "sh_rest": rng.uniform(-0.99, 0.99, (colored, TERMS[degree], 3)),
    }
    return Splats(**{name: torch.tensor(value).float() for name, value in values.items()})


def few(count: int = 9, degree: int = 3) -> Splats:
    """The first of them."""
    return edge_splats(degree).select(torch.arange(count))


def plain(path: Path) -> bytes:
    """The bytes of an SPZ file of version 3 before gzip, which readers take as well."""
    return gzip.decompress(path.read_bytes())


def unit(quats: torch.Tensor) -> torch.Tensor:
    """Unit quaternions in float64; zeros became no rotation."""
    exact = quats.double()
    zero = (exact == 0).all(dim=1, keepdim=True)
    exact = torch.where(zero, torch.tensor([1.0, 0, 0, 0], dtype=torch.float64), exact)
    return exact / exact.norm(dim=1, keepdim=True)


def rotation_error(one: Splats, other: Splats) -> float:
    """The greatest difference of a quaternion's components; q and -q are one rotation."""
    a, b = unit(one.quats), unit(other.quats)
    same, mirrored = ((a - sign * b).abs().amax(dim=1) for sign in (1, -1))
    return float(torch.minimum(same, mirrored).max())


def greatest(one: torch.Tensor, other: torch.Tensor) -> float:
    """The greatest absolute difference."""
    return float((one.double() - other.double()).abs().max())


def damaged(data: bytes, seed: int) -> bytes:
    """Returns a file with a few bytes flipped, overwritten, cut off, left out or put in."""
    rng, changed = random.Random(seed), bytearray(data)
    for _ in range(rng.choice([1, 1, 1, 2, 5])):
        place = rng.randrange(len(changed) + 1) if rng.random() < 0.5 else rng.randrange(
            min(len(changed), 400) + 1)
        kind = rng.randrange(5)
        if kind == 0 and place < len(changed):
            changed[place] ^= 1 << rng.randrange(8)
        elif kind == 1:
            number = rng.choice([0, 1, 2**31 - 1, 2**32 - 1, 2**63, rng.randrange(2**32)])
            changed[place:place + rng.choice([1, 2, 4, 8])] = number.to_bytes(8, "little")[
                :rng.choice([1, 4, 8])]
        elif kind == 2:
            del changed[place:]
        elif kind == 3:
            del changed[place:place + rng.choice([1, 2, 16, 32, 100])]
        else:
            words = [b"9" * 5000, b" 0", b"-", b"nan", b"1e999", b"\xff\xff", b"\n"]
            changed[place:place] = rng.choice([*words, *(rng.randbytes(n) for n in (1, 1, 3, 32))])
    return bytes(changed)


def read_or_refused(read, path, data: bytes) -> bool:
    """Whether a reader takes a file's bytes; errors other than FormatError pass through."""
    path.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            splats = read(path)
        except FormatError:
            return False
    assert all(value.isfinite().all() for value in splats.parameters().values())
    return True


def rewritten(
    path: Path, form: str, kind: str = "float", extra: Sequence[str] = (), tail: bytes = b""
) -> None:
    """Writes a .ply of `write_ply` again in another form, with columns before and a tail."""
    head, data = path.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[2] for line in head.decode().splitlines() if "property" in line]
    count = int(re.search(rb"vertex (\d+)", head)[1])
    table = np.frombuffer(data, "<f4").reshape(count, len(names))
    table = np.hstack([np.full((count, len(extra)), 7, "f4"), table])
    lines = ["ply", f"format {form} 1.0", "comment by hand", f"element vertex {count}",
             *(f"property {kind} {name}" for name in [*extra, *names])]
    if form == "ascii":
        body = "".join(" ".join(repr(float(x)) for x in row) + "\n" for row in table).encode()
    else:
        order = "<" if "little" in form else ">"
        body = table.astype(order + {"float": "f4", "double": "f8"}[kind]).tobytes()
    path.write_bytes("\n".join(lines).encode() + tail.replace(b"BODY", body))
