"""Breaks the package on purpose and says which tests notice: `make mutants`.

Each break is a slip that a real change might make. It is applied to a copy of the tree, whose tests
run until one fails: those called as the module or that import it, those of its folder, all of
`make test`, those of `make test-rest`. A break whose text the package no longer has is an error.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import click

ROOT = Path(__file__).resolve().parents[1]
COPY = ROOT / ".pytest_cache" / "mutants" / "tree"  # one place: compiled kernels are kept by it
HEAVY = re.search(r"^HEAVY := (.+)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
assert HEAVY is not None
QUICK = f"not ({HEAVY[1]})"
WORKERS = ("-n", "2", "--dist", "worksteal")
RINGS = ("module", "folder", "test", "rest")
_NONE_SELECTED = 5  # exit code of pytest
_FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+(?: \S+)*?)(?: - .*)?$", re.MULTILINE)


class Mutant(NamedTuple):
    """One break."""

    name: str
    file: str  # below recon_cli
    old: str  # occurs once
    new: str


MUTANTS = (
    # render, kernels
    Mutant("quaternion-sign", "render/torch/projection.py",
           "2 * (x * y - w * z), 2 * (x * z", "2 * (x * y + w * z), 2 * (x * z"),
    Mutant("alpha-gradient-sign", "render/numba/composite_backward.py",
           "behind -= grad_alpha[p]", "behind += grad_alpha[p]"),
    Mutant("adam-remainder", "render/numba/optimizer.py",
           "keep2 * square[i] + add2 * grad[i] * grad[i]", "keep2 * square[i] + add2 * grad[i]"),
    Mutant("status-not-reset", "render/triton/step_status.py",
           "        self.numbers.copy_(self._first)\n", ""),
    Mutant("vignette-gradient", "render/response.py",
           "(pixels * squares).sum()", "pixels.sum()"),
    Mutant("pixel-corner", "render/response.py", "np.arange(width) + 0.5 - cx",
           "np.arange(width) - cx"),
    Mutant("no-wait-for-threads", "kernels/thread_pool.py",
           "self._wait(ended, count - 1)", "self._wait(ended, count - 2)"),
    # train
    Mutant("moments-of-new-rows", "train/fit/optimizer.py",
           "torch.where(known, moment[source.clamp(0, len(moment) - 1)], 0.0)",
           "moment[source.clamp(0, len(moment) - 1)]"),
    Mutant("sum-of-views", "train/fit/stepper.py", "1 / self._views, sh_rest", "1.0, sh_rest"),
    Mutant("split-parents-stay", "train/fit/densification.py",
           "    stays[splits] = False\n", ""),
    Mutant("halves-on-one-side", "train/fit/densification.py",
           "for side in (-1, 1)]", "for side in (1, 1)]"),
    Mutant("level-off-by-one", "train/fit/schedule.py",
           "before = self.share(iteration - 1)\n        return next(",
           "before = self.share(iteration)\n        return next("),
    Mutant("gains-not-centred", "train/parts/exposure.py",
           "        self._rows.center()\n", ""),
    Mutant("masks-inverted", "train/masks.py", "counts = ~enlarge(regions",
           "counts = enlarge(regions"),
    Mutant("prune-the-best", "train/prune/prune_loop.py",
           "torch.argsort(score, descending=True, stable=True)",
           "torch.argsort(score, stable=True)"),
    Mutant("significance-of-one-view", "train/fit/importance.py",
           "self.loo += statistics.loo", "self.loo = statistics.loo.double()"),
    Mutant("blocks-overlap", "train/blocks/merge_blocks.py",
           "return block.splats.select(torch.from_numpy(block.cell.owns(means)))",
           "return block.splats"),
    # sfm
    Mutant("ratio-one-way", "sfm/features/matching.py",
           "axis=1)[_is_clear(best[rows], back)]", "axis=1)"),
    Mutant("pair-not-turned-round", "sfm/features/matching.py",
           "                geometry.invert()\n", ""),
    Mutant("gap-in-time", "sfm/verdict/verdict.py",
           "lengths = steps / np.maximum(gaps", "lengths = steps / np.minimum(gaps"),
    Mutant("loop-turned-round", "sfm/verdict/open_loops.py",
           "points if first > second else", "points if first < second else"),
    Mutant("relative-rotation", "sfm/segments/pose_graph.py",
           "np.swapaxes(first.rotation, 1, 2) @ second.rotation",
           "first.rotation @ second.rotation"),
    Mutant("world-back-to-front", "sfm/views/undistort.py",
           "model.transform(to_sim3d(world.similarity))",
           "model.transform(to_sim3d(world.similarity.inverse()))"),
    # room, stereo, trust
    Mutant("weight-of-a-source", "room/scale_fusion.py",
           "weights = [source.error**-2", "weights = [source.error**-1"),
    Mutant("height-difference", "room/measures.py",
           "heights(middle[None])[0] + ceiling", "heights(middle[None])[0] - ceiling"),
    Mutant("line-and-column", "stereo/depths.py",
           "np.stack([column, line], axis=1)", "np.stack([line, column], axis=1)"),
    Mutant("angle-of-partners", "stereo/depths.py",
           "_NARROWER, _WIDER)\n", "_WIDER, _NARROWER)\n"),
    Mutant("half-the-span", "trust/support.py", "2 * torch.arccos(cosine", "torch.arccos(cosine"),
    Mutant("least-trusted-last", "trust/agreement.py", "np.argsort(-order", "np.argsort(order"),
    # capture, denoise
    Mutant("blurriest-frame", "capture/frame_selection.py",
           "near[np.argmax(sharpness[near])]", "near[np.argmin(sharpness[near])]"),
    Mutant("noise-quartile", "capture/noise.py",
           "np.float32) / NORMAL_QUARTILE", "np.float32) * NORMAL_QUARTILE"),
    Mutant("film-diagonal", "capture/exif.py",
           "math.hypot(width, height) * film", "max(width, height) * film"),
    Mutant("denoise-at-threshold", "stages/denoise.py",
           "noise = max(sigma, config.threshold)", "noise = config.threshold"),
    # data sets, cameras, files
    Mutant("opengl-axes", "datasets/transforms.py",
           '"{frame.where} transform_matrix", opengl=True', '"{frame.where} transform_matrix"'),
    Mutant("principal-point-unscaled", "datasets/frame_files.py",
           "cx * ratio, cy * ratio)", "cx, cy)"),
    Mutant("frames-as-text", "datasets/frame_files.py",
           "return sorted(files.items())", "return list(files.items())"),
    Mutant("pose-not-inverted", "datasets/trajectory.py",
           "turn.as_matrix().T", "turn.as_matrix()"),
    Mutant("camera-transpose", "scene/camera.py",
           "- self.viewmat[:3, 3]) @ self.viewmat[:3, :3])",
           "- self.viewmat[:3, 3]) @ self.viewmat[:3, :3].T)"),
    Mutant("lens-fx-fy", "scene/camera.py", "else [sx, sy, sx, sy]", "else [sx, sy, sy, sx]"),
    Mutant("rotation-of-a-view", "scene/similarity.py",
           "viewmat[:3, :3] @ self.rotation.T\n", "viewmat[:3, :3] @ self.rotation\n"),
    Mutant("panorama-upside-down", "scene/faces.py",
           "np.arctan2(-y, np.hypot(x, z))", "np.arctan2(y, np.hypot(x, z))"),
    Mutant("half-pixel-of-K", "io/calibration.py",
           "matrix[0, 2] + 0.5, matrix[1, 2] + 0.5", "matrix[0, 2], matrix[1, 2]"),
    Mutant("track-by-observation", "io/colmap.py", '}I")[::2]))', '}I")[1::2]))'),
    Mutant("gravity-up", "io/colmap.py", "viewmat[:3, :3] @ -up", "viewmat[:3, :3] @ up"),
    # splat formats
    Mutant("ply-channel-order", "splats/ply.py", "coefficients.reshape(n, 3",
           "coefficients.transpose(0, 2, 1).reshape(n, 3"),
    Mutant("spz-quaternion-order", "splats/spz.py",
           "encode_smallest_three(quats[:, _XYZW])", "encode_smallest_three(quats)"),
    Mutant("ksplat-term-order", "splats/ksplat.py",
           "part.reshape(len(rest), 3, high - low).transpose(0, 2, 1)",
           "part.reshape(len(rest), high - low, 3)"),
    Mutant("rad-inner-nodes", "splats/rad.py",
           "leaf = children[:, 0] == 0", "leaf = children[:, 0] >= 0"),
    # export, evaluation, flythrough, viewer, report
    Mutant("transform-order", "export/coordinate_frame.py",
           "similarity = transform.after(similarity)", "similarity = similarity.after(transform)"),
    Mutant("crop-by-any-side", "export/reduce.py",
           "(splats.means <= high)).all(dim=1)", "(splats.means <= high)).any(dim=1)"),
    Mutant("gain-upside-down", "evaluation/metrics.py",
           "(rendered * true).sum(axis=0) / np", "(true * true).sum(axis=0) / np"),
    Mutant("ssim-without-mask", "evaluation/metrics.py",
           "        rendered = np.where(mask[..., None], rendered, true)\n", ""),
    Mutant("fov-of-the-width", "flythrough/camera_path.py",
           "focals = self.height / 2", "focals = self.width / 2"),
    Mutant("longer-side", "flythrough/camera_plan.py",
           "(request.size, None) if width >= height", "(request.size, None) if width <= height"),
    Mutant("covariance-transpose", "viewer/gaussians.py",
           "factors @ factors.transpose(0, 2, 1)", "factors.transpose(0, 2, 1) @ factors"),
    Mutant("chart-margin", "report/chart.py",
           "HEIGHT - _BOTTOM - up(point[1])", "HEIGHT - _TOP - up(point[1])"),
    Mutant("gallery-order", "report/gallery.py",
           "next(iter(scores.values())).psnr_db)", "-next(iter(scores.values())).psnr_db)"),
    # workspace, pipeline, config, errors
    Mutant("key-without-inputs", "workspace/manifest.py", ' "upstream": self.upstream,\n', "\n"),
    Mutant("longer-file-is-whole", "workspace/steps.py",
           "if now < size or (now > size and not entry.grows)", "if now < size"),
    Mutant("steps-of-another-key", "workspace/steps.py",
           "if history.last.files is not None and history.last.key == self._key}",
           "if history.last.files is not None}"),
    Mutant("rename-before-flush", "workspace/atomic.py",
           "            os.fsync(file.fileno())\n", "            pass\n"),
    Mutant("digest-of-all-outputs", "pipeline/freshness.py",
           "if name not in row.reads else (", "if True else ("),
    Mutant("resume-on-another-result", "pipeline/continuation.py",
           "finished is not None and finished.digest == partial.key.continues",
           "finished is not None"),
    Mutant("names-by-case", "pipeline/batch.py",
           "stems = Counter(_stem(path).casefold()", "stems = Counter(_stem(path)"),
    Mutant("hash-of-every-option", "config/fields.py",
           "if option_info(item).hashed and not (", "if not ("),
    Mutant("hint-with-workspace", "errors.py",
           "if workspace and verb not in WITHOUT_WORKSPACE", "if workspace"),
    Mutant("limit-of-the-outer-group", "cgroups.py",
           "return min(left, default=None)", "return max(left, default=None)"),
    # api, jobs, commands, experiments
    Mutant("colour-order", "api/scoring.py", "rgb = data[..., 2::-1]", "rgb = data[..., :3]"),
    Mutant("first-distortion-term", "api/cameras.py",
           "lens.params[focals + 2:]", "lens.params[focals + 3:]"),
    Mutant("share-without-weight", "jobs/shared_jobs.py",
           "record(sum(job.weight * part for", "record(sum(part for"),
    Mutant("scores-of-the-first", "commands/compare_scores.py",
           "job, config = open_job(path)", "job, config = open_job(items[0])"),
    Mutant("gain-of-the-paper", "experiments/paper_tables.py",
           '"psnr_db": published[2] - published[0]', '"psnr_db": published[1] - published[0]'),
)


class Caught(NamedTuple):
    """What noticed a break."""

    ring: str  # one of RINGS, or nothing
    test: str
    seconds: float  # of all runs together


def copy_tree() -> None:
    """Copies what git would keep, with its times: compiled kernels and bytecode depend on them."""
    names = subprocess.run(
        ["git", "ls-files", "-coz", "--exclude-standard"], cwd=ROOT, check=True,
        capture_output=True).stdout.decode().split("\0")
    shutil.rmtree(COPY, ignore_errors=True)
    for name in filter(None, names):
        if (ROOT / name).is_file():
            (COPY / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, COPY / name)
    data = COPY.parent / "shared"  # beside it, as fixtures expect
    data.unlink(missing_ok=True)
    data.symlink_to(ROOT.parent / "shared")


def apply(mutant: Mutant) -> str:
    """Returns the broken text of the file; ValueError where the old text is not there once."""
    text = (ROOT / "recon_cli" / mutant.file).read_text(encoding="utf-8")
    if text.count(mutant.old) != 1:
        raise ValueError(f"{mutant.name}: {mutant.file} holds {text.count(mutant.old)} times "
                         f"{mutant.old!r}, needed once")
    return text.replace(mutant.old, mutant.new)


def list_failed(arguments: Sequence[str], *, full: bool = False) -> list[str]:
    """Runs tests in the copy and returns which fail."""
    environment = {**os.environ, "PYTHONPATH": str(COPY)}
    environment.setdefault("RECON_CACHE_DIR", str(ROOT / ".pytest_cache" / "recon"))
    if full:
        environment["HYPOTHESIS_PROFILE"] = "full"
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments], cwd=COPY,
        env=environment, capture_output=True, text=True, check=False)
    failed = _FAILED.findall(run.stdout)
    if run.returncode not in (0, _NONE_SELECTED) and not failed:
        raise RuntimeError(f"pytest ended with {run.returncode}:\n{run.stdout}{run.stderr}")
    return failed


def list_runs(mutant: Mutant) -> dict[str, tuple[str, ...]]:
    """Returns what pytest gets in each ring; nothing where it has no tests."""
    package, _, rest = mutant.file.partition("/")
    module = Path(mutant.file).with_suffix("")
    imports = re.compile(
        rf"\brecon_cli\.{'.'.join(module.parts)}\b"
        rf"|from {'.'.join(('recon_cli', *module.parts[:-1]))} import .*\b{module.name}\b")
    own = [path.relative_to(ROOT).as_posix() for path in sorted(
        ROOT.glob("tests/**/test_*.py"), key=lambda path: not path.stem.startswith(
            f"test_{module.name}")) if path.stem.startswith(f"test_{module.name}")
        or imports.search(path.read_text(encoding="utf-8"))]
    return {"module": ("-m", QUICK, *own) if own else (), "test": ("-m", QUICK, *WORKERS),
            "folder": ("-m", QUICK, f"tests/{package}" if rest else own[0]),
            "rest": ("-m", f"{HEAVY[1]} or hypothesis", *WORKERS)}


def judge(mutant: Mutant, rings: Iterable[str]) -> Caught:
    """Breaks the copy and runs the rings until a test fails."""
    path = COPY / "recon_cli" / mutant.file
    whole, times = path.read_bytes(), path.stat()
    begin, runs = time.monotonic(), list_runs(mutant)
    path.write_text(apply(mutant), encoding="utf-8")
    os.utime(path, (times.st_atime, times.st_mtime + 2))  # bytecode goes by whole seconds
    try:
        for ring in filter(runs.get, rings):
            if failed := list_failed(["-x", *runs[ring]], full=ring == "rest"):
                return Caught(ring, failed[0], time.monotonic() - begin)
    finally:
        path.write_bytes(whole)
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    return Caught("nothing", "", time.monotonic() - begin)


@click.command()
@click.option("--only", multiple=True, type=click.Choice([each.name for each in MUTANTS]))
@click.option("--ring", type=click.Choice(["module", "folder", "fast", "all"]), default="all",
              help="The last that runs; fast: all of `make test`.")
def main(only: Sequence[str], ring: str) -> None:
    """Prints a row for each break, and how many were caught; exit code 1 where one was not."""
    for mutant in MUTANTS:
        apply(mutant)
    copy_tree()
    rings = RINGS[:{"module": 1, "folder": 2, "fast": 3, "all": 4}[ring]]
    click.echo("| break | file | caught by | first test | s |\n|---|---|---|---|---:|")
    counts, tests = Counter[str](), set[str]()
    for mutant in MUTANTS:
        if not only or mutant.name in only:
            caught = judge(mutant, rings)
            counts[caught.ring] += 1
            tests.update(filter(None, [caught.test]))
            click.echo(f"| {mutant.name} | {mutant.file} | {caught.ring} | {caught.test} | "
                       f"{caught.seconds:.0f} |")
    click.echo(f"\n{counts.total()} breaks: " + ", ".join(
        f"{count} by {ring}" for ring, count in counts.items()))
    anyway = list_failed(["-m", "", *sorted(tests)]) if tests else []
    for test in anyway:
        click.echo(f"{test} fails without a break, too.")
    sys.exit(int("nothing" in counts or bool(anyway)))


if __name__ == "__main__":
    main()
