"""The options of the export stage."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recon_cli.config.fields import StageConfig, option
from recon_cli.config.stages import SCALE_BETWEEN, check_scale_between
from recon_cli.errors import ConfigError, ReconError, ReconstructionError
from recon_cli.workspace.atomic import read_json
from recon_cli.workspace.export_formats import EXPORT_FORMATS, OTHER_NAMES, describe_max_loss

LEAST_TEXTURE = 64  # texels of a side


def read_matrix(path: str) -> list[float]:
    """Returns the 16 numbers of a JSON file with 4 rows of 4 numbers, row by row."""
    rows = read_json(Path(path))
    if not (isinstance(rows, list) and len(rows) == 4 and all(
            isinstance(row, list) and len(row) == 4
            and all(type(value) in (int, float) for value in row) for row in rows)):
        raise ConfigError(
            f"{path} is not a matrix of 4 rows of 4 numbers.",
            hint="For example [[0.01, 0, 0, 0], [0, 0.01, 0, 0], [0, 0, 0.01, 0], [0, 0, 0, 1]].")
    return [float(value) for row in rows for value in row]


@dataclass(frozen=True)
class ExportConfig(StageConfig):
    """Which model is exported, in which frame, and to which files."""

    model: str = option(
        "auto", "Model to export; auto: the compact one (pruned) if it is fresh, else the "
        "original (base).",
        choices=("auto", "base", "pruned"))
    scale_between: tuple[str, str, float] | None = option(
        None, SCALE_BETWEEN, metavar="A B METRES", automatic="the scale of the training")
    transform: tuple[
        float, float, float, float, float, float, float, float,
        float, float, float, float, float, float, float, float] | None = option(
        None, "JSON file with a 4 x 4 matrix (rotation, translation, uniform scale) to apply to "
        "scene and cameras, after --scale-between. In recon.toml: 16 numbers, row by row.",
        metavar="FILE.json", read=read_matrix, automatic="the frame of the training")
    up: str | None = option(
        None, "Turn the scene so that this axis is up: z, y (glTF, three.js, SuperSplat) or -y "
        "(COLMAP, most 3DGS viewers).", choices=("z", "y", "-y"),
        automatic="z if up is known, else as in training")
    crop: tuple[float, float, float, float, float, float] | None = option(
        None, "Keep the box between two corners, in units of the exported scene, without backdrop.",
        metavar="X Y Z X Y Z", automatic="everything")
    drop_floaters: bool = option(
        False, "Remove Gaussians that no training view sees, or that at most two views see and "
        "that cover surfaces behind them or make these views worse.")
    drop_islands: bool = option(
        False, "Remove small groups of Gaussians far from all others, unless seen through windows.")
    backdrop: str = option(
        "bounded", "What lies outside the room, up to the grey backdrop of the training: moved "
        "inwards, so that viewers fit the room, and left out where no view shows it (bounded); as "
        "in training (keep); or without the backdrop (drop). The page (html) is never bounded.",
        choices=("bounded", "keep", "drop"))
    sh_degree: int | None = option(
        None, "Maximum degree of the spherical harmonics.", minimum=0, maximum=3,
        automatic="that of the scene")
    max_mb: float | None = option(
        None, "Maximum size of the first format; degree and number of Gaussians are reduced by "
        "validation PSNR.", unit="MB", minimum=0.0, automatic="no limit")
    trust: bool = option(
        False, "Add the property `expected_error` to the .ply: the error (0 to 1) to expect of a "
        "Gaussian from where it is seen best.")
    format: str = option(
        "ply", "Formats besides the .ply, with commas between or repeated: "
        f"{', '.join(EXPORT_FORMATS)}.", metavar="NAME,...", repeatable=True,
        late=True)
    max_loss: float | None = option(
        None, "Maximum loss of validation PSNR by a format.", unit="dB", minimum=0.0,
        automatic=describe_max_loss())
    skip_lossy: bool = option(
        False, "Leave out a format that loses more than --max-loss, with a notice, instead of "
        "failing.", hashed=False, expert=True)
    title: str | None = option(
        None, "Title of the page (html).", metavar="TEXT",
        automatic="from the name of the capture")
    credits: bool = option(False, "Say on the page (html) what made it.")
    max_triangles: int = option(
        300_000, "Maximum number of triangles of a mesh.", minimum=4)
    voxel: float | None = option(
        None, "Side of the voxels that a mesh is made in, in units of the exported scene.",
        minimum=0.0, expert=True,
        automatic="1/128 of the median depth; 2 cm in a room")
    inferred: str = option(
        "on", "Holes in walls, floor and ceiling that surface of the same plane surrounds: close "
        "and mark them (on), also in blue (tint), or leave them open (off).",
        choices=("on", "off", "tint"))
    texture: int = option(
        4096, "Side of the texture of a mesh (.glb, .obj) in texels; 0: a colour for each vertex.",
        minimum=0, maximum=16384)
    texture_format: str = option(
        "png", "Format of the texture.", choices=("png", "jpg"), expert=True)
    spz_version: int = option(
        3, "Version of .spz: 3 is read by most programs; 2 by older ones, with coarser "
        "rotations; 4 by PlayCanvas' engine, but not by Spark.", minimum=2, maximum=4,
        expert=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_scale_between(self.scale_between)
        if self.transform is not None and self.up is not None:
            raise ConfigError(
                "transform and up are given, but both turn the exported scene.",
                hint="Leave out --transform or --up, here and in recon.toml.")
        if 0 < self.texture < LEAST_TEXTURE:
            raise self._error("texture", self.texture, f"0, or at least {LEAST_TEXTURE}")
        if self.crop and not all(a < b for a, b in zip(self.crop[:3], self.crop[3:], strict=True)):
            raise self._error("crop", list(self.crop), "a lowest and a highest corner")
        for name in self.formats:
            if name not in EXPORT_FORMATS:
                raise self._error(
                    "format", name, "one of " + ", ".join([*EXPORT_FORMATS, *OTHER_NAMES]))

    @property
    def formats(self) -> tuple[str, ...]:
        """The names in `format`, each once."""
        names = (name.strip() for name in self.format.split(","))
        return tuple(dict.fromkeys(OTHER_NAMES.get(name, name) for name in names))

    @property
    def parts(self) -> tuple[str, ...]:
        """The formats besides the .ply."""
        return tuple(name for name in self.formats if name != "ply")

    def excuses(self, error: ReconError) -> bool:
        """Returns whether a format may be left out for this error: as it loses too much."""
        return self.skip_lossy and isinstance(error, ReconstructionError)

    def hashed_fields(self) -> dict[str, Any]:
        """Returns the fields that affect a result; of the formats, the one that max_mb limits."""
        values = super().hashed_fields()
        values.pop("format", None)
        if self.max_mb is not None and self.formats[0] != "ply":
            values["format"] = self.formats[0]
        return values
