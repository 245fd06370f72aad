"""What turning video frames into RGB costs: `python tests/bench/bench_decoding.py VIDEO FOLDER`.

FOLDER holds the images that VIDEO was made from, frame k the k-th by name. Printed are the mean
difference in 1/255 and the PSNR of every tenth frame, as FFmpeg's scaler gives it by default and as
recon takes it.
"""

from __future__ import annotations

from pathlib import Path

import av
import click
import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.video import frames_at

EVERY = 10


def told(label: str, differences: list[NDArray[np.float64]]) -> str:
    """Returns a line on differences to the truth, [H, W, 3] each, in 1/255."""
    every = np.stack(differences)
    psnr = -10 * np.log10(np.mean((every / 255) ** 2))
    return f"{label:<8} mean difference {every.mean():+.2f} of 255, {psnr:.2f} dB"


@click.command()
@click.argument("video", type=click.Path(exists=True, path_type=Path))
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
def main(video: Path, folder: Path) -> None:
    """Prints a line for each way."""
    files = sorted(folder.glob("frame*.jpg"))[::EVERY]
    truths = [cv2.imread(str(path))[:, :, ::-1].astype(np.float64) for path in files]
    decoded = list(av.open(str(video)).decode(video=0))[::EVERY]
    plain = [frame.to_ndarray(format="rgb24") for frame in decoded]
    ours = [rgb for _, rgb in frames_at(video, range(0, EVERY * len(files), EVERY), threads=1)]
    for label, taken in (("default", plain), ("recon", ours)):
        click.echo(told(label, [rgb - true for rgb, true in zip(taken, truths, strict=True)]))


if __name__ == "__main__":
    main()
