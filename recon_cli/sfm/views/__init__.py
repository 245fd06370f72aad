"""The views that training sees: images without lens distortion."""
