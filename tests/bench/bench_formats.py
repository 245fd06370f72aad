"""What a scene takes in each format: `python tests/bench/bench_formats.py FILE...`.

FILE is in any format that can be read. CPU seconds of one thread, the first of each warm-up left
out by writing twice.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import click
from workbench import print_head, print_row

from recon_cli.render.registry import use_threads
from recon_cli.splats.registry import FORMATS, read_splats


@click.command()
@click.argument("files", nargs=-1, required=True,
                type=click.Path(exists=True, dir_okay=False, path_type=Path))
def main(files: tuple[Path, ...]) -> None:
    """Print bytes a Gaussian and seconds for each file and format."""
    use_threads("torch", 1)
    print_head(
        "scene", "Gaussians", "degree", "format", "bytes a Gaussian", "write s", "read s")
    for file in files:
        splats = read_splats(file)
        for name, form in FORMATS.items():
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / f"splats.{name}"
                form.write(path, splats)
                begin = time.process_time()
                form.write(path, splats)
                written = time.process_time()
                form.read(path)
                read = time.process_time()
                print_row(file.name, f"{len(splats):,}", str(splats.sh_degree), name,
                          f"{path.stat().st_size / len(splats):.2f}", f"{written - begin:.2f}",
                          f"{read - written:.2f}")


if __name__ == "__main__":
    main()
