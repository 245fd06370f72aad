"""What another program reads in the files that we write, and we in those that it writes.

`python tests/bench/bench_interop.py TOOL`, with TOOL the `splat-transform` of PlayCanvas
(`npm install @playcanvas/splat-transform`, then node_modules/.bin/splat-transform). It turns each
file into a plain .ply, whose values are compared with what our reader gives for the same file. A
line for each file and degree: the greatest difference of every parameter, opacities after the
sigmoid, log scales above -10.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import click

from recon_cli.scene.splats import Splats, with_rows
from recon_cli.splats.compressed_ply import write_compressed_ply
from recon_cli.splats.ply import read_ply, write_ply
from recon_cli.splats.registry import FORMATS
from recon_cli.splats.splat import FORMAT, write_splat
from recon_cli.splats.spz import write_spz

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from splat_cases import edge_splats, greatest, rotation_error

Write, Read = Callable[[Path, Splats], None], Callable[[Path], Splats]
OURS: list[tuple[str, Write, Read]] = [
    ("a.ply", write_ply, read_ply),
    ("a.splat", write_splat, FORMAT.read),
    ("3.spz", write_spz, FORMATS["spz"].read),
    ("4.spz", partial(write_spz, version=4), FORMATS["spz"].read),
    ("a.compressed.ply", write_compressed_ply, FORMATS["compressed.ply"].read),
]
THEIRS: list[tuple[str, list[str], Read]] = [
    ("3.spz", ["--spz-version", "3"], FORMATS["spz"].read), ("4.spz", [], FORMATS["spz"].read),
    ("a.compressed.ply", [], FORMATS["compressed.ply"].read),
]


def converted(tool: str, source: Path, target: Path, options: list[str]) -> Path:
    """Lets the tool turn one file into another."""
    subprocess.run([tool, "--quiet", "--overwrite", *options, str(source), str(target)], check=True,
                   stdout=subprocess.DEVNULL)
    return target


def differences(ours: Splats, theirs: Splats) -> str:
    """The greatest difference of each parameter."""
    if len(ours) != len(theirs) or ours.sh_degree != theirs.sh_degree:
        return f"{len(ours)} and {len(theirs)} Gaussians, degrees {ours.sh_degree} and " + (
            f"{theirs.sh_degree}: NOT THE SAME")
    harmonics = (with_rows(one.sh_rest, len(one)) for one in (ours, theirs))
    found = {
        "means": greatest(ours.means, theirs.means),
        "log_scales": greatest(ours.log_scales.clamp(-10), theirs.log_scales.clamp(-10)),
        "quats": rotation_error(ours, theirs),
        "opacities": greatest(ours.opacities, theirs.opacities),
        "sh_dc": greatest(ours.sh_dc, theirs.sh_dc),
        "sh_rest": greatest(*harmonics) if ours.sh_degree else 0.0,
    }
    return "  ".join(f"{name} {value:.1e}" for name, value in found.items())


@click.command()
@click.argument("tool", type=click.Path(exists=True))
def main(tool: str) -> None:
    """Prints a line for each file."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        for degree in range(4):
            splats = edge_splats(degree, far=5000.0)  # beyond 12 fractional bits of SPZ
            splats.logit_opacities.clamp_(-5, 5)  # the tool makes infinity of the bytes 0 and 255
            write_ply(out / "in.ply", splats)
            for name, write, read in OURS:
                write(out / name, splats)
                theirs = converted(tool, out / name, out / "out.ply", [])
                line = differences(read(out / name), read_ply(theirs))
                click.echo(f"written by us     degree {degree}  {name:17}{line}")
            for name, options, read in THEIRS:
                made = converted(tool, out / "in.ply", out / name, options)
                theirs = converted(tool, made, out / "out.ply", [])
                line = differences(read(made), read_ply(theirs))
                click.echo(f"written by them   degree {degree}  {name:17}{line}")


if __name__ == "__main__":
    main()
