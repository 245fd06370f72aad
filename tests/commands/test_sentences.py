"""Each stage's summary in one sentence: the figures are in it, and no raw key is."""

import pytest

from recon_cli.commands.sentences import describe_summary

INGEST = {
    "kind": "video", "declared_frames": 1200, "decoded_frames": 1200, "lost_frames": 0,
    "dropped_blurred": 6, "frames": 75, "held_out": 10, "groups": 1, "width": 600, "height": 340}
WORLD = {
    "similarity": {}, "measurement": None, "sentences": [],
    "evidence": dict.fromkeys((
        "camera_roll_deg", "camera_spread_deg", "camera_error_deg", "upright_share", "floor_share",
        "floor_contrast", "floor_tilt_deg", "wall_strength")) | {
            "up_found": True, "up_reason": "", "floor_found": True, "axis": "walls",
            "scale_source": "arbitrary", "metres": False}}
SFM = {
    "frames": 75, "registered": 70, "points": 12204, "mean_track_length": 6.4,
    "reprojection_error_px": 0.26, "median_triangulation_angle_deg": 11.5, "poses": None,
    "models": [70], "apart": [], "rejected": {}, "verdict": {"trusted": True}, "lines": [],
    "rungs": [], "seconds": {}, "unregistered": [], "unregistered_held_out": [], "world": WORLD,
    "cameras": []}
TRAIN = {
    "iterations": 3000, "gaussians": 53210, "initial_gaussians": 16334, "max_gaussians": 63300,
    "max_size": 600, "planned_iterations": 3000, "stopped_early_at": None, "training_views": 62,
    "validation_views": 3, "width": 598, "height": 339, "validation_psnr_db": 32.987,
    "train_seconds": 33.7, "parts": {}, "skipped_steps": 0, "estimated_seconds": 50.6,
    "calibration_seconds": 0.8, "cuda_peak_bytes": 0}
PRUNE = {
    "at": "mid", "score": "loo", "ratio": 0.5, "gaussians_before": 63300, "gaussians": 31650,
    "validation_psnr_db_pruned": 32.19, "rounds": [], "iterations": 1700, "recovery_steps": 680,
    "validation_psnr_db_before": None, "validation_psnr_db": 35.68, "train_seconds": 30.1}
EVALUATE = {
    "test_views": 10, "unregistered_test": ["000004.png"], "base_psnr_db": 34.2264,
    "base_ssim": 0.9517, "base_gaussians": 63300}
EXPORT = {
    "model": "pruned", "file": "splats.ply", "gaussians": 31650, "bytes": 8104822,
    "transform": {}}
IMPORT = {
    "imported_from": "room.spz", "format": "spz", "gaussians": 4000, "sh_degree": 3,
    "sha256": "0123456789ab", "views": 0}


@pytest.mark.parametrize(("stage", "summary", "facts"), [
    ("ingest", INGEST, ("75 of 1,200 frames", "video", "600x340", "10 held out", "6 too blurred")),
    ("denoise", {"mode": "auto", "frames": 12, "denoised": 3, "median_sigma_255": 0.3263}, (
        "noise 0.3 of 255", "3 of 12 frames filtered")),
    ("place", SFM, ("70 of 75 frames placed", "the model is trusted")),
    ("place", SFM | {"verdict": {"trusted": False}, "left_out": ["a.png"]},
     ("NOT trusted", "1 left out")),
    ("place", SFM | {"part": 1, "parts": [{"names": [], "points": 1}] * 2}, ("part 1 of 2",)),
    ("train", TRAIN, ("53,210 Gaussians", "3,000 iterations", "32.99 dB on validation views")),
    ("train", TRAIN | {"blocks": 4, "stopped_early_at": 2000, "skipped_steps": 1},
     ("in 4 blocks", "stopped early", "1 step skipped")),
    ("train", IMPORT, ("4,000 Gaussians", "room.spz")),
    ("train", IMPORT | {"views": 1, "training_psnr_db": 30.0}, ("30.00 dB on 1 training view",)),
    ("prune", PRUNE, ("31,650 of 63,300", "35.68 dB")),
    ("evaluate", EVALUATE, ("34.23 dB", "10 held-out views", "1 held-out view without a camera")),
    ("evaluate", EVALUATE | {"pruned_psnr_db": 33.7243, "pruned_ssim": 0.9417},
     ("compact model 33.72 dB",)),
    ("export", EXPORT, ("splats.ply", "compact", "8.1 MB")),
    ("export.spz", {"file": "splats.spz", "bytes": 1500000, "smaller": 5.4, "psnr_change_db": -0.1},
     ("splats.spz", "1.5 MB", "5.4x smaller", "-0.10 dB")),
    ("export.colmap", {"file": "sparse/0"}, ("sparse/0",)),
])
def test_the_sentence_of_a_stage_holds_its_figures(
    stage: str, summary: dict[str, object], facts: tuple[str, ...]
) -> None:
    sentence = describe_summary(stage, summary)
    assert not [fact for fact in facts if fact not in sentence], sentence
    assert "_" not in sentence


def test_a_summary_of_another_version_has_no_sentence() -> None:
    assert describe_summary("train", {"iterations": 3000}) == ""
    assert describe_summary("ingest", {}) == ""
