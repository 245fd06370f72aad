"""What `recon export` can be told: which model, what is taken from it, which files it becomes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from recon_cli.config.fields import SCALE_BETWEEN, StageConfig, check_scale_between, option
from recon_cli.errors import ConfigError
from recon_cli.workspace.atomic import read_json

TRANSFORM = (
    "Hand the scene and its cameras out in another frame: a JSON file with a matrix of 4 rows of 4 "
    "numbers that takes points of the scene as it is without this option (in metres after "
    "--scale-between) there. It may turn, shift and scale evenly. In recon.toml: the 16 numbers, "
    "row after row.")


def read_matrix(path: str) -> list[float]:
    """Returns the 16 numbers of a JSON file with 4 rows of 4 numbers, row after row.

    Raises:
        FormatError: the file is missing or no JSON.
        ConfigError: it holds something else.
    """
    rows = read_json(Path(path))
    if not (isinstance(rows, list) and len(rows) == 4 and all(
            isinstance(row, list) and len(row) == 4
            and all(type(value) in (int, float) for value in row) for row in rows)):
        raise ConfigError(
            f"{path} holds something else than a matrix of 4 rows of 4 numbers.",
            hint="For example [[0.01, 0, 0, 0], [0, 0.01, 0, 0], [0, 0, 0.01, 0], [0, 0, 0, 1]].")
    return [float(value) for row in rows for value in row]


EXPORT_FORMATS = ("ply", "compressed.ply", "splat", "spz", "sog", "glb", "html", "points.ply",
                  "colmap", "transforms.json")


@dataclass(frozen=True)
class ExportConfig(StageConfig):
    """Which model is handed out."""

    model: str = option(
        "auto", "auto takes the pruned model where there is a fresh one.",
        choices=("auto", "base", "pruned"))
    scale_between: tuple[str, str, float] | None = option(
        None, SCALE_BETWEEN, metavar="A B METRES", automatic="the scale of the training stays")
    transform: tuple[
        float, float, float, float, float, float, float, float,
        float, float, float, float, float, float, float, float] | None = option(
        None, TRANSFORM, metavar="FILE.json", read=read_matrix,
        automatic="the frame of the training stays")
    up: str | None = option(
        None, "Turn the scene so that this axis is up: z, y (glTF, three.js, SuperSplat) or -y "
        "(COLMAP, most 3DGS viewers).", choices=("z", "y", "-y"),
        automatic="z where up was found, else as the mapper made it")
    crop: tuple[float, float, float, float, float, float] | None = option(
        None, "Keep what lies in the box between two corners, in units of the exported scene.",
        metavar="X Y Z X Y Z", automatic="everything")
    drop_floaters: bool = option(
        False, "Leave out what hangs in the air: what no training view shows, what hangs in front "
        "of the two at most that do, and what makes them worse.")
    drop_islands: bool = option(
        False, "Leave out small groups of Gaussians far from all others, but for what is seen "
        "through windows.")
    sh_degree: int | None = option(
        None, "Highest degree of the colours.", minimum=0, maximum=3,
        automatic="that of the scene")
    max_mb: float | None = option(
        None, "Largest file, of the first format that is named: by the degree and the count that "
        "look best on the validation views.", unit="MB", minimum=0.0, automatic="no limit")
    format: str = option(
        "ply", "Formats to write beside the .ply, with commas between: "
        f"{', '.join(EXPORT_FORMATS)}.", metavar="NAME,...")
    max_loss: float | None = option(
        None, "Most PSNR that a format may lose on the validation views.", unit="dB", minimum=0.0,
        automatic="0.3, and 3 for .splat, which drops harmonics")
    spz_version: int = option(
        3, "Version of .spz: 3 is what most programs read; 2 is for older ones and has coarser "
        "rotations; 4 packs by zstd.", minimum=2, maximum=4)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_scale_between(self.scale_between)
        if self.transform is not None and self.up is not None:
            raise ConfigError(
                "transform and up are given, but each decides how the exported scene is turned.",
                hint="Leave out --transform or --up, here and in recon.toml.")
        if self.crop and not all(a < b for a, b in zip(self.crop[:3], self.crop[3:], strict=True)):
            raise self._refused("crop", list(self.crop), "a lowest and a highest corner")
        for name in self.formats:
            if name not in EXPORT_FORMATS:
                raise self._refused("format", name, "one of " + ", ".join(EXPORT_FORMATS))

    @property
    def formats(self) -> tuple[str, ...]:
        """The names in `format`, each once."""
        return tuple(dict.fromkeys(name.strip() for name in self.format.split(",")))
