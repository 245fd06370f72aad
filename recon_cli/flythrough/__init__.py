"""`recon render`: pictures and videos of a trained model, along a path or at its own views."""
