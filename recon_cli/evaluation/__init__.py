"""Scores of rendered views, and the tables that show them."""

from recon_cli.evaluation.intervals import PairedDifference, paired_bootstrap
from recon_cli.evaluation.quality import (
    MASK_CONVENTION,
    MIN_PIXELS,
    MIN_SIDE,
    PSNR_8BIT_CONVENTION,
    PSNR_CONVENTION,
    SSIM_CONVENTION,
    SSIM_PADDED_CONVENTION,
    leaves_enough,
    psnr,
    ssim,
)
from recon_cli.evaluation.scores import (
    ModelScore,
    ViewScore,
    csv_table,
    model_table,
    paper_table,
    view_table,
)

__all__ = [
    "MASK_CONVENTION",
    "MIN_PIXELS",
    "MIN_SIDE",
    "PSNR_8BIT_CONVENTION",
    "PSNR_CONVENTION",
    "SSIM_CONVENTION",
    "SSIM_PADDED_CONVENTION",
    "ModelScore",
    "PairedDifference",
    "ViewScore",
    "csv_table",
    "leaves_enough",
    "model_table",
    "paired_bootstrap",
    "paper_table",
    "psnr",
    "ssim",
    "view_table",
]
