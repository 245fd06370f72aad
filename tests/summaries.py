"""Complete summaries of stages, of which a test changes what it is about."""

from recon_cli.scene.similarity import Similarity
from recon_cli.workspace.summaries import (
    DenoiseSummary,
    EvaluateSummary,
    IngestSummary,
    PlaceSummary,
    PruneSummary,
    RoundSummary,
    TrainSummary,
    WorldEvidence,
    WorldSummary,
)

EVIDENCE = WorldEvidence(
    up_found=False, up_reason="", camera_roll_deg=None, camera_spread_deg=None,
    camera_error_deg=None, upright_share=None, floor_found=False, floor_share=None,
    floor_contrast=None, floor_tilt_deg=None, axis="mapper", wall_strength=None,
    scale_source="arbitrary", metres=False)
WORLD = WorldSummary(
    similarity=Similarity().to_json(), evidence=EVIDENCE, measurement=None, sentences=())
PLACE = PlaceSummary(
    frames=12, registered=9, points=100, mean_track_length=3.0, reprojection_error_px=0.5,
    median_triangulation_angle_deg=9.0, poses=None, models=(9,), apart=(), rejected={},
    verdict={"trusted": True}, lines=(), attempts=(), seconds={}, unregistered=(),
    unregistered_held_out=(), world=WORLD, cameras=())
INGEST = IngestSummary(
    kind="video", declared_frames=20, decoded_frames=20, lost_frames=0, dropped_blurred=0,
    frames=12, held_out=2, groups=1, width=64, height=48)
DENOISE = DenoiseSummary(
    mode="auto", frames=12, denoised=0, median_sigma_255=0.5)
TRAIN = TrainSummary(
    iterations=100, gaussians=50, initial_gaussians=20, max_gaussians=60, max_size=48,
    planned_iterations=100, stopped_early_at=None, training_views=9, validation_views=0, width=48,
    height=36, validation_psnr_db=None, train_seconds=1.5,
    parts={"background": "off", "sh_degree": 0}, skipped_steps=0, estimated_seconds=2.0,
    calibration_seconds=0.5, cuda_peak_bytes=0)
PRUNE = PruneSummary(
    at="end", score="loo", ratio=0.5, gaussians_before=50, gaussians=25,
    validation_psnr_db_pruned=None,
    rounds=(RoundSummary(gaussians=25, removed=25, validation_psnr_db=None, kept=True),),
    iterations=120, recovery_steps=20, validation_psnr_db_before=None, validation_psnr_db=None,
    train_seconds=2.0)
EVALUATE = EvaluateSummary(
    test_views=3, unregistered_test=(), base_psnr_db=25.0, base_ssim=0.9, base_gaussians=50)
BY_STAGE = {"ingest": INGEST, "denoise": DENOISE, "sfm": PLACE, "place": PLACE, "train": TRAIN,
            "prune": PRUNE, "evaluate": EVALUATE}
