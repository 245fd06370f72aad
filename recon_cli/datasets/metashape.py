"""Agisoft Metashape: photos with the cameras of "Export Cameras" (XML).

A camera's transform is camera to chunk, row by row, OpenCV's axes; that of its component takes the
chunk to the world: scale * R * x + t. Calibrations count cx and cy from the middle of the image,
b1 is the difference of the focal lengths, b2 a skew, p1 and p2 are OpenCV's p2 and p1, and k4 is a
term of r^8. Of two calibrations the adjusted one is used. (Metashape's manual, appendix C;
nerfstudio's issue 2294.)
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.known_files import read_head
from recon_cli.datasets.exported_files import find_points, radial_lens, shift_far
from recon_cli.datasets.file_finder import FileFinder
from recon_cli.datasets.frame_files import parse_numbers
from recon_cli.datasets.frame_table import Z_UP, FrameTable, LeftOutError
from recon_cli.datasets.posed import PosedImage, PosedSet
from recon_cli.errors import FormatError
from recon_cli.scene.camera import Lens, make_lens
from recon_cli.scene.similarity import Similarity
from recon_cli.workspace.atomic import read_text

_MARKS = re.compile(rb"(?=.*<document)(?=.*<chunk)(?=.*<(?:sensor|camera))", re.DOTALL)
_HEAD = 1 << 16  # bytes; sensors come before cameras
_SKEW = 0.5  # pixels that leaving out b2 may move the border
# On the earth's surface, from its centre: coordinates whose up is not z.
_ECEF = (6.3e6, 6.4e6)  # metres

_Component = tuple[int, str | None]  # number of the chunk, and id in it


def find_metashape(path: Path) -> Path | None:
    """Returns the .xml of cameras in a folder, or that a file is."""
    files = [path] if path.is_file() else sorted(path.glob("*.xml"))
    return next((file for file in files if file.suffix.lower() == ".xml"
                 and _MARKS.match(read_head(file, _HEAD))), None)


@dataclass(frozen=True, eq=False)
class _Camera:
    label: str
    path: str  # the label below those of its chunk and groups, which folders may be called like
    enabled: bool
    sensor: ElementTree.Element | None
    component: _Component
    transform: str | None
    where: str


def read_metashape(path: Path) -> PosedSet:
    """Returns the photos that are aligned; InputError if none is, FormatError if damaged."""
    file = find_metashape(path)
    assert file is not None
    folder, cameras, worlds = file.parent, list[_Camera](), dict[_Component, Similarity | None]()
    for at, chunk in enumerate(_read_chunks(file)):
        found = _read_worlds(chunk, file)
        cameras += _list_cameras(chunk, at, file, found)
        worlds |= {(at, key): world for key, world in found.items()}
    table = FrameTable(folder)
    for aligned in _by_component(cameras, worlds, table):
        finder = FileFinder(folder, [camera.path for camera in aligned])
        taken = {image.path for image in table.rows}
        for camera in aligned:
            with table.frame(PurePosixPath(camera.path).name):
                path = finder.find_photo(camera.path)
                if path in taken:
                    raise LeftOutError("whose photo a larger chunk or component has, too")
                viewmat = table.pose(_pose, camera, worlds.get(camera.component))
                table.add(PosedImage(path.name, path, _sensor_lens(camera), viewmat))
    table.rows.sort(key=lambda image: (image.name, image.path))
    scaled = any(world is not None and world.scale != 1 for world in worlds.values())
    return _finish(table.finish(), folder, scaled)


def _list_cameras(
    chunk: ElementTree.Element, number: int, file: Path,
    worlds: Mapping[str | None, Similarity | None],
) -> Iterator[_Camera]:
    """Yields the cameras of a chunk, also those in groups; what is disabled disables all in it."""
    sensors = {node.get("id", ""): node for node in chunk.iterfind("sensors/sensor")}

    def walk(node: ElementTree.Element, names: list[str], enabled: bool) -> Iterator[_Camera]:
        for inner in node:
            on = enabled and inner.get("enabled", "true").lower() not in ("false", "0")
            label = inner.get("label", "")
            if inner.tag == "group":
                yield from walk(inner, [*names, label], on)
            elif inner.tag == "camera":
                component = inner.get("component_id")
                yield _Camera(
                    label, "/".join([*names, label]), on, sensors.get(inner.get("sensor_id", "")),
                    (number, component if component in worlds or len(worlds) > 1
                     else next(iter(worlds))),
                    inner.findtext("transform"), f"{file}, camera {label}")

    on = chunk.get("enabled", "true").lower() not in ("false", "0")
    for cameras in chunk.iterfind("cameras"):
        yield from walk(cameras, [chunk.get("label", "")], on)


def _finish(posed: PosedSet, folder: Path, scaled: bool) -> PosedSet:
    """Returns the set with its unit, up and points."""
    middle = np.median(posed.centers, axis=0)
    radius = float(np.linalg.norm(middle))
    posed = shift_far(find_points(posed, folder))
    if not scaled:  # in the chunk's own units
        return replace(posed, find_up=True)
    if _ECEF[0] < radius < _ECEF[1]:
        x, y, z = middle / radius
        return replace(posed, metric=True, up=(float(x), float(y), float(z)))
    return replace(posed, metric=True, up=Z_UP)


def _read_chunks(file: Path) -> list[ElementTree.Element]:
    try:
        text = read_text(file)
        if "<!ENTITY" in text or "<!DOCTYPE" in text:  # neither has a place in such a file
            raise ValueError("it defines entities")
        chunks = ElementTree.fromstring(text).findall("chunk")
    except (OSError, ValueError, ElementTree.ParseError) as error:
        raise FormatError(f"{file} cannot be read as XML: {error}.") from error
    if not chunks:
        raise FormatError(f"{file} holds no chunk.")
    return chunks


def _read_worlds(chunk: ElementTree.Element, file: Path) -> dict[str | None, Similarity | None]:
    """Returns what takes each component to the world; old files have one for the whole chunk."""
    common = _similarity(chunk, file)
    return {node.get("id"): _similarity(node, file) or common
            for node in chunk.iterfind("components/component")} or {None: common}


def _by_component(
    cameras: Sequence[_Camera], worlds: Mapping[_Component, Similarity | None], table: FrameTable
) -> list[list[_Camera]]:
    """Returns the cameras that are aligned and enabled, those of the largest component first.

    That is all there is if one of the components has no transform to the world.
    """
    groups: dict[_Component, list[_Camera]] = {}
    for camera in cameras:
        if not camera.enabled:
            table.leave_out(camera.label, "that Metashape has disabled")
        elif camera.transform is None:
            table.leave_out(camera.label, "without a transform: not aligned, or second of a rig")
        else:
            groups.setdefault(camera.component, []).append(camera)
    ordered = sorted(groups.values(), key=len, reverse=True)
    if all(worlds.get(component) for component in groups):
        return ordered
    for camera in (camera for group in ordered[1:] for camera in group):
        table.leave_out(camera.label, "of further components, which nothing places in one world")
    return ordered[:1]


def _numbers(text: str | None, count: int, where: str) -> NDArray[np.float64]:
    return parse_numbers((text or "").split(), where, count)


def _similarity(node: ElementTree.Element, file: Path) -> Similarity | None:
    """Returns what takes a chunk or component to the world, None where it does not say."""
    transform = node.find("transform")
    if transform is None:
        return None
    where = f"{file}, the transform of {node.tag} {node.get('id', '')},"
    rotation, shift, scale = map(transform.findtext, ("rotation", "translation", "scale"))
    matrix = np.eye(3) if rotation is None else _numbers(rotation, 9, where).reshape(3, 3)
    left, _, right = np.linalg.svd(matrix)
    if np.abs(left @ right - matrix).max() > 1e-3:
        raise FormatError(f"{where} holds no rotation.")
    try:
        return Similarity(
            1.0 if scale is None else float(_numbers(scale, 1, where)[0]), left @ right,
            np.zeros(3) if shift is None else _numbers(shift, 3, where))
    except ValueError as error:
        raise FormatError(f"{where} cannot be used: {error}.") from error


def _pose(camera: _Camera, world: Similarity | None) -> NDArray[np.float64]:
    """Returns camera to world [4, 4]."""
    inner = _numbers(camera.transform, 16, camera.where).reshape(4, 4)
    world = world or Similarity()
    pose = np.eye(4)
    pose[:3, :3] = world.rotation @ inner[:3, :3]
    pose[:3, 3] = world.points(inner[:3, 3])
    return pose


def _sensor_lens(camera: _Camera) -> Lens:
    """Returns the lens of a sensor; LeftOutError where COLMAP has none like it."""
    if camera.sensor is None:
        raise LeftOutError("of a sensor that the file lacks")
    kind = camera.sensor.get("type", "frame")
    if kind not in ("frame", "fisheye", "equidistant_fisheye"):
        raise LeftOutError(f"of a {kind} sensor, which is not read")
    try:
        return _make_lens(camera.sensor, kind, camera.where)
    except FormatError as error:
        raise LeftOutError(f"whose intrinsics cannot be used ({error.message})") from error


def _make_lens(sensor: ElementTree.Element, kind: str, where: str) -> Lens:
    calibrations = sensor.findall("calibration")
    calibration = next((one for one in calibrations if one.get("class") == "adjusted"),
                  calibrations[-1] if calibrations else None)
    size = calibration.find("resolution") if calibration is not None else None
    size = sensor.find("resolution") if size is None else size
    if calibration is None or size is None:
        raise FormatError(f"{where} has no calibration.")

    def number(key: str) -> float:
        text = calibration.findtext(key)
        return 0.0 if text is None else float(_numbers(text, 1, f"{where} {key}")[0])

    try:
        width, height = int(size.get("width", "")), int(size.get("height", ""))
    except ValueError as error:
        raise FormatError(f"{where} has no resolution.") from error
    focal = number("f")
    if abs(number("b2")) * height / max(focal, 1e-9) / 2 > _SKEW:
        raise FormatError(f"{where} has the skew b2 = {number('b2'):g}")
    inner = (focal + number("b1"), focal, width / 2 + number("cx"), height / 2 + number("cy"))
    radial = [number(f"k{at}") for at in range(1, 5)]
    if kind == "frame":
        return radial_lens((width, height), inner, radial, (number("p2"), number("p1")), where)
    return _fisheye((width, height), inner, radial, (number("p1"), number("p2")), where)


def _fisheye(
    size: tuple[int, int], inner: Sequence[float], radial: Sequence[float],
    tangential: tuple[float, float], where: str,
) -> Lens:
    """Returns the lens of an equidistant fisheye: radial terms of the angle, as in OpenCV."""
    if any(tangential):
        raise FormatError(f"{where} is a fisheye with p1 or p2")
    return make_lens("OPENCV_FISHEYE", *size, (*inner, *radial), where)
