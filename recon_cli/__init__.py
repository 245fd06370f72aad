"""Indoor 3D reconstruction by Gaussian Splatting that anyone can run."""

__version__ = "0.1.0"
