"""What other programs make of our .sog, levels and .glb, and we of theirs; sizes and seconds.

`npm install --prefix FOLDER @playcanvas/splat-transform gltf-validator`, then
`PYTHONPATH=tests python tests/bench/bench_interop_archives.py FOLDER [--ply SCENE.ply]`: the
greatest difference of each parameter between our reader and splat-transform, for every degree;
what the glTF validator of Khronos says; and what a scene takes as .sog. Without --ply that scene
is a made room.
"""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import tempfile
import time
from collections import Counter
from pathlib import Path

import archive_splats
import click
import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.render.registry import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats
from recon_cli.splats.glb import load_glb, write_glb
from recon_cli.splats.lod import make_levels, read_lod, write_lod
from recon_cli.splats.ply import read_ply, write_ply
from recon_cli.splats.sog import Unpacked, load_sog, read_files, write_sog

# From the axes that splat-transform takes a .ply for to those of glTF: half a turn about z.
THEIR_AXES: NDArray[np.float64] = np.diag([-1.0, -1, 1])
VALIDATE = """
import { readFileSync } from "fs";
import validator from "gltf-validator";
const bytes = new Uint8Array(readFileSync(process.argv[1]));
console.log(JSON.stringify(await validator.validateBytes(bytes, { maxIssues: 0 })));
"""


def convert(node: Path, source: Path, target: Path, *more: str) -> None:
    program = node / "node_modules" / ".bin" / "splat-transform"
    subprocess.run(
        [program, "-q", "-w", "-g", "cpu", source, *more, target], check=True, timeout=300)


def issues(node: Path, path: Path) -> Counter[str]:
    """Returns how often the validator says what, without the attributes of the extension."""
    said = subprocess.run(
        ["node", "--input-type=module", "-e", VALIDATE, path], cwd=node, check=True,
        capture_output=True, timeout=300)
    return Counter(
        message["code"] for message in json.loads(said.stdout)["issues"]["messages"]
        if "KHR_gaussian_splatting" not in message["pointer"] + message["message"])


def difference(one: Splats, other: Splats) -> str:
    if not one.sh_degree == other.sh_degree == 0 and one.sh_rest.shape != other.sh_rest.shape:
        return f"{one.sh_rest.shape} of {len(one)} against {other.sh_rest.shape} of {len(other)}"
    errors = {name: float((getattr(one, name) - getattr(other, name)).abs().max())
              for name in ("means", "log_scales", "sh_dc", *["sh_rest"] * bool(one.sh_degree))}
    errors["quats"] = float(archive_splats.apart(one.quats, other.quats).max())
    errors["opacities"] = float((one.opacities - other.opacities).abs().max())
    return ", ".join(f"{name} {error:.1e}" for name, error in errors.items())


def interop(node: Path, folder: Path) -> None:
    for degree in range(4):
        splats = archive_splats.room(3000, degree=degree)
        write_ply(folder / "plain.ply", splats)
        write_sog(folder / "ours.sog", splats)
        convert(node, folder / "ours.sog", folder / "ours.ply")
        convert(node, folder / "plain.ply", folder / "theirs.sog")
        convert(node, folder / "theirs.sog", folder / "theirs.ply")
        convert(node, folder / "plain.ply", folder / "theirs.glb")
        # turned so that, with their own half turn, what was z is up
        convert(node, folder / "plain.ply", folder / "turned.glb", "-r", "90,0,180")
        write_glb(folder / "ours.glb", splats)
        convert(node, folder / "plain.ply", folder / "theirs" / "lod-meta.json", "-l", "0")
        convert(node, folder / "theirs" / "0_0" / "meta.json", folder / "lod.ply")
        write_lod(folder / "lod" / "lod-meta.json", make_levels(splats))
        convert(node, folder / "lod" / "0_0" / "meta.json", folder / "part.ply")
        for label, one, other in (
            ("our .sog, our reader against theirs", load_sog(folder / "ours.sog").splats,
             read_ply(folder / "ours.ply")),
            ("their .sog, our reader against theirs", load_sog(folder / "theirs.sog").splats,
             read_ply(folder / "theirs.ply")),
            ("their lod-meta.json, our reader against the scene",
             read_lod(folder / "theirs" / "lod-meta.json"), read_ply(folder / "lod.ply")),
            ("a file of our lod-meta.json, our reader against theirs",
             read_files(Unpacked(folder / "lod" / "0_0" / "meta.json")),
             read_ply(folder / "part.ply")),
            ("their .glb, our reader against the scene",
             load_glb(folder / "theirs.glb", axes=THEIR_AXES).splats, splats),
            ("their turned .glb against ours, as they are in the file",
             load_glb(folder / "turned.glb", axes=np.eye(3)).splats,
             load_glb(folder / "ours.glb", axes=np.eye(3)).splats),
        ):
            click.echo(f"degree {degree}, {label}: {difference(one, other)}")
        click.echo(f"degree {degree}, validator on our .glb, beyond the extension: "
                   f"{dict(issues(node, folder / 'ours.glb')) or 'nothing'}")


def views(splats: Splats) -> list[Camera]:
    """Returns four cameras in the middle of a scene that look to its sides."""
    middle = splats.means.median(dim=0).values.double().numpy()
    cameras = []
    for turn in range(4):
        sine, cosine = math.sin(turn * math.pi / 2), math.cos(turn * math.pi / 2)
        viewmat = np.eye(4)
        viewmat[:3, :3] = [[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]
        viewmat[:3, 3] = -viewmat[:3, :3] @ middle
        cameras.append(Camera(160, 120, 100, 100, 80, 60, viewmat))
    return cameras


def psnr(splats: Splats, other: Splats) -> float:
    squares = [
        (render(splats, camera, splats.background, splats.sh_degree, backend="numba").rgb
         - render(other, camera, other.background, other.sh_degree, backend="numba").rgb).square()
        for camera in views(splats)]
    return float(-10 * torch.log10(torch.stack(squares).mean()))


def sizes(splats: Splats, folder: Path) -> None:
    write_ply(folder / "scene.ply", splats)
    start = time.process_time()
    write_sog(folder / "scene.sog", splats)
    writing = time.process_time() - start
    start = time.process_time()
    back = load_sog(folder / "scene.sog").splats
    reading = time.process_time() - start
    plain, small = ((folder / name).stat().st_size for name in ("scene.ply", "scene.sog"))
    click.echo(
        f"{len(splats)} Gaussians of degree {splats.sh_degree}: .ply {plain / len(splats):.0f} and "
        f".sog {small / len(splats):.1f} bytes each, a {plain / small:.1f}th; "
        f"{writing:.1f} s of one core to write, {reading:.1f} s to read; "
        f"{psnr(splats, back):.1f} dB between renders")
    write_glb(folder / "scene.glb", splats)
    click.echo(f".glb {(folder / 'scene.glb').stat().st_size / len(splats):.0f} bytes each")


@click.command(help=__doc__)
@click.argument("node", type=click.Path(path_type=Path, file_okay=False))
@click.option("--ply", type=click.Path(path_type=Path, exists=True))
@click.option("--gaussians", default=100_000, help="Of the made room.")
def main(node: Path, ply: Path | None, gaussians: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        if shutil.which("node") and (node / "node_modules").is_dir():
            interop(node.resolve(), Path(folder))
        else:
            click.echo(f"no node, or nothing installed in {node}: others are not asked")
        sizes(read_ply(ply) if ply else archive_splats.room(gaussians), Path(folder))


if __name__ == "__main__":
    main()
