"""Streamed SOG of PlayCanvas, version 1: levels of detail in pieces, of which a viewer loads some.

A folder holds lod-meta.json and folders of unpacked .sog files. The leaves of a tree of boxes say
for each level which Gaussians of which file lie in them: the viewer takes a level for each leaf by
its distance. Level 0 is the scene, each further one has a quarter of the Gaussians.
Source: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog, read
together with files that splat-transform writes and reads.
"""

from __future__ import annotations

import json
import os
import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.splat_arrays import EXTENT_SIGMAS
from recon_cli.splats.format import SHARING, LoadedScene, SplatFormat
from recon_cli.splats.sog import (
    META,
    Unpacked,
    encode_webp,
    pack_splats,
    read_files,
)
from recon_cli.splats.values import (
    MOST_PARTS,
    Floats,
    UntrustedFile,
    describe_asset,
    normalize_quats,
)
from recon_cli.workspace.atomic import write_bytes
from recon_cli.workspace.layout import remove
from recon_cli.workspace.paths import leads_out

if TYPE_CHECKING:
    from recon_cli.scene.splats import Splats

LOD_META = "lod-meta.json"
_VERSION = 1
_LEVELS = 6  # at most
# Gaussians of level 0 in a leaf, at most, and of a level that needs no further one: they are loaded
# in a moment; and those from which a file of one level is full: half a second on a slow line.
_LEAF = 30_000
_FILE = 4 * _LEAF
_META_LIMIT = 64 << 20  # bytes
_FOLDER = re.compile(r"\d+_\d+")  # a file of a level: {level}_{number}


def make_levels(splats: Splats) -> list[Splats]:
    """Returns the scene, and versions of ever fewer Gaussians."""
    from recon_cli.splats.coarsen import GROUP, coarsen  # imports torch

    levels = [splats]
    while len(levels[-1]) > _LEAF and len(levels) < _LEVELS:
        levels.append(coarsen(levels[-1], len(levels[-1]) // GROUP))
    return levels


def write_lod(
    path: Path, levels: Sequence[Splats], *, seed: int = 0, sharing: int = SHARING,
    up: str | None = None,
) -> None:
    """Writes levels of a scene, the finest first, to `path`, a file named lod-meta.json.

    The files of the levels lie beside it, and replace those of another scene. `seed`, `sharing`
    and `up` are those of `write_sog`. FormatError if there are no Gaussians, or a value is not
    finite.
    """
    import torch

    folder = path.parent
    folder.mkdir(parents=True, exist_ok=True)
    discard_levels(path)
    tree = _Tree.from_means(levels[0].means.detach().cpu().numpy())
    names: list[str] = []
    for level, splats in enumerate(levels):
        leaf = tree.leaves_of(splats.means.detach().cpu().numpy())
        tree.grow(leaf, splats)
        for part in _split(np.bincount(leaf, minlength=tree.count)):
            chosen = np.flatnonzero(np.isin(leaf, part))
            piece = _all_colored(splats.select(torch.from_numpy(chosen)))
            meta, images = pack_splats(piece, leaf[chosen], seed=seed, sharing=sharing)
            name = f"{level}_{sum(other.startswith(f'{level}_') for other in names)}"
            target = folder / name
            target.mkdir(parents=True)
            for image, pixels in images.items():
                (target / image).write_bytes(encode_webp(pixels))
            (target / META).write_text(_json(meta), encoding="utf-8")
            tree.place(level, len(names), leaf[chosen])
            names.append(f"{name}/{META}")
    counts = [len(splats) for splats in levels]
    write_bytes(path, _json({
        "version": _VERSION, "asset": describe_asset(up), "count": sum(counts),
        "counts": counts, "lodLevels": len(levels), "filenames": names,
        "tree": tree.to_json()}).encode())


def discard_levels(path: Path) -> None:
    """Deletes a lod-meta.json and the files of its levels, if they are there."""
    path.unlink(missing_ok=True)  # first of all, as it names the others
    for other in [*path.parent.glob("*_*")]:
        if _FOLDER.fullmatch(other.name) and other.is_dir():
            remove(other)


def _json(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def _all_colored(splats: Splats) -> Splats:
    """Returns Gaussians that all have coefficients, if any has."""
    from recon_cli.scene.splats import Splats, with_rows

    rest = splats.sh_rest
    if len(rest):
        rest = with_rows(rest, len(splats))
    return Splats.from_parameters({**splats.parameters(), "sh_rest": rest})


def _split(counts: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Yields the leaves of each file, neighbours in the tree, from the Gaussians of each leaf."""
    part: list[int] = []
    for leaf in np.flatnonzero(counts):
        part.append(int(leaf))
        if counts[part].sum() >= _FILE:
            yield np.array(part)
            part = []
    if part:
        yield np.array(part)


@dataclass
class _Node:
    """A box that is cut at a coordinate of an axis, or a leaf."""

    leaf: int = -1  # its number; -1 for a box that is cut
    axis: int = 0
    cut: float = 0.0
    children: tuple[_Node, ...] = ()


class _Tree:
    """Leaves with about equally many Gaussians, cut along their longer sides."""

    def __init__(self, root: _Node, count: int) -> None:
        self.root, self.count = root, count
        self._low = np.full((count, 3), np.inf)
        self._high = np.full((count, 3), -np.inf)
        # of each leaf, by level: [file, offset, count]
        self._parts: list[dict[str, dict[str, int]]] = [{} for _ in range(count)]

    @classmethod
    def from_means(cls, means: Floats) -> _Tree:
        """Returns the tree of centres [N, 3]."""
        leaves = 0

        def build(rows: NDArray[np.int64]) -> _Node:
            nonlocal leaves
            values = means[rows]
            # most of them decide: a few far ones, seen through windows, would cut nothing else
            low, high = np.quantile(values, (0.01, 0.99), axis=0)
            axis = int((high - low).argmax())
            cut = float(np.median(values[:, axis]))
            below = values[:, axis] < cut
            if len(rows) <= _LEAF or not below.any():
                leaves += 1
                return _Node(leaves - 1)
            children = build(rows[below]), build(rows[~below])
            return _Node(axis=axis, cut=cut, children=children)

        root = build(np.arange(len(means)))
        return cls(root, leaves)

    def leaves_of(self, means: Floats) -> NDArray[np.int64]:
        """Returns the leaf of each centre [N, 3]."""
        found = np.empty(len(means), np.int64)
        open_nodes = [(self.root, np.arange(len(means)))]
        while open_nodes:
            node, rows = open_nodes.pop()
            if node.leaf >= 0:
                found[rows] = node.leaf
                continue
            below = means[rows, node.axis] < node.cut
            open_nodes += zip(node.children, (rows[below], rows[~below]), strict=True)
        return found

    def grow(self, leaf: NDArray[np.int64], splats: Splats) -> None:
        """Makes the boxes hold Gaussians in their leaves [N]."""
        from scipy.spatial.transform import Rotation

        quats = normalize_quats(splats.quats.detach().cpu().float().numpy())
        axes = Rotation.from_quat(quats, scalar_first=True).as_matrix()
        axes *= splats.scales.detach().cpu().numpy()[:, None]
        reach = EXTENT_SIGMAS * np.sqrt(np.square(axes).sum(axis=2))
        means = splats.means.detach().cpu().numpy().astype(np.float64)
        np.minimum.at(self._low, leaf, means - reach)
        np.maximum.at(self._high, leaf, means + reach)

    def place(self, level: int, file: int, leaf: NDArray[np.int64]) -> None:
        """Notes where the Gaussians of a file are: those of a leaf follow each other."""
        numbers, counts = np.unique(leaf, return_counts=True)
        starts = np.cumsum(counts) - counts
        for number, start, count in zip(numbers, starts, counts, strict=True):
            self._parts[number][str(level)] = {
                "file": file, "offset": int(start), "count": int(count)}

    def to_json(self) -> dict[str, Any]:
        """Returns the tree as lod-meta.json holds it."""
        def describe(node: _Node) -> tuple[dict[str, Any], NDArray[np.float64]]:
            if node.leaf >= 0:
                box = np.stack([self._low[node.leaf], self._high[node.leaf]])
                return {"bound": _bound(box), "lods": self._parts[node.leaf]}, box
            parts, boxes = zip(*map(describe, node.children), strict=True)
            stacked = np.stack(boxes)
            box = np.stack([stacked[:, 0].min(axis=0), stacked[:, 1].max(axis=0)])
            return {"bound": _bound(box), "children": list(parts)}, box

        return describe(self.root)[0]


def _bound(box: NDArray[np.float64]) -> dict[str, list[float]]:
    return {"min": box[0].tolist(), "max": box[1].tolist()}


def load_lod(path: Path) -> LoadedScene:
    """Returns the finest level of a lod-meta.json, and the Gaussians of its environment.

    FormatError if a file is missing, damaged, or breaks its own promises.
    """
    index = _Index(path)
    wanted: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for file, offset, count in index.finest():
        wanted[file].append((offset, count))
    archives = [Unpacked(place) for place in index.places(sorted(wanted))]
    counts = [archive.count(archive.meta()) for archive in archives]
    size = sum(archive.size for archive in archives)
    if archives:  # many small ones may not claim more than all of them can hold
        archives[0].check_count(sum(counts), size)
    for (file, ranges), most in zip(sorted(wanted.items()), counts, strict=False):
        ranges.sort()
        ends = [0, *(offset + count for offset, count in ranges)]
        if ends[-1] > most or any(
                offset < end for (offset, _), end in zip(ranges, ends, strict=False)):
            raise index.error(f"Gaussians of {index.names[file]} twice or beyond its {most}")
    import torch

    from recon_cli.scene.splats import joined

    parts = []
    for archive, file in zip_longest(archives, sorted(wanted)):
        piece = read_files(archive).as_tensors()
        if file is not None:  # else it is the environment, all of which is shown
            rows = np.concatenate([np.arange(at, at + count) for at, count in wanted[file]])
            piece = piece.select(torch.from_numpy(rows))
        parts.append(piece)
    if not parts:
        raise index.error("a tree without Gaussians")
    degree = max(part.sh_degree for part in parts)
    return LoadedScene(
        joined([part.with_degree(degree) for part in parts])[0].as_arrays(), index.up(index.meta),
        writer=index.generator(index.meta))


class _Index(UntrustedFile):
    """An open lod-meta.json; every method raises FormatError if it breaks its own promises."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, b"{", LOD_META)
        if len(self.data) > _META_LIMIT:
            raise self.error(f"more than {_META_LIMIT >> 20} MB")
        self.meta = self.json_object(self.data)
        # files from before version 1 do not have a number
        self.integer(self.meta, "version", _VERSION, _VERSION, default=_VERSION)
        names = self.meta.get("filenames")
        if not isinstance(names, list) or len(names) > MOST_PARTS or not all(
                isinstance(name, str) for name in names):
            raise self.error(f"filenames = {names!r:.40}; needed is a list of names")
        self.names: list[str] = names
        environment = self.meta.get("environment")
        self.environment = None if not environment else self._path(environment)

    def places(self, numbers: Sequence[int]) -> list[Path]:
        """Returns the meta.json of files of Gaussians, and of the environment as the last."""
        places = [self._path(self.names[number]) for number in numbers]
        places += [self.environment] if self.environment else []
        if len(set(map(os.path.realpath, places))) < len(places):
            raise self.error("a file of Gaussians under two names")
        return places

    def _path(self, name: object) -> Path:
        if not isinstance(name, str) or leads_out(name) or Path(name).name != META:
            raise self.error(f"the name {name!r:.80}; needed is a {META} in a folder beside it")
        return self.path.parent / name

    def finest(self) -> Iterator[tuple[int, int, int]]:
        """Yields (file, offset, count) of the finest level of each leaf."""
        open_nodes = [self.meta.get("tree")]
        while open_nodes:
            node = open_nodes.pop()
            if not isinstance(node, dict):
                raise self.error(f"the node {node!r:.40} of a tree")
            children, lods = node.get("children", []), node.get("lods", {})
            if not isinstance(children, list) or not isinstance(lods, dict):
                raise self.error("a node of a tree without a list of children or levels")
            open_nodes += reversed(children)
            if lods:
                part = lods[min(lods, key=self._level)]
                if not isinstance(part, dict):
                    raise self.error(f"the level {part!r:.40} of a leaf")
                yield (self.integer(part, "file", 0, len(self.names) - 1),
                       self.integer(part, "offset", 0, 1 << 31),
                       self.integer(part, "count", 1, 1 << 31))

    def _level(self, name: str) -> int:
        if not name.isdecimal():
            raise self.error(f"the level {name!r:.40} of a leaf")
        return int(name)


FORMAT = SplatFormat(
    load_lod,
    lambda path, splats, settings: write_lod(
        path, make_levels(splats.with_sphere().as_tensors()), sharing=settings.sharing,
        up=settings.up_axis))
