"""The targets of faults: a tiny finished workspace, unfinished ones, sound inputs."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import signal
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import av
import colmap_sets
import numpy as np
import posed_sets
from app_shots import Shot
from compare import differing
from forked import Finished, start
from moments import Moments, sending
from phone_writers import pack

SAMPLE = Path(__file__).resolve().parents[2] / "recon_cli" / "samples" / "room.mp4"
STAGES = ("ingest", "denoise", "sfm", "place", "train", "prune", "evaluate", "export")
VERBS = {stage: stage for stage in STAGES} | {"evaluate": "eval", "place": "sfm"}  # by stage
LIMIT = 60.0  # seconds for a command; sound ones take 0.1 to 3 on an idle core
SETTINGS = """\
[ingest]
frames = 8
max_size = 256
[sfm]
max_features = 1000
accept_weak = true
[train]
iterations = 40
max_size = 96
max_gaussians = 500
checkpoint_every = 5
sh_degree = 1
images = "original"
background = "off"
stereo = "off"
exposure = "off"
[prune]
rounds = 1
recovery = 8
"""
FORMATS = ("ply", "compressed.ply", "splat", "spz", "sog", "glb", "rad", "html", "lod")
MADE = (*FORMATS, "ksplat")  # what `recon import` takes; .ksplat is written by the lab
# verb by name: what is typed, without -w, in a finished workspace. Each does its work again.
FULL = {
    "ingest": ("ingest", "--again"), "denoise": ("denoise", "--again"), "sfm": ("sfm", "--again"),
    "train": ("train", "--again"), "prune": ("prune", "--again"), "eval": ("eval", "--again"),
    "export": ("export", "--again"), "render": ("render", "--views", "test"),
    "report": ("report",), "status": ("status", "--json"), "clean": ("clean",),
}


@dataclass
class Lab:
    """The folder of everything that faults are injected into; faults copy from it."""

    root: Path
    moments: dict[str, int] = field(default_factory=dict)  # changes of files, by verb of FULL
    seconds: dict[str, float] = field(default_factory=dict)  # that a verb takes
    notices: dict[str, set[str]] = field(default_factory=dict)  # that a verb prints

    @property
    def clip(self) -> Path:
        """A video of twenty frames."""
        return self.root / "clip.mp4"

    @property
    def tiny(self) -> Path:
        """The finished workspace, with render/ and report.html."""
        return self.root / "tiny"

    @property
    def made(self) -> Path:
        """Where the report of the finished workspace was written, which names that folder."""
        return self.root / "making" / "ws"

    def half(self, stage: str) -> Path:
        """A workspace in which a stage was interrupted."""
        return self.root / f"half-{stage}"

    def splats(self, form: str) -> Path:
        """The scene in a format; of lod its index, in a folder of its own."""
        if form == "lod":
            return self.root / "splats" / "lod" / "lod-meta.json"
        return self.root / "splats" / f"room.{form}"

    def sets(self) -> list[Path]:
        """Folders that `recon ingest` takes."""
        return sorted((self.root / "sets").iterdir())

    def save(self) -> None:
        """Writes what is known beside the folders."""
        lines = {verb: sorted(texts) for verb, texts in self.notices.items()}
        values = {**vars(self), "root": str(self.root), "notices": lines}
        (self.root / "lab.json").write_text(json.dumps(values))

    @classmethod
    def load(cls, root: Path) -> Lab:
        """Returns a lab that was made before."""
        values = json.loads((root / "lab.json").read_text())
        return cls(root, values["moments"], values["seconds"],
                   {verb: set(lines) for verb, lines in values["notices"].items()})


def copy(source: Path, target: Path, *, without: Sequence[str] = ()) -> Path:
    """Copies a workspace; names at its top can be left out."""
    shutil.copytree(source, target, symlinks=True, ignore=lambda folder, names: [
        name for name in names if Path(folder) == source and name in without])
    return target


def notices(text: str) -> set[str]:
    """Returns the notices of a command's stderr, without their numbers."""
    lines = [line for line in text.splitlines() if "notice: " in line]
    return {re.sub(r"[\d.,]+", "#", line) for line in lines}


def make(root: Path, rng: random.Random) -> Lab:
    """Fills an empty folder; raises AssertionError where a sound command fails."""
    lab = Lab(root)
    _write_clip(lab.clip)
    work = root / "making"
    (work / "recon").mkdir(parents=True)
    (work / "recon" / "recon.toml").write_text(SETTINGS)
    (work / "recon").rename(lab.tiny)
    _sound(lab, "ingest", str(lab.clip), "-w", str(lab.tiny))
    for stage in STAGES[1:]:
        _sound(lab, VERBS[stage], "-w", str(lab.tiny))
    _export_formats(lab)
    for verb, words in FULL.items():
        target = copy(lab.tiny, lab.made)
        moments = Moments(target)
        done = _sound(lab, *words, "-w", str(target), moments=moments)
        lab.moments[verb], lab.seconds[verb] = moments.count, done.seconds
        lab.notices[verb] = notices(done.err)
        wrongs = differing(lab.tiny, target, STAGES, made=lab.made)
        assert not wrongs, f"two sound runs differ: {wrongs}"
        if verb == "render":
            copy(target / "render", lab.tiny / "render")
        if verb == "report":
            shutil.copy2(target / "report.html", lab.tiny)
        shutil.rmtree(target)
    _sound(lab, "import", str(lab.splats("ply")), "-w", str(root / "imported"))
    copy(lab.tiny, root / "mid", without=("train", "prune"))
    _sound(lab, "train", "--prune", "-w", str(root / "mid"))
    for stage in STAGES:
        _interrupt(lab, stage, rng)
    _write_recording(root / "walk.r3d", lab.clip)
    (root / "sets").mkdir()
    _write_sets(root / "sets")
    lab.save()
    return lab


def _sound(lab: Lab, *words: str, moments: Moments | None = None) -> Finished:
    running = start(words, cwd=lab.root, prepare=moments.watch if moments else None)
    done = running.finish(4 * LIMIT)
    assert (done.code, done.orphans) == (0, ()), f"{done}\n{done.err}"
    return done


def _write_clip(path: Path) -> None:
    """Writes a piece of the room video, small."""
    with av.open(str(SAMPLE)) as source, av.open(str(path), "w") as target:
        stream = target.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 256, 144, "yuv420p"
        stream.codec_context.options = {"qp": "8", "threads": "1"}
        source.streams.video[0].thread_type = "NONE"
        for at, frame in enumerate(source.decode(video=0)):
            if at >= 40:
                break
            if at >= 20:
                small = frame.reformat(256, 144, "yuv420p")
                small.pts = None
                target.mux(stream.encode(small))
        target.mux(stream.encode())


def _export_formats(lab: Lab) -> None:
    """Keeps the scene in every format that `recon import` takes."""
    folder = copy(lab.tiny, lab.root / "making" / "formats")
    _sound(lab, "export", "--again", "--max-loss", "9", "--format", ",".join(FORMATS[1:]),
           "-w", str(folder))
    (lab.root / "splats").mkdir()
    for form in FORMATS:
        name = "lod" if form == "lod" else f"splats.{form}"
        target = lab.splats(form)
        (folder / "export" / name).rename(target.parent if form == "lod" else target)
    lab.splats("ksplat").write_bytes(_ksplat(30))
    shutil.rmtree(folder)


def _ksplat(count: int) -> bytes:
    """Returns a .ksplat without compression, of one section without coefficients."""
    rows = np.zeros(count, [("means", "<f4", 3), ("scales", "<f4", 3), ("quats", "<f4", 4),
                            ("rgba", "u1", 4)])
    rows["means"] = np.random.default_rng(1).normal(size=(count, 3))
    rows["scales"], rows["rgba"], rows["quats"][:, 0] = 0.1, 200, 1
    header, section = bytearray(4096), bytearray(1024)
    header[:2] = 0, 1
    struct.pack_into("<IIIIH", header, 4, 1, 1, count, count, 0)
    struct.pack_into("<II", section, 0, count, count)
    return bytes(header + section) + rows.tobytes()


def _write_recording(path: Path, clip: Path) -> None:
    """Writes the clip as a recording of a phone that moves sideways before a wall."""
    with av.open(str(clip)) as source:
        source.streams.video[0].thread_type = "NONE"
        frames = [frame.to_ndarray(format="rgb24") for frame in source.decode(video=0)]
    shots = []
    for at, rgb in enumerate(frames[::2]):
        pose = np.eye(4)
        pose[0, 3] = 0.1 * at
        depth = np.full((36, 64), 2.0, np.float32)
        shots.append(Shot(at, rgb, depth, pose, (200.0, 200.0, 128.0, 72.0), at / 10))
    pack(path, shots)


def _interrupt(lab: Lab, stage: str, rng: random.Random) -> None:
    """Kills a stage half-way, in a workspace that has all before it and nothing behind it."""
    later = [*STAGES[STAGES.index(stage):], "render", "report.html"]
    verb = VERBS[stage]
    for _ in range(20):
        target = copy(lab.tiny, lab.half(stage), without=later)
        moments = Moments(target)
        least = 0.0 if stage == "place" else 0.35  # the second half of its verb alone
        at = max(3, int(rng.uniform(least, 0.8) * lab.moments[verb]))
        words = (verb, *((str(lab.clip),) if stage == "ingest" else ()), "-w", str(target))
        running = start(
            words, cwd=lab.root,
            prepare=lambda at=at, moments=moments: moments.watch(at, sending(signal.SIGKILL)))
        running.finish(LIMIT)
        if list((target / ".partial").glob(f"{stage}/*")) and not (target / stage).exists():
            return
        shutil.rmtree(target)
    raise AssertionError(f"{stage} could not be interrupted half-way")


def _write_sets(folder: Path) -> None:
    """Writes small data sets with poses in every layout, and photos."""
    posed_sets.make_replica(folder / "replica")
    for name, make_set in (("scannet", posed_sets.make_scannet), ("tum", posed_sets.make_tum),
                           ("7scenes", posed_sets.make_seven_scenes),
                           ("transforms", posed_sets.make_transforms)):
        (folder / name).mkdir()
        make_set(folder / name)
    for form in colmap_sets.FORMS:
        colmap_sets.write(folder / f"colmap-{form}", colmap_sets.rig_model(), form)
    with av.open(str(folder.parent / "clip.mp4")) as source:
        (folder / "photos").mkdir()
        source.streams.video[0].thread_type = "NONE"
        for at, frame in enumerate(source.decode(video=0)):
            if at % 3 == 0:
                frame.to_image().save(folder / "photos" / f"{at:02d}.jpg", quality=95)
    os.sync()
