"""Complete summaries of stages, of which a test changes what it is about."""

from recon_cli.scene.similarity import Similarity
from recon_cli.workspace.summaries import (
    DenoiseSummary,
    IngestSummary,
    SfmSummary,
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
SFM = SfmSummary(
    frames=12, registered=9, points=100, mean_track_length=3.0, reprojection_error_px=0.5,
    median_triangulation_angle_deg=9.0, poses=None, models=(9,), apart=(), rejected={},
    verdict={"trusted": True}, lines=(), rungs=(), seconds={}, unregistered=(),
    unregistered_held_out=(), world=WORLD, cameras=())
INGEST = IngestSummary(
    kind="video", declared_frames=20, decoded_frames=20, lost_frames=0, dropped_blurred=0,
    frames=12, held_out=2, groups=1, width=64, height=48)
DENOISE = DenoiseSummary(
    mode="auto", filter="joint", frames=12, denoised=0, median_sigma_255=0.5)
BY_STAGE = {"ingest": INGEST, "denoise": DENOISE, "sfm": SFM}
