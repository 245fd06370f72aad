"""The layouts of data sets with poses, recognised by their files and folders.

docs/captures.md lists every row; a test compares them. Another package adds a row by the entry
point `recon.layouts`; it is asked last.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path, PurePosixPath

from recon_cli.capture.known_files import refuse_lost_poses
from recon_cli.capture.masks import mask_folders, match_masks
from recon_cli.datasets.arkit_scenes import find_arkit_scenes, read_arkit_scenes
from recon_cli.datasets.bundler import find_bundler, read_bundler
from recon_cli.datasets.colmap import is_colmap, read_colmap
from recon_cli.datasets.kinect import is_seven_scenes, is_tum, read_seven_scenes, read_tum
from recon_cli.datasets.llff import is_llff, read_llff
from recon_cli.datasets.metashape import find_metashape, read_metashape
from recon_cli.datasets.nerfcapture import is_nerfcapture, read_nerfcapture
from recon_cli.datasets.opensfm import is_opensfm, read_opensfm
from recon_cli.datasets.packed import is_packed
from recon_cli.datasets.polycam import find_polycam, read_polycam
from recon_cli.datasets.posed import PosedSet
from recon_cli.datasets.quest import is_quest, read_quest
from recon_cli.datasets.reality_scan import find_reality_scan, read_reality_scan
from recon_cli.datasets.record3d import find_record3d, read_record3d
from recon_cli.datasets.rgbd import is_replica, is_scannet, read_replica, read_scannet
from recon_cli.datasets.rtabmap import find_rtabmap, read_rtabmap
from recon_cli.datasets.scanner_app import is_scanner_app, read_scanner_app
from recon_cli.datasets.split_lists import apply_lists
from recon_cli.datasets.stray_scanner import is_stray, read_stray
from recon_cli.datasets.transforms import is_transforms, read_transforms
from recon_cli.errors import FormatError, InputError, format_count, list_names
from recon_cli.plugins import load_rows


@dataclass(frozen=True)
class Layout:
    """A known layout."""

    name: str  # as `PosedSet.layout` has it
    words: str  # its name in a sentence
    needs: str  # its files, for help texts
    fits: Callable[[Path], object]  # returns something true for a path that has the layout
    read: Callable[[Path], PosedSet]  # returns the data set at such a path
    repair: str = "Copy the data set again, or export it again."  # hint where it is damaged


# The first that fits wins: nerfstudio leaves the COLMAP model beside its transforms.json.
LAYOUTS: tuple[Layout, ...] = (
    Layout("replica", "a Replica sequence (NICE-SLAM layout)",
           "results/frame%06d.jpg, traj.txt and cam_params.json", is_replica, read_replica),
    Layout("scannet", "a ScanNet scene (exported)",
           "color/, pose/ and intrinsic/, with depth/ or without", is_scannet, read_scannet),
    Layout("7scenes", "a 7-Scenes sequence",
           "frame-000000.color.png, .depth.png and .pose.txt in one folder", is_seven_scenes,
           read_seven_scenes),
    Layout("tum", "a TUM RGB-D sequence", "rgb/, rgb.txt and groundtruth.txt, with depth/ or "
           "without", is_tum, read_tum),
    Layout("polycam", "a raw export of Polycam", "keyframes/ with images/, cameras/, depth/ and "
           "confidence/", find_polycam, read_polycam),
    Layout("record3d", "a recording of Record3D", "rgb/, depth/ and metadata.json; or an .r3d",
           find_record3d, read_record3d),
    Layout("stray", "a recording of Stray Scanner", "rgb.mp4, odometry.csv and camera_matrix.csv",
           is_stray, read_stray),
    Layout("3dscannerapp", "a scan of 3D Scanner App", "frame_00000.jpg and frame_00000.json",
           is_scanner_app, read_scanner_app),
    Layout("arkitscenes", "a recording of ARKitScenes", "lowres_wide.traj, lowres_wide/ and "
           "lowres_wide_intrinsics/", find_arkit_scenes, read_arkit_scenes),
    Layout("rtabmap", "an export of RTAB-Map", "NAME_rgb/, NAME_calib/ and NAME_camera_poses.txt",
           find_rtabmap, read_rtabmap,
           "Export again: rtabmap-export --images --poses_camera --poses_format 11 NAME.db"),
    Layout("quest", "a recording of a Quest headset (MRUK)", "left_camera_mruk_rgba/, "
           "left_camera_mruk_intrinsics.json and left_camera_mruk_frame_metadata.csv", is_quest,
           read_quest),
    Layout("nerfcapture", "a capture of NeRFCapture", "transforms.json with depth_path",
           is_nerfcapture, read_nerfcapture),
    Layout("transforms", "a transforms.json data set (nerfstudio, instant-ngp)",
           "transforms.json, or transforms_train.json, and the images", is_transforms,
           read_transforms),
    Layout("colmap", "a COLMAP model", "images/ and sparse/0/", is_colmap, read_colmap),
    Layout("realityscan", "photos with cameras of RealityScan (RealityCapture, Postshot)",
           "a .csv with name, x, y, alt, heading, pitch, roll and f", find_reality_scan,
           read_reality_scan),
    Layout("metashape", "photos with cameras of Metashape", "an .xml of Export Cameras",
           find_metashape, read_metashape,
           "Export the cameras again from Metashape: File > Export > Export Cameras, as .xml."),
    Layout("bundler", "photos with cameras of Bundler", "bundle.out and list.txt", find_bundler,
           read_bundler, "Copy the file again; Bundler's format is that of version 0.3."),
    Layout("opensfm", "photos with cameras of OpenSfM or OpenDroneMap", "reconstruction.json, or "
           "cameras.json and odm_report/shots.geojson", is_opensfm, read_opensfm),
    Layout("llff", "an LLFF scene", "poses_bounds.npy and images/", is_llff, read_llff,
           "Export it again with LLFF's imgs2poses.py."),
)
PACKED = "record3d"  # the layout of what `packed` unpacks


@cache
def list_layouts() -> tuple[Layout, ...]:
    """Returns all rows, with those of other packages.

    These are loaded at the first call: their modules import this one.
    """
    return (*LAYOUTS, *load_rows("recon.layouts", Layout, [row.name for row in LAYOUTS]))


def _find_layout(path: Path) -> Layout | None:
    return next((row for row in list_layouts() if row.fits(path)), None)


def recognise(path: Path) -> str | None:
    """Returns the name of the layout that a path has, None where it has no known one."""
    layout = _find_layout(path)
    if layout is None:
        return PACKED if is_packed(path) else None
    return layout.name


def refuse_incomplete(path: Path) -> None:
    """Raises FormatError for a data set without poses or cameras, rather than read it as photos."""
    if path.name == "results" and is_replica(path.parent):
        raise FormatError(
            f"{path} holds frames and depth maps of a Replica sequence, but no poses.",
            hint=f"Give {path.parent}; or give {path / 'frame*'} to estimate the cameras.")
    if recognise(path) is None:
        refuse_lost_poses(path)


def read_posed(path: Path) -> PosedSet:
    """Returns the data set at a path; InputError if unknown or empty, FormatError if damaged."""
    layout = _find_layout(path)
    if layout is None:
        known = "; ".join(f"{row.words}: {row.needs}" for row in list_layouts())
        raise InputError(f"{path} is not a data set with poses.", hint=f"Known are {known}.")
    try:
        folder = path if path.is_dir() else path.parent
        posed = replace(layout.read(path), layout=layout.name)
        return _attach_masks(apply_lists(posed, folder), folder)
    except FormatError as error:
        if error.hint:
            raise
        raise FormatError(
            error.message, hint=layout.repair) from error
    except OSError as error:  # a folder where a file belongs, or a file that may not be read
        raise FormatError(f"{path} cannot be read: {error}.") from error


def describe(posed: PosedSet) -> str:
    """Returns the layout and content of a data set in words, without the notices."""
    words = next(row.words for row in list_layouts() if row.name == posed.layout)
    held_out = sum(image.held_out for image in posed.images)
    depth = sum(image.depth is not None for image in posed.images if not image.held_out)
    parts = [format_count(len(posed.images) - held_out, "frame" if posed.sequence else "image")]
    if depth:
        parts.append(f"{depth} with depth")
    if held_out:
        parts.append(format_count(held_out, "held-out view"))
    if posed.points is not None:
        parts.append(format_count(len(posed.points), "point"))
    if posed.missing:
        parts.append(f"{format_count(len(posed.missing), 'image')} missing")
    return f"{words}: {', '.join(parts)}"


def _attach_masks(posed: PosedSet, folder: Path) -> PosedSet:
    """Returns a data set whose images have the masks that lie in its folder or beside the images.

    Masks that the set itself names stay.
    """
    bare = {image.name: PurePosixPath(image.name) for image in posed.images if image.mask is None}
    listed = {image.mask for image in posed.images}
    homes = dict.fromkeys([folder, *(
        image.path.parents[len(PurePosixPath(image.name).parts) - above] for image in posed.images
        if image.path.is_relative_to(folder) and len(image.path.relative_to(folder).parts)
        > len(PurePosixPath(image.name).parts) for above in (0, 1))])
    masks: dict[str, Path] = {}
    unused: list[str] = []
    for place in dict.fromkeys(place for home in homes for place in mask_folders(home)):
        matches, left = match_masks(place, bare)
        masks = {**matches, **masks}
        unused += [name for name in left if place / name not in listed]
    images = tuple(replace(image, mask=masks[image.name]) if image.name in masks else image
                   for image in posed.images)
    notices = list(posed.notices)
    if masks:
        notices.append(f"{len(masks)} of its images have masks")
    if unused:
        first = posed.images[0].name
        notices.append(
            f"masks without an image are left out: {list_names(unused)}"
            + f"; that of {first} must be called {first}.png or "
            f"{PurePosixPath(first).with_suffix('.png')}" * (not masks))
    return replace(posed, images=images, notices=tuple(notices))
