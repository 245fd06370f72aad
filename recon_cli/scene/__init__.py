"""What a reconstruction is made of: cameras, views, Gaussians. Knows no files, no training."""

from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import Splats

__all__ = ["Camera", "Scene", "Similarity", "Splats", "View"]
